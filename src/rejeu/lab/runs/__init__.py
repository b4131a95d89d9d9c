"""Runs as data: what a run is, the files of its folder, and what a process is asked to do with it."""
