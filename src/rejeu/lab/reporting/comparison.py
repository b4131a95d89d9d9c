"""Comparison of runs: groups of several seeds, with curves, final scores and their intervals."""

from __future__ import annotations

import html
import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import msgspec
import numpy as np

from rejeu.core import atomic, validation
from rejeu.core.records import shown
from rejeu.core.types import JsonObject
from rejeu.lab.reporting.grouping import (
    FINAL,
    N_POINTS,
    NO_EPISODE,
    Axis,
    By,
    Curve,
    Score,
    algorithm_label,
    cut_to_shortest,
    differing_settings,
    group_labels,
    scale,
    settings,
)
from rejeu.lab.reporting.run_list import read_all
from rejeu.lab.runs.read import RunSummary
from rejeu.logs import statistics
from rejeu.logs.charts import GROUP_COLORS, Chart, group_chart
from rejeu.logs.formatting import cell, counted, csv_text, html_table, markdown_table, number

if TYPE_CHECKING:
    from rejeu.logs.plots.picture import Picture

N_LEVELS = 101
"""Levels of a performance profile."""
CURVE_SAMPLES = 1000
"""Most bootstrap samples of a curve, whose interval is only drawn."""
BOUNDS = ("value", "low", "high")
"""The rows of a curve: statistic, and bounds of its interval."""
FORMATS = ("md", "csv", "json", "png", "html")
MAX_LISTED = 500
"""Most runs and probabilities that a page lists."""
Key = tuple[str, str]
"""Environment and label of a group."""
Finals = Mapping[Key, tuple[np.ndarray, ...]]
"""Final scores of the runs of each group, one array for each environment."""


@dataclass(frozen=True, eq=False)
class Group:
    """The runs that are averaged."""

    label: str
    env_id: str
    """The environment; several where scores are normalized."""
    runs: tuple[RunSummary, ...]
    scores: tuple[np.ndarray, ...]
    """Final scores of the runs, one array for each environment."""
    run_scores: tuple[float, ...]
    """Final score of each run, in the order of ``runs``."""
    score: tuple[float, float, float]
    """Interquartile mean of the final scores, and the bounds of its interval."""
    mean: float
    median: float
    curve: np.ndarray
    """``(3, N_POINTS)``: the statistic at each point, and the bounds of its interval; NaN before the first episodes."""
    x: np.ndarray
    """``(N_POINTS,)``: steps or seconds; the share of training where environments are mixed."""
    run_curves: np.ndarray
    """``(n_runs, N_POINTS)``: the curve of each run, in the order of ``runs``."""
    profile: np.ndarray
    """``(3, N_LEVELS)``: share of runs whose final score is above each level, and the bounds of its interval."""
    levels: np.ndarray
    reached: tuple[int, float] | None
    """Number of runs that reached the threshold, and the median of the steps (or seconds) that this took, infinite where half
    of the runs did not; None without a threshold."""

    @property
    def interval(self) -> str:
        """The score with its interval as text."""
        value, low, high = map(number, self.score)
        return f"IQM {value} (95 % interval {low} to {high}), {counted(len(self.runs), 'run')}"


