"""Compares the speed of rejeu with other libraries and with the limits of the machine. Used by ``scripts/bench``."""
