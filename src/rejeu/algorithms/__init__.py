"""The algorithms, one file each in the order of its paper, as pure functions over explicit state."""
