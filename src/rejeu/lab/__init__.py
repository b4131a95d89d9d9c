"""Work with many runs: how a run is described, experiments, reports, the command line, and the hub."""
