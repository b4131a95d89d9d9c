"""Many runs at once: sweeps, studies and populations, and the scheduler that trains their runs."""
