"""Watching episodes."""

from rejeu.envs.monitor import Monitor
from rejeu.results import LoadMonitorResultsError, get_monitor_files, load_results

__all__ = ["LoadMonitorResultsError", "Monitor", "get_monitor_files", "load_results"]
