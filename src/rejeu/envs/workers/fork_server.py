"""Is imported by the fork server alone, so that it goes on after requests to stop: it says whether its workers live."""

from rejeu.core import interrupt

interrupt.install(interrupt.disregard)