@dataclass(frozen=True)
class Improvement:
    """The probability that a run of one group scores higher than a run of another."""

    label: str
    other: str
    env_id: str
    probability: float
    low: float
    high: float
    pairs: int
    """Of a run of each group."""

    @property
    def cells(self) -> list[str]:
        """The two labels, the environment and the probability with its interval as text.

        Where all pairs have the same winner, the bootstrap has no interval, and their number says how much that is.
        """
        has_interval = self.low < self.high
        interval = f"{self.low:.0%} to {self.high:.0%}" if has_interval else f"in all {self.pairs} pairs of runs"
        return [self.label, self.other, self.env_id, f"{self.probability:.0%} ({interval})"]


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Result of :func:`compare`. ``print`` and notebooks show it as a table."""

    groups: tuple[Group, ...]
    improvements: tuple[Improvement, ...]
    by: By
    axis: Axis
    score: Score
    statistic: str
    threshold: float | None
    notes: tuple[str, ...]
    """Lines about runs that were left out, cut or not comparable."""
    unranked: frozenset[str] = frozenset()
    """``env_id`` of the groups of which none is called best, because runs that trained as long have no score."""

    @property
    def definition(self) -> str:
        """Definition of the final score."""
        if self.score == "evaluation":
            return "final score: mean return of the last evaluation"
        return f"final score: mean return of the training episodes in the last {FINAL:.0%} of what is compared"

    @property
    def standings(self) -> list[str]:
        """For each group "best", "may be best" or nothing; intervals that reach that of the highest score are equal."""
        texts = []
        for group in self.groups:
            peers = [peer.score for peer in self.groups if peer.env_id == group.env_id]
            _, low, _ = max(peers)
            reaching = [score for score in peers if score[2] >= low]
            is_reaching = len(peers) > 1 and group.score in reaching and group.env_id not in self.unranked
            texts.append(("best" if len(reaching) == 1 else "may be best") if is_reaching else "")
        return texts

    @property
    def settings(self) -> list[list[str]]:
        """The settings in which the groups differ, as a table of texts with a row of headings."""
        rows = differing_settings([group.runs for group in self.groups])
        envs = {group.env_id for group in self.groups}
        heads = [group.label if len(envs) == 1 else f"{group.label} on {group.env_id}" for group in self.groups]
        return [["setting", *heads], *rows] if rows else []

    def table(self) -> list[JsonObject]:
        """Returns one row for each group, ready for ``pandas.DataFrame``."""
        return [
            {
                "group": group.label,
                "env": group.env_id,
                "runs": len(group.runs),
                **dict(zip(("iqm", "iqm_low", "iqm_high"), group.score, strict=True)),
                "mean": group.mean,
                "median": group.median,
                "threshold": self.threshold,
                **dict(zip(("reached", f"{self.axis}_to_threshold"), group.reached or (None, None), strict=True)),
            }
            for group in self.groups
        ]

    def text_table(self) -> list[list[str]]:
        """Returns the table as text, with a row of headings; the first two columns are names."""
        head = ["group", "environment", "runs", "IQM", "95 % interval", "mean", "median"]
        if self.threshold is not None:
            head.append(f"{self.axis} to {number(self.threshold)}")
        rows = [head]
        for group in self.groups:
            value, low, high = map(number, group.score)
            cells = [group.label, group.env_id, str(len(group.runs)), value, f"{low} to {high}"]
            cells += [number(group.mean), number(group.median)]
            if group.reached is not None:
                cells.append(f"{number(group.reached[1])} ({group.reached[0]} of {len(group.runs)})")
            rows.append(cells)
        return rows

    def to_markdown(self) -> str:
        """Returns the tables and the notes as Markdown."""
        head, *rows = self.text_table()
        parts = [markdown_table(head, rows), self.definition]
        if self.improvements:
            names = ["group", "better than", "environment", "probability of improvement (95 % interval)"]
            parts.append(markdown_table(names, [improvement.cells for improvement in self.improvements]))
        if self.notes:
            parts.append("\n".join(f"- {cell(note)}" for note in self.notes))
        return "\n\n".join(parts) + "\n"

    def to_csv(self) -> str:
        """Returns :meth:`table` as CSV."""
        return csv_text(self.table())

    def curves_csv(self) -> str:
        """Returns the curves as CSV, one row for each point of each group."""
        return csv_text(
            {"group": group.label, "env": group.env_id, self.axis: x, **dict(zip(BOUNDS, point, strict=True))}
            for group in self.groups
            for x, point in zip(group.x.tolist(), group.curve.T.tolist(), strict=True)
        )

    def to_dict(self) -> JsonObject:
        """Returns everything as JSON values, except that unknown numbers are NaN."""
        return {
            "by": self.by,
            "axis": self.axis,
            "score": self.definition,
            "curves": self.statistic,
            "groups": [
                {
                    **row,
                    "paths": [str(run.path) for run in group.runs],
                    "seeds": [run.config.seed for run in group.runs],
                    "scores": [scores.tolist() for scores in group.scores],
                    "curve": dict(zip(("x", *BOUNDS), [group.x.tolist(), *group.curve.tolist()], strict=True)),
                    "profile": dict(
                        zip(("levels", *BOUNDS), [group.levels.tolist(), *group.profile.tolist()], strict=True)
                    ),
                }
                for row, group in zip(self.table(), self.groups, strict=True)
            ],
            "improvements": [vars(improvement) for improvement in self.improvements],
            "notes": list(self.notes),
        }

    def to_json(self) -> str:
        """Returns everything as JSON; unknown and infinite numbers are null."""
        return msgspec.json.format(msgspec.json.encode(self.to_dict()), indent=1).decode() + "\n"

    def plot(self, path: str | Path | None = None) -> Picture:
        """Returns a matplotlib figure of the curves; ``path`` is a file to write it to.

        Raises:
            MissingExtra: if matplotlib is not installed.
        """
        from rejeu.logs.plots import results

        return results.comparison(self, path)

    def to_html(self) -> str:
        """Returns a page with interactive curves, which needs no network.

        Raises:
            MissingExtra: if plotly or jinja2 is not installed.
        """
        return page_of(self)

    def save(self, path: str | Path) -> list[Path]:
        """Writes a file in the format of its suffix, or all formats into a folder; returns the paths.

        Raises:
            ValueError: for another suffix.
            MissingExtra: if a package for the format is not installed.
        """
        path = validation.as_path(path)
        suffix = path.suffix.lower().removeprefix(".")
        if path.is_dir() or not suffix:
            paths = [saved for suffix in FORMATS for saved in self.save(path / f"compare.{suffix}")]
            return [*paths, atomic.write(path / "curves.csv", self.curves_csv())]
        if suffix == "png":
            self.plot(path)
            return [path]
        texts = {"md": self.to_markdown, "csv": self.to_csv, "json": self.to_json, "html": self.to_html}
        if suffix not in texts:
            raise ValueError(f"{path.name!r} must end in {', '.join(FORMATS)}, or be a folder")
        return [atomic.write(path, texts[suffix]())]

    def __repr__(self) -> str:
        unknown = "an unknown environment"
        lines = [f"{group.label} on {group.env_id or unknown}: {group.interval}" for group in self.groups]
        return "\n".join([*lines, self.definition, *(f"note: {note}" for note in self.notes)])

    def _repr_html_(self) -> str:
        lines = [self.definition, *(f"note: {note}" for note in self.notes)]
        return html_table(self.text_table()) + "".join(f"<p>{html.escape(line)}</p>" for line in lines)


def compare(
    runs: str | Path | RunSummary | Iterable[str | Path | RunSummary],
    by: By | None = None,
    *,
    x: Axis = "steps",
    score: Score = "training",
    statistic: Literal["iqm", "mean", "median"] = "iqm",
    normalize: Literal["range"] | Mapping[str, tuple[float, float]] | None = None,
    threshold: float | None = None,
    samples: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Compares groups of runs; several seeds of the same experiment are one group.

    Curves are moving means of the training returns. They and the final scores have 95 % intervals from a bootstrap that is
    stratified by environment. All runs of an environment are cut to the shortest of them.

    Args:
        runs: run folders, folders of run folders, or what other programs wrote; see
            :func:`rejeu.lab.reporting.run_list.read_all`.
        by: what makes a group: ``"algorithm"``, ``"setting"`` (the hyperparameters in which the runs differ) or ``"env"``. By
            default the first of these in which the runs differ.
        x: ``"steps"`` or ``"time"``, the training time in seconds.
        score: what the final score of a run is: ``"training"``, the mean return of the episodes in the last tenth, or
            ``"evaluation"``, the mean return of the last evaluation.
        statistic: statistic of the curves over the runs.
        normalize: puts scores of several environments on one scale, so that they can be averaged: ``"range"`` from the lowest
            to the highest final score of each environment, or two reference returns by environment, which become 0 and 1.
        threshold: return that counts as learned; the tables then have the steps (or seconds) until the curves reach it.
        samples: number of bootstrap samples.
        seed: seed of the bootstrap.

    Raises:
        ValueError: if there is nothing to compare, or an argument is invalid.
        FileNotFoundError: if a path holds no run.
    """
    validation.choice("by", "algorithm" if by is None else by, get_args(By))
    validation.choice("x", x, get_args(Axis))
    validation.choice("score", score, get_args(Score))
    validation.choice("statistic", statistic, statistics.STATISTICS)
    if threshold is not None:
        threshold = validation.number("threshold", threshold)
    samples, seed = validation.whole("samples", samples, 1), validation.whole("seed", seed, 0)
    summaries, notes = read_all(runs)
    curves, silent = comparable(summaries, x, score, notes)
    by, labels = group_labels([curve.run for curve in curves], by)
    for curve, label in zip(curves, labels, strict=True):
        curve.label = label
    notes += warnings_of(curves)
    envs = sorted({curve.env for curve in curves})
    if normalize is not None:
        scale(curves, normalize)
    elif len(envs) > 1 and by != "env":
        notes.append(
            f"the runs are of {len(envs)} environments; each has rows of its own, because their returns cannot be averaged; "
            "normalize them to average"
        )
    mixes = normalize is not None and by != "env"
    keyed = by_group(curves, mixes)
    if len({env for env, _ in keyed}) > 1 and mixes:
        notes.append("the groups are of different environments; only groups of the same environments are compared")
    rng = np.random.default_rng(seed)
    finals = {key: strata(members, [curve.final() for curve in members]) for key, members in keyed.items()}
    draws = {key: statistics.draw(scores, samples, rng) for key, scores in finals.items()}
    groups = tuple(
        make_group(key, keyed[key], finals, draws[key], threshold, statistics.STATISTICS[statistic], mixes)
        for key in sorted(keyed)
    )
    unranked = frozenset(env for (env, _), members in keyed.items() if any(curve.env in silent for curve in members))
    ranked = [key for key in sorted(keyed) if key[0] not in unranked]
    pairs = [(first, second) for first, second in itertools.combinations(ranked, 2) if first[0] == second[0]]
    improvements = tuple(compared(*pair, finals, draws) for pair in pairs)
    notes += coverage_notes([min(map(len, group.scores)) for group in groups])
    return Comparison(groups, improvements, by, x, score, statistic, threshold, tuple(notes), unranked)


