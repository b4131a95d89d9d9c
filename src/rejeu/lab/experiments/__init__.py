"""Many runs at once: sweeps and studies, and the scheduler that trains their runs."""
