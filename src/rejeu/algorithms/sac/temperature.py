"""The temperature of the entropy bonus, under the names of earlier versions; see :mod:`rejeu.algorithms.sac.continuous`."""

from rejeu.algorithms.sac.continuous import (
    EntropyConfig,
    initial_alpha as initial,
    initial_temperature,
    metrics_of,
    temperature_loss,
    temperature_step,
)

__all__ = ["EntropyConfig", "initial", "initial_temperature", "metrics_of", "temperature_loss", "temperature_step"]
