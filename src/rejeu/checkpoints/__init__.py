"""Model files, the state of a run, and exact resume."""
