"""Where numbers go."""

from rejeu.logging import Logger, configure

__all__ = ["Logger", "configure"]
