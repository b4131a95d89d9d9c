"""Training loops, which connect an algorithm to environments."""
