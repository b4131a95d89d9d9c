"""Loops: what joins an algorithm to environments."""
