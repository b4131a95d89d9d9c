"""Logging of training statistics."""

from rejeu.reporting.logging import Logger, configure

__all__ = ["Logger", "configure"]