def comparable(runs: Sequence[RunSummary], axis: Axis, score: Score, notes: list[str]) -> tuple[list[Curve], set[str]]:
    """Returns the curves of the runs that can be compared, cut to the same length; notes say which cannot and why.

    Also returns the environments of runs that trained as long, and have no score since none of their episodes has ended. The
    scores of the other runs are then those of short episodes, and no estimate of their group's.

    Raises:
        ValueError: if none can.
    """
    read = [Curve.of(run, axis, score) for run in runs]
    curves = [curve for curve in read if not curve.problem]
    notes += omission_notes([curve for curve in read if curve.problem])
    cut_to_shortest(curves, axis, notes)
    for curve in curves:
        if curve.evaluation is not None and curve.evaluation[0][0] > curve.end:
            curve.problem = "no evaluation within what is compared"
    notes += omission_notes([curve for curve in curves if curve.problem])
    curves = [curve for curve in curves if not curve.problem]
    if not curves:
        raise ValueError(f"there is nothing to compare; {'; '.join(notes)[:500] or 'no run was given'}")
    ends = {curve.env: curve.end for curve in curves}
    silent = {
        curve.env
        for curve in read
        if curve.problem == NO_EPISODE and curve.env in ends and curve.end >= ends[curve.env]
    }
    notes += [
        f"no group on {env or 'the environment'} is called best, because runs that trained as long have ended no episode; "
        "the score by evaluation includes those that were evaluated"
        for env in sorted(silent)
    ]
    return curves, silent


