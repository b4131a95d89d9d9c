"""The foundation: the parts of an algorithm, spaces, distributions, schedules, checks, files, devices, signals."""
