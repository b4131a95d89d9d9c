"""A leaderboard of a folder of students' models.

The files are untrusted: each is evaluated within limits, or named with the reason why not. Every model plays
the same episodes: each in an environment of its own, with the same seeds for all models.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.agents import load
from rejeu.agents.policy import policy
from rejeu.envs.make import VectorEnv
from rejeu.envs.registry import is_plain_id
from rejeu.errors import MissingExtra
from rejeu.io import checkpoint
from rejeu.io.records import shown
from rejeu.reporting.evaluation import Evaluation, evaluate

if TYPE_CHECKING:
    from jinja2 import Template

MAX_MODELS = 1_000
"""Upper limit on the models of a folder; the others are left out, with a line that says so."""
MAX_BYTES = 2**28
"""Upper limit on the size of a model."""
PROBLEMS = (ArithmeticError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError)
"""Exceptions that a damaged or hostile model can cause."""


@dataclass(frozen=True)
class Row:
    """A model that was evaluated."""

    name: str
    algorithm: str
    evaluation: Evaluation
    first: int
    """Best place that the intervals allow: 1 and the number of models whose whole interval is above."""
    last: int
    """Worst place that the intervals allow."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean return; the mean itself for a single episode."""
        return interval_of(self.evaluation)

    @property
    def place(self) -> str:
        """The places that the intervals allow, such as ``1`` or ``2 to 4``."""
        return f"{self.first}" if self.first == self.last else f"{self.first} to {self.last}"


@dataclass(frozen=True)
class Leaderboard:
    """Models by mean return, and those that could not be evaluated."""

    env_id: str
    episodes: int
    rows: tuple[Row, ...]
    problems: tuple[tuple[str, str], ...]
    """Name and reason."""


def models(folder: Path) -> list[Path]:
    """Returns the model files in a folder and the folders in it, sorted; symbolic links are not followed.

    The checkpoints of a run folder are no models.

    Raises:
        FileNotFoundError: if there is no such folder, or no model in it.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    files = (path for path in folder.rglob("*.safetensors") if path.is_file() and not path.is_symlink())
    found = sorted(path for path in files if path.parent.name != "checkpoints")
    if not found:
        raise FileNotFoundError(f"{folder} holds no .safetensors files; agent.save(name) writes them")
    return found


def usual_env_id(paths: Sequence[Path]) -> str:
    """Returns the environment that most models were trained on.

    Raises:
        ValueError: if no file says.
    """
    ids: Counter[str] = Counter()
    for path in paths[:MAX_MODELS]:
        try:
            env_id = header(path).get("env_id")
        except PROBLEMS:
            continue
        if is_plain_id(env_id):
            ids[str(env_id)] += 1
    if not ids:
        raise ValueError("no model says which environment it was trained on; name it: --env ID")
    return ids.most_common(1)[0][0]


def header(path: Path) -> dict[str, Any]:
    """Returns the header of a model file.

    Raises:
        ValueError: if the file is too large or damaged.
        OSError: if it cannot be read.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"the file has {size / 2**20:,.0f} MiB, expected {MAX_BYTES >> 20} MiB at most")
    return dict(checkpoint.read_header(path, "agent"))


def build(
    folder: Path,
    paths: Sequence[Path],
    env_id: str,
    make_vector: Callable[[int], VectorEnv],
    episodes: int,
    seed: int,
    seconds: float,
    report: Callable[[str], None] = print,
) -> Leaderboard:
    """Evaluates every model, and returns the leaderboard.

    Args:
        folder: the names of the models are their paths in it.
        paths: the models.
        env_id: the environment that they must have been trained on.
        make_vector: makes a number of environments.
        episodes: episodes of each model.
        seed: seed of the environments, the same for all models.
        seconds: wall time of each model. One that takes longer is not ranked.
        report: called with a line for each model.
    """
    done: list[tuple[str, str, Evaluation]] = []
    problems = []
    if len(paths) > MAX_MODELS:
        problems.append((f"{len(paths) - MAX_MODELS:,} more files", f"only the first {MAX_MODELS:,} were evaluated"))
    with closing(make_vector(episodes)) as env:
        for path in paths[:MAX_MODELS]:
            name = shown(path.relative_to(folder).with_suffix("").as_posix())
            try:
                algorithm, result = evaluated(path, env_id, env, episodes, seed, seconds)
            except PROBLEMS as error:
                text = str(error).replace(f"{path}: ", "").replace(str(path), "the file") or type(error).__name__
                reason = shown(" ".join(text.split()), 300)
                problems.append((name, reason))
                report(f"{name}: {reason}")
            else:
                done.append((name, algorithm, result))
                report(f"{name}: {result}")
    return Leaderboard(env_id, episodes, ranked(done), tuple(problems))


