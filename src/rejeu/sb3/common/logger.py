"""Where numbers go."""

from rejeu.reporting.logging import Logger, configure

__all__ = ["Logger", "configure"]
