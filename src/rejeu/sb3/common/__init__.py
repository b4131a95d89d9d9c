"""Modules shared by the algorithms."""