def evaluated(
    path: Path, env_id: str, env: VectorEnv, episodes: int, seed: int, seconds: float
) -> tuple[str, Evaluation]:
    """Returns the algorithm of a model and its evaluation.

    Raises:
        ValueError: if it is of another environment, or damaged.
        TimeoutError: if it takes too long.
    """
    said = header(path).get("env_id")
    if said != env_id:
        raise ValueError(f"it was trained on {shown(said)}, not on {env_id}")
    end = time.perf_counter() + seconds
    agent = load(path)
    agent.check_spaces(env, env_id)
    choose = policy(agent, deterministic=True)

    def within_budget(obs: Any, started: np.ndarray) -> np.ndarray:
        if time.perf_counter() > end:
            raise TimeoutError(f"it needs more than {seconds:g} seconds for {episodes} episodes")
        return choose(obs, started)

    return agent.name, evaluate(within_budget, env, episodes, agent.success_threshold, seed)


def interval_of(evaluation: Evaluation) -> tuple[float, float]:
    """Returns the 95 % confidence interval of the mean return; the mean twice for a single episode."""
    low, high = evaluation.return_interval
    return (evaluation.mean_return,) * 2 if math.isnan(low) else (low, high)


def ranked(done: Sequence[tuple[str, str, Evaluation]]) -> tuple[Row, ...]:
    """Returns the rows by mean return, with the places that their intervals allow."""
    done = sorted(done, key=lambda one: (-one[2].mean_return, one[0]))
    intervals = [interval_of(evaluation) for *_, evaluation in done]
    return tuple(
        Row(
            *one,
            first=1 + sum(other_low > high for other_low, _ in intervals),
            last=len(done) - sum(other_high < low for _, other_high in intervals),
        )
        for one, (low, high) in zip(done, intervals, strict=True)
    )


def to_dict(board: Leaderboard) -> dict[str, Any]:
    """Returns a leaderboard as JSON values."""
    rows = [
        {
            "name": row.name,
            "algorithm": row.algorithm,
            "places": [row.first, row.last],
            "mean_return": row.evaluation.mean_return,
            "return_interval": [*row.interval],
            "success_rate": None if math.isnan(row.evaluation.success_rate) else row.evaluation.success_rate,
            "mean_length": row.evaluation.mean_length,
            "returns": row.evaluation.returns.tolist(),
        }
        for row in board.rows
    ]
    problems = [{"name": name, "reason": reason} for name, reason in board.problems]
    return {"env_id": board.env_id, "episodes": board.episodes, "models": rows, "not_evaluated": problems}


def markdown(board: Leaderboard) -> str:
    """Returns a leaderboard as a Markdown table."""
    lines = [
        "| place | model | algorithm | mean return | 95 % CI | success | length |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in board.rows:
        cells = (row.place, quoted(row.name), quoted(row.algorithm), *cells_of(row))
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", f"{board.env_id}, {board.episodes} episodes of each model, with the same seeds.", ""]
    lines += [f"- {quoted(name)}: {quoted(reason)}" for name, reason in board.problems]
    return "\n".join(lines).rstrip() + "\n"


def cells_of(row: Row) -> Iterator[str]:
    """Yields mean return, its interval, success rate and mean length of a row."""
    low, high = row.interval
    yield f"{row.evaluation.mean_return:,.1f}"
    yield f"{low:,.1f} to {high:,.1f}"
    yield "" if math.isnan(row.evaluation.success_rate) else f"{row.evaluation.success_rate:.0%}"
    yield f"{row.evaluation.mean_length:,.0f}"


def quoted(text: str) -> str:
    r"""Returns a text that Markdown shows as it is.

    >>> quoted("a|b <b>*x*")
    'a\\|b &lt;b&gt;\\*x\\*'
    """
    return "".join(f"\\{c}" if c in "\\|*_[]`#~!" else c for c in escape(text, quote=False))


def page(board: Leaderboard) -> str:
    """Returns a leaderboard as an HTML page that needs no network.

    Raises:
        MissingExtra: if Jinja2 is not installed.
    """
    ends = [end for row in board.rows for end in row.interval] or [0.0]
    low, width = min(ends), max(max(ends) - min(ends), 1e-9)
    bars = [[100 * (end - low) / width for end in (*row.interval, row.evaluation.mean_return)] for row in board.rows]
    rows = [(row, [*cells_of(row)], bar) for row, bar in zip(board.rows, bars, strict=True)]
    return f"{template().render(board=board, rows=rows)}\n"


def template() -> Template:
    """Returns the template of the page.

    Raises:
        MissingExtra: if Jinja2 is not installed.
    """
    try:
        from jinja2 import Environment
    except ImportError:
        raise MissingExtra("the page", "jinja2", "course") from None
    text = (resources.files("rejeu.courses") / "leaderboard.html").read_text(encoding="utf-8")
    return Environment(autoescape=True).from_string(text)
