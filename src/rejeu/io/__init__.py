"""Files: what is written to disk and read from it."""
