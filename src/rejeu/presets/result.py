"""Measured results of the presets, read from ``results.json``, which ``scripts/figures.py`` writes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import msgspec


@dataclass(frozen=True, kw_only=True)
class Result:
    """What an algorithm reached in an environment, over several seeds."""

    env_id: str
    """Id of the environment."""
    algorithm: str
    """Name of the algorithm."""
    setting: str
    """What was not as in the preset, such as ``"sigma=1"``; empty if nothing was."""
    measure: str
    """``"mean return"`` or ``"success rate"``."""
    mean: float
    """Mean over the seeds."""
    low: float
    """Lower end of the 95 % confidence interval of the mean return; of success rates the lowest of a seed."""
    high: float
    """Upper end, or the highest of a seed."""
    seeds: int
    """Number of seeds."""
    episodes: int
    """Episodes of the evaluation of each seed."""
    budget: str
    """What each seed was trained for, such as ``"20,000 steps"``."""
    seconds: tuple[float, float]
    """Shortest and longest training of a seed."""
    command: str
    """The command that measures it."""

    def __str__(self) -> str:
        """The result in a few words."""
        return ", ".join(filter(None, (f"{self.measure} {self.figures}", f"{self.seeds} seeds", self.setting)))

    @property
    def figures(self) -> str:
        """Mean and spread.

        >>> find_result("Pendulum-v1", "TD3").figures
        '-156.2 (-158.2 to -154.2)'
        """
        show = _percent if self.measure == "success rate" else _number
        if self.low == self.high:
            return show(self.mean)
        return f"{show(self.mean)} ({show(self.low).removesuffix(' %')} to {show(self.high)})"


def _number(number: float) -> str:
    """Returns a return with one decimal, or with two if it is below 1."""
    return f"{number:.{1 if abs(number) >= 1 else 2}f}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}".removesuffix(".0") + " %"


@cache
def results() -> tuple[Result, ...]:
    """Returns every result; of several for one preset the first is of the preset as it is."""
    content = resources.files("rejeu.presets").joinpath("results.json").read_bytes()
    return msgspec.json.decode(content, type=tuple[Result, ...])


def find_result(env_id: str, algorithm: str) -> Result | None:
    """Returns the first result of an algorithm in an environment, None if there is none."""
    return next((result for result in results() if (result.env_id, result.algorithm) == (env_id, algorithm)), None)