def omission_notes(curves: Sequence[Curve]) -> list[str]:
    """Returns a note for each problem of runs in an environment, with the number of runs of each algorithm."""
    members: dict[tuple[str, str], list[RunSummary]] = {}
    for curve in curves:
        members.setdefault((curve.problem, curve.env), []).append(curve.run)
    notes = []
    for (problem, env), runs in members.items():
        counts = Counter(map(algorithm_label, runs))
        algorithms = ", ".join(f"{count} {name}" for name, count in counts.items())
        names = shown(", ".join(run.name for run in runs), 100)
        if len(runs) == 1:
            notes.append(f"{names} has {problem} and is left out")
        else:
            environment = env or "the environment"
            notes.append(f"{len(runs)} runs on {environment} ({algorithms}) have {problem} and are left out: {names}")
    return notes


def warnings_of(curves: Sequence[Curve]) -> list[str]:
    """Returns notes about groups that mix settings, seeds that occur twice, and runs whose episodes are not known."""
    mixed, repeated = [], []
    for (_, label), members in by_group(curves, mixes=False).items():
        runs = [curve.run for curve in members]
        texts = settings(runs)
        mixed += [label] if len({*texts}) > 1 else []
        pairs = [(run.config.seed, text) for run, text in zip(runs, texts, strict=True)]
        seeds = Counter((seed, text) for seed, text in pairs if seed is not None)
        repeated += [label] if seeds and max(seeds.values()) > 1 else []
    notes = [
        f"{shown(label, 100)}: the runs of this group differ in their settings; group by setting to separate them"
        for label in dict.fromkeys(mixed)
    ]
    notes += [
        f"{shown(label, 100)}: runs of this group have the same seed; they count as several, but are not independent"
        for label in dict.fromkeys(repeated)
    ]
    means = sum(not (len(curve.run.episodes) or curve.run.config.hyperparameters.get("offline")) for curve in curves)
    if means:
        notes.append(
            f"{means} of {len(curves)} runs have no episodes on disk; the logged means of their latest episodes are used, or "
            "else their evaluations"
        )
    return notes


