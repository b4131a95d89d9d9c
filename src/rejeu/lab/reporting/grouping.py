"""Runs that are compared: their returns over steps or time, cut and scaled, and what makes a group of them.

Groups are made by algorithm, by the settings in which the runs differ, or by environment.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from rejeu.core.records import shown
from rejeu.lab.runs.read import RunSummary
from rejeu.logs.tables import HUGE, flat

By = Literal["algorithm", "setting", "env"]
MAX_LABEL = 200
"""Characters of a label that are shown."""


def group_labels(runs: Sequence[RunSummary], by: By | None) -> tuple[By, list[str]]:
    """Returns the basis of the groups, and the label of the group of each run."""
    labels: dict[By, list[str]] = {
        "algorithm": [algorithm_label(run) for run in runs],
        "setting": settings(runs),
        "env": [env_label(run) for run in runs],
    }
    # tuned settings differ from environment to environment, and are then nothing to compare
    settings_differ = len({*zip(labels["env"], labels["setting"], strict=True)}) > len({*labels["env"]})
    usual: By = "env" if len({*labels["env"]}) > 1 else "algorithm"
    if len({*labels["algorithm"]}) > 1:
        usual = "algorithm"
    elif settings_differ:
        usual = "setting"
    by = usual if by is None else by
    return by, labels[by]


def settings(runs: Sequence[RunSummary]) -> list[str]:
    """Returns for each run the algorithm, and the settings in which runs of this algorithm on one environment differ."""
    written = [*map(settings_of, runs)]
    members: dict[tuple[str, str], list[dict[str, str]]] = {}
    for run, setting in zip(runs, written, strict=True):
        members.setdefault((env_label(run), algorithm_label(run)), []).append(setting)
    differing: dict[str, dict[str, None]] = {}
    for (_, algorithm), group in members.items():
        differing.setdefault(algorithm, {}).update(dict.fromkeys(differing_names(group)))
    labels = []
    for run, setting in zip(runs, written, strict=True):
        algorithm = algorithm_label(run)
        parts = [algorithm, *(f"{name}={setting[name]}" for name in differing[algorithm] if name in setting)]
        labels.append(shortened(", ".join(parts)))
    return labels


def settings_of(run: RunSummary) -> dict[str, str]:
    """Returns the hyperparameters of a run and the number of its environments, as texts."""
    values = dict(flat(run.config.hyperparameters)) | {"n_envs": run.config.n_envs}
    return {name: whole_text(value) for name, value in values.items()}


def differing_settings(groups: Sequence[Sequence[RunSummary]]) -> list[list[str]]:
    """Returns the settings in which those groups of runs differ that have them: another algorithm has others.

    Each is a row of texts: its name, then its values in each group, empty where there are none.
    """
    columns: list[dict[str, str]] = []
    for runs in groups:
        values: dict[str, set[str]] = {"algorithm": {algorithm_label(run) for run in runs}}
        for name, text in (setting for run in runs for setting in settings_of(run).items()):
            values.setdefault(name, set()).add(text)
        columns.append({name: shortened(", ".join(sorted(texts - {""}))) for name, texts in values.items()})
    names = sorted({name for column in columns for name in column})
    differing = [name for name in names if len({column[name] for column in columns if name in column}) > 1]
    return [[name, *(column.get(name, "") for column in columns)] for name in differing]


def differing_names(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """Returns the names whose values are not all the same."""
    names = sorted({name for setting in settings for name in setting})
    return [name for name in names if len({setting.get(name, "") for setting in settings}) > 1]


def algorithm_label(run: RunSummary) -> str:
    """Returns the algorithm of a run; of one that does not say, the name of the folder above."""
    return run.config.algorithm or run.path.parent.name


def env_label(run: RunSummary) -> str:
    """Returns the environment of a run with its keyword arguments."""
    kwargs = ", ".join(f"{name}={whole_text(value)}" for name, value in sorted(run.config.env_kwargs.items()))
    return shortened(f"{run.config.env}({kwargs})" if kwargs else run.config.env)


def whole_text(value: object) -> str:
    """Returns a value of a configuration as text, empty for None."""
    if value is None:
        return ""
    return value if isinstance(value, str) else json.dumps(value)


def shortened(label: str) -> str:
    """Returns a label; a long one is cut, with a digest that keeps it apart from others that begin alike."""
    if len(label) <= MAX_LABEL:
        return shown(label, MAX_LABEL)
    digest = hashlib.blake2b(label.encode("utf-8", "backslashreplace"), digest_size=4).hexdigest()
    return f"{shown(label, MAX_LABEL)} #{digest}"


Axis = Literal["steps", "time"]
Score = Literal["training", "evaluation"]
N_POINTS = 101
"""Points of a curve."""
SMOOTHING = 0.05
"""Width of the moving mean of a curve, as a share of what is compared."""
FINAL = 0.1
"""Share of training, at its end, whose episodes make the final score."""
NO_EPISODE = "no episode yet"
"""The problem of a run of which no training episode has ended."""


class Curve:
    """The returns of one run over steps or time. Mutable while a comparison is made."""

    def __init__(self, run: RunSummary, x: np.ndarray, y: np.ndarray, problem: str = "") -> None:
        self.run, self.x, self.y, self.problem = run, x, y, problem
        self.env = env_label(run)
        self.label = ""
        self.end = float(x[-1]) if len(x) else 0.0
        """Where the curve ends: the steps, or the time, that all runs of the environment have."""
        self.evaluation: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def of(cls, run: RunSummary, axis: Axis, score: Score) -> Curve:
        """Returns the curve of a run, or one with a ``problem``."""
        table = run.evaluations
        when, value = table.column("step" if axis == "steps" else "seconds"), table.column("mean_return")
        good = np.isfinite(when) & (np.abs(value) < HUGE)
        if len(run.episodes):
            x, y = (run.episodes.column(name) for name in ("step" if axis == "steps" else "seconds", "return"))
        elif run.config.hyperparameters.get("offline"):
            x, y = when[good], value[good]
        else:  # of a run that is in progress or crashed only the means are known
            x = run.metrics.column("step" if axis == "steps" else "time/time_elapsed")
            y = run.metrics.column("rollout/ep_rew_mean")
        finite = np.isfinite(x) & (np.abs(y) < HUGE)
        x, y = x[finite], y[finite]
        if score == "evaluation" and not len(x):
            x, y = when[good], value[good]
        whole = run.steps if axis == "steps" else run.seconds
        if not len(x) or x[-1] <= 0:
            curve = cls(run, x[:0], y[:0], NO_EPISODE)
            curve.end = whole
            return curve
        if (np.diff(x) < 0).any():  # time that was set back
            order = np.argsort(x, kind="stable")
            x, y = x[order], y[order]
        curve = cls(run, x, y)
        curve.end = max(curve.end, whole if math.isfinite(whole) else 0.0)  # the last episode ends before the run does
        if score == "evaluation":
            if not good.any():
                return cls(run, x[:0], y[:0], "no evaluation")
            curve.evaluation = when[good], value[good]
        return curve

    def mean_between(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Returns the mean return of the episodes that ended in each interval ``(low, high]``.

        Where there is none, the return of the last one before it; NaN before the first.
        """
        sums = np.concatenate([[0.0], np.cumsum(self.y)])
        first, last = (np.searchsorted(self.x, bound, "right") for bound in (low, high))
        first = np.where(first == last, np.maximum(last - 1, 0), first)
        with np.errstate(invalid="ignore"):
            return (sums[last] - sums[first]) / np.where(last > first, last - first, np.nan)

    def points(self) -> np.ndarray:
        """Returns the smoothed curve, ``(N_POINTS,)``."""
        grid = np.linspace(0, self.end, N_POINTS)
        return self.mean_between(grid - SMOOTHING * self.end, grid)

    def final(self) -> float:
        """Returns the final score."""
        if self.evaluation is not None:
            when, value = self.evaluation
            return float(value[int(np.searchsorted(when, self.end, "right")) - 1])
        return float(self.mean_between(np.array([(1 - FINAL) * self.end]), np.array([self.end]))[0])


