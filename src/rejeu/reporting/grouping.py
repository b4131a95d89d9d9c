"""What makes a group of runs, and the labels of groups: algorithm, settings in which the runs differ, or environment."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from rejeu.io.records import shown
from rejeu.reporting.runs import Run, flat

By = Literal["algorithm", "setting", "env"]
MAX_LABEL = 200
"""Characters of a label that are shown."""


def group_labels(runs: Sequence[Run], by: By | None) -> tuple[By, list[str]]:
    """Returns what makes a group, and the label of the group of each run."""
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
    chosen = usual if by is None else by
    return chosen, labels[chosen]


def settings(runs: Sequence[Run]) -> list[str]:
    """Returns for each run the algorithm, and the settings in which the runs of this algorithm differ."""
    values = [dict(flat(run.hyperparameters)) | {"n_envs": run.n_envs} for run in runs]
    written = [{name: whole_text(value) for name, value in one.items()} for one in values]
    members: dict[str, list[dict[str, str]]] = {}
    for run, one in zip(runs, written, strict=True):
        members.setdefault(algorithm_label(run), []).append(one)
    differing = {algorithm: differing_names(ones) for algorithm, ones in members.items()}
    labels = []
    for run, one in zip(runs, written, strict=True):
        algorithm = algorithm_label(run)
        parts = [algorithm, *(f"{name}={one[name]}" for name in differing[algorithm] if name in one)]
        labels.append(shortened(", ".join(parts)))
    return labels


def differing_names(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """Returns the names whose values are not all the same."""
    names = sorted({name for one in settings for name in one})
    return [name for name in names if len({one.get(name, "") for one in settings}) > 1]


def algorithm_label(run: Run) -> str:
    """Returns the algorithm of a run; of one that does not say, the name of the folder above."""
    return run.algorithm or run.path.parent.name


def env_label(run: Run) -> str:
    """Returns the environment of a run with its keyword arguments."""
    kwargs = ", ".join(f"{name}={whole_text(value)}" for name, value in sorted(run.env_kwargs.items()))
    return shortened(f"{run.env_id}({kwargs})" if kwargs else run.env_id)


def whole_text(value: Any) -> str:
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