def by_group(curves: Sequence[Curve], mixes: bool) -> dict[Key, list[Curve]]:
    """Returns the curves of each group by environment and label; with ``mixes`` a group is of several environments."""
    envs: dict[str, set[str]] = {}
    for curve in curves:
        envs.setdefault(curve.label, set()).add(curve.env)
    keyed: dict[Key, list[Curve]] = {}
    for curve in curves:
        keyed.setdefault((", ".join(sorted(envs[curve.label])) if mixes else curve.env, curve.label), []).append(curve)
    return keyed


def coverage_notes(n_runs: Sequence[int]) -> list[str]:
    """Returns notes on what the intervals of groups of few runs are worth.

    >>> coverage_notes([3, 3, 20])
    ['intervals of few runs are too narrow: those of 3 runs contain the true score in 75 % of cases, not in 95 %']
    """
    single = sum(n == 1 for n in n_runs)
    notes = [f"{single} of {len(n_runs)} groups have one run, so that their intervals say nothing about luck"]
    shares = [
        f"those of {n} runs contain the true score in {statistics.COVERAGE[n]:.0%} of cases".replace("%", " %")
        for n in sorted({*n_runs} & statistics.COVERAGE.keys())
    ]
    few = [f"intervals of few runs are too narrow: {', '.join(shares)}, not in 95 %"]
    return [*(notes if single else []), *(few if shares else [])]


def strata(members: Sequence[Curve], values: Sequence[object]) -> tuple[np.ndarray, ...]:
    """Returns one value of each run as arrays, one for each environment."""
    by_env: dict[str, list[object]] = {}
    for curve, value in zip(members, values, strict=True):
        by_env.setdefault(curve.env, []).append(value)
    return tuple(np.array(by_env[env]) for env in sorted(by_env))