def cut_to_shortest(curves: list[Curve], axis: Axis, notes: list[str]) -> None:
    """Cuts the curves of each environment to the shortest of them, and notes it if they differ by more than a tenth."""
    for env, group in itertools.groupby(sorted(curves, key=lambda curve: curve.env), key=lambda curve: curve.env):
        members = list(group)
        shortest = min(members, key=lambda curve: curve.end)
        longest = max(curve.end for curve in members)
        if shortest.end < (1 - FINAL) * longest:
            unit = axis if axis == "steps" else "seconds"
            notes.append(
                f"the runs on {env or 'the environment'} have between {shortest.end:,.0f} and {longest:,.0f} {unit}; all are "
                f"compared up to those of {shortest.run.name} ({shortest.run.state})"
            )
        for curve in members:
            curve.end = shortest.end


def scale(curves: Sequence[Curve], normalize: str | Mapping[str, tuple[float, float]]) -> None:
    """Scales the returns of each environment.

    Raises:
        ValueError: if an environment has no reference returns, or they are equal.
    """
    finals: dict[str, list[float]] = {}
    for curve in curves:
        finals.setdefault(curve.env, []).append(curve.final())
    for curve in curves:
        if isinstance(normalize, Mapping):
            if curve.env not in normalize:
                raise ValueError(
                    f"normalize has no reference returns for {curve.env!r}; add {{{curve.env!r}: (low, high)}}"
                )
            low, high = references(curve.env, normalize[curve.env])
        elif normalize == "range":
            low, high = min(finals[curve.env]), max(finals[curve.env])
        else:
            raise ValueError(f"normalize={normalize!r} must be 'range' or a mapping of environments to (low, high)")
        span = (high - low) or 1.0
        curve.y = (curve.y - low) / span
        if curve.evaluation is not None:
            curve.evaluation = curve.evaluation[0], (curve.evaluation[1] - low) / span


def references(env: str, pair: tuple[float, float]) -> tuple[float, float]:
    """Returns the two reference returns of an environment.

    Raises:
        ValueError: if they are not two finite numbers, the lower first.
    """
    try:
        low, high = map(float, pair)
    except (TypeError, ValueError):
        low = high = math.nan
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"normalize[{env!r}]={pair!r} must be two returns, the lower first")
    return low, high
