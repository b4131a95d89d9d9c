"""Many runs: planned in a file, trained in processes on one machine, several machines or a Ray cluster, and compared."""
