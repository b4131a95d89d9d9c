"""Statistics of samples: medians, ranges, ratios per round, and limits."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

from benchmarks.bench import plan

Sample = Mapping[str, Any]
ByRound = dict[int, float]
"""One number per round."""
PARTS = ("env", "replay", "update", "rest")
"""Parts of the training time that rejeu reports, and the rest."""


class Spread(NamedTuple):
    """Median, minimum and maximum."""

    median: float
    low: float
    high: float


class Limit(NamedTuple):
    """The time that a step would take if only the environment and the arithmetic took time."""

    env: float
    """Seconds per environment step without an agent."""
    arithmetic: float
    """Seconds for the operations of acting and updating, at the rate of the machine's fastest matrix product."""
    flops: float
    """Number of these operations per environment step."""
    share_reached: float
    """Limit divided by the measured seconds per step, the median over the rounds."""

    @property
    def seconds(self) -> float:
        """Seconds per step."""
        return self.env + self.arithmetic


def cost(sample: Sample) -> float:
    """Returns the seconds by which variants are compared: per step, or of the whole process."""
    if sample["case"] != "parking" and "seconds_per_step" in sample["result"]:
        return sample["result"]["seconds_per_step"]
    return sample["wall_seconds"]


def best(samples: Iterable[Sample], case: str, name: str, library: str) -> list[Sample]:
    """Returns a measurement's samples by round, of the variant with the most samples and, among those, the fastest."""
    by_variant: dict[str, list[Sample]] = {}
    for sample in samples:
        if (sample["case"], sample["name"], sample["library"]) == (case, name, library) and "error" not in sample:
            by_variant.setdefault(sample["variant"], []).append(sample)
    if not by_variant:
        return []
    fastest = min(by_variant.values(), key=lambda rows: (-len(rows), median(map(cost, rows))))
    return sorted(fastest, key=lambda sample: sample["round"])


def by_round(rows: Iterable[Sample], get: Callable[[Sample], float]) -> ByRound:
    """Returns a number of each sample by round."""
    return {sample["round"]: get(sample) for sample in rows}


def spread(numbers: ByRound) -> Spread:
    """Returns median, minimum and maximum.

    >>> spread({0: 3.0, 1: 1.0, 2: 2.5})
    Spread(median=2.5, low=1.0, high=3.0)
    """
    return Spread(median(numbers.values()), min(numbers.values()), max(numbers.values()))


def ratio(top: ByRound, bottom: ByRound) -> Spread | None:
    """Returns the ratios of the rounds that both have, or None if they share no round.

    >>> ratio({0: 4.0, 1: 9.0, 2: 8.0}, {0: 2.0, 1: 3.0})
    Spread(median=2.5, low=2.0, high=3.0)
    """
    common = top.keys() & bottom.keys()
    return spread({turn: top[turn] / bottom[turn] for turn in common}) if common else None


def step_seconds(samples: Sequence[Sample], case: str, name: str, library: str) -> ByRound:
    """Returns the seconds per step by round."""
    return by_round(best(samples, case, name, library), cost)


def peak(samples: Sequence[Sample], threads: int) -> float | None:
    """Returns the highest number of operations per second over the rounds, with one thread (1) or all (0)."""
    rows = best(samples, "limits", f"peak, {plan.ONE if threads == 1 else plan.ALL}", "rejeu")
    return max((row["result"]["flops_per_second"] for row in rows), default=None)


def limit(samples: Sequence[Sample], case: str, name: str, env: str, counted_as: str = "") -> Limit | None:
    """Returns rejeu's limit in a case whose environment was measured as ``env``, or None if a measurement is missing.

    ``counted_as`` names the measurement that counted the operations, if it is another one.
    """
    rows = best(samples, case, name, "rejeu")
    results = (row["result"] for row in best(samples, case, counted_as or name, "rejeu"))
    counted = next((result for result in results if "update_flops" in result), None)
    bare = step_seconds(samples, "limits", env, "rejeu")
    rate = None if counted is None else peak(samples, counted["threads"])
    if counted is None or rate is None:
        return None
    flops = counted["update_flops"] + counted["act_flops"]
    limits = {turn: seconds + flops / rate for turn, seconds in bare.items()}
    reached = ratio(limits, by_round(rows, cost))
    return None if reached is None else Limit(spread(bare).median, flops / rate, flops, reached.median)


def shares(rows: Sequence[Sample]) -> dict[str, float] | None:
    """Returns the fraction of a step spent on each part, medians over the rounds; None if there are no rows."""
    if not rows:
        return None
    fractions = {}
    for part_name in PARTS:
        each = (row["result"]["seconds_by_part"] for row in rows)
        fractions[part_name] = median(seconds[part_name] / sum(seconds.values()) for seconds in each)
    return fractions


def gap(samples: Sequence[Sample], case: str, name: str, case_limit: Limit) -> dict[str, float]:
    """Returns the time per step in excess of its limit, in seconds by part, medians over the rounds.

    The part of the environment is its time in excess of steps without an agent. The part of the update is the waiting
    time in excess of the arithmetic. It is negative where environment and update run at the same time.
    """
    floor = {"env": case_limit.env, "update": case_limit.arithmetic}
    rows = best(samples, case, name, "rejeu")
    return {
        part_name: median(row["result"]["seconds_by_part"][part_name] for row in rows) - floor.get(part_name, 0.0)
        for part_name in PARTS
    }


def drift(samples: Sequence[Sample]) -> Spread | None:
    """Returns the duration of the calibration in milliseconds over the run; None without samples."""
    durations = [ms for sample in samples for ms in sample["calibration_ms"]]
    return spread(dict(enumerate(durations))) if durations else None


def disturbed(samples: Sequence[Sample], max_cores: float) -> list[Sample]:
    """Returns the samples before which other programs used more than ``max_cores`` cores."""
    return [sample for sample in samples if sample["others_busy"] is not None and sample["others_busy"] > max_cores]