def make_group(
    key: Key,
    members: Sequence[Curve],
    finals: Finals,
    draws: list[np.ndarray],
    threshold: float | None,
    statistic: statistics.Statistic,
    mixed: bool,
) -> Group:
    """Returns a group with its statistics; the levels of its profile are those of all groups of the environment."""
    scores = finals[key]
    peers = np.concatenate([array for peer in finals if peer[0] == key[0] for array in finals[peer]])
    lowest, highest = peers.min(), peers.max()
    margin = 0.0 if lowest < highest else max(1.0, abs(lowest) / 10)  # equal scores are a step
    levels = np.linspace(lowest - margin, highest + margin, N_LEVELS)
    samples = statistics.resampled(scores, draws)
    points = [curve.points() for curve in members]
    curves = strata(members, points)
    low, high = statistics.interval(statistics.iqm(samples))
    with np.errstate(invalid="ignore"):  # points before the first episode
        band = statistics.interval(statistic(statistics.resampled(curves, [rows[:CURVE_SAMPLES] for rows in draws])))
        middle = statistic(curves)
    return Group(
        label=key[1],
        env_id=key[0],
        runs=tuple(curve.run for curve in members),
        scores=scores,
        run_scores=tuple(curve.final() for curve in members),
        score=(float(statistics.iqm(scores)), float(low), float(high)),
        mean=float(statistics.mean(scores)),
        median=float(statistics.median(scores)),
        curve=np.stack([middle, *band]),
        run_curves=np.array(points),
        x=np.linspace(0, 1 if mixed else members[0].end, N_POINTS),
        profile=np.stack([statistics.above(scores, levels), *statistics.interval(statistics.above(samples, levels).T)]),
        levels=levels,
        reached=None if threshold is None else reached(members, points, threshold),
    )


def reached(members: Sequence[Curve], points: Sequence[np.ndarray], threshold: float) -> tuple[int, float]:
    """Returns how many curves reach a threshold, and the median of the steps (or seconds) until they do."""
    times = []
    for curve, values in zip(members, points, strict=True):
        over = np.flatnonzero(values >= threshold)
        times.append(over[0] / (N_POINTS - 1) * curve.end if len(over) else np.inf)
    return int(np.isfinite(times).sum()), float(np.median(times))


def compared(first: Key, second: Key, finals: Finals, draws: Mapping[Key, list[np.ndarray]]) -> Improvement:
    """Returns the probability of improvement of the better of two groups over the other, with its interval."""
    probability = float(statistics.improvement(finals[first], finals[second]))
    if probability < 0.5:
        first, second, probability = second, first, 1 - probability
    samples = [statistics.resampled(finals[key], draws[key]) for key in (first, second)]
    low, high = statistics.interval(statistics.improvement(*samples))
    pairs = sum(len(scores) * len(others) for scores, others in zip(finals[first], finals[second], strict=True))
    return Improvement(first[1], second[1], first[0], probability, float(low), float(high), pairs)


def page_of(comparison: Comparison) -> str:
    """Returns the page of a comparison.

    Raises:
        MissingExtra: if plotly or jinja2 is not installed.
    """
    from rejeu.lab.reporting.report import page

    envs = list(dict.fromkeys(group.env_id for group in comparison.groups))
    labels = list(dict.fromkeys(group.label for group in comparison.groups))
    charts: dict[str, Chart] = {}
    entries: dict[str, list[page.ChartEntry]] = {"curve": [], "profile": []}
    for i, env in enumerate(envs):
        for form in entries:
            key = f"{form}{i}"
            charts[key] = group_chart(form, comparison, env)
            entries[form].append(page.ChartEntry(key, env or "unknown environment"))
    names = {"algorithm": "algorithms", "setting": "settings", "env": "environments"}
    n_runs = sum(len(group.runs) for group in comparison.groups)
    title = f"Comparison of {len(labels)} {names[comparison.by]}" if len(labels) > 1 else labels[0]
    return page.render(
        "compare.html",
        {"charts": charts, "histograms": {}},
        title=title,
        colors=GROUP_COLORS,
        facts=[counted(n_runs, "run"), *(envs if len(envs) <= 3 else [counted(len(envs), "environment")])],
        notes=comparison.notes,
        scores=comparison.text_table(),
        definition=f"{comparison.definition.capitalize()}. Intervals are 95 % stratified bootstrap intervals.",
        curves=entries["curve"],
        profiles=entries["profile"],
        settings=comparison.settings,
        improvements=[improvement.cells for improvement in comparison.improvements[:MAX_LISTED]],
        runs=run_rows(comparison)[:MAX_LISTED],
    )


def run_rows(comparison: Comparison) -> list[list[str]]:
    """Returns one row for each run."""
    rows = []
    for group in comparison.groups:
        for run, score in zip(group.runs, group.run_scores, strict=True):
            seed = "" if run.config.seed is None else str(run.config.seed)
            rows.append([run.name, group.label, run.config.env, seed, run.state, f"{run.steps:,}", number(score)])
    return rows
