"""Sweeps, under the name of earlier versions; see :mod:`rejeu.experiments`."""
