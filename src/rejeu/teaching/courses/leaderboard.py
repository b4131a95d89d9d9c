"""A leaderboard of a folder of students' models, in English or French.

The files are untrusted: each is evaluated within limits, or named with the reason why not. Every model plays
the same episodes: each in an environment of its own, with the same seeds for all models.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rejeu.agents import load
from rejeu.agents.policy import policy
from rejeu.checkpoints.run_folder import RunFolder, find_model
from rejeu.core import checkpoint, xla
from rejeu.core.language import Language, said
from rejeu.core.records import is_sparse, shown
from rejeu.core.types import JsonObject, Observation
from rejeu.envs.make import VectorEnv
from rejeu.envs.registry import is_plain_id
from rejeu.logs.evaluation import Evaluation, evaluate
from rejeu.logs.formatting import cell, markdown_table

MAX_BYTES = 2**28
"""Upper limit on the size of a model."""
EPISODES = "Episodes of each model: {}, with the same seeds"
NARROW_SPACE = "\N{NARROW NO-BREAK SPACE}"
PROBLEMS = (ArithmeticError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError)
"""Exceptions that a damaged or hostile model can cause."""


class Unranked(ValueError):
    """A model cannot be ranked.

    Args:
        text: why, as :func:`rejeu.core.language.said` takes it.
        values: in that text.
    """

    def __init__(self, text: str, *values: object) -> None:
        super().__init__(text)
        self.text, self.values = text, values

    def said(self, language: Language) -> str:
        """Returns why, in a language."""
        return said(self.text, *self.values, language=language)


@dataclass(frozen=True)
class Entrant:
    """A model that was evaluated."""

    name: str
    algorithm: str
    steps: int
    """Environment steps of its training."""
    seed: int
    evaluation: Evaluation
    first: int = 1
    """Best place that the intervals allow: 1 and the number of models whose whole interval is above."""
    last: int = 1
    """Worst place that the intervals allow."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean return; the mean twice for a single episode."""
        low, high = self.evaluation.return_interval
        return (self.evaluation.mean_return,) * 2 if math.isnan(low) else (low, high)

    def said(self, language: Language) -> str:
        """Returns the result in one line, in a language."""
        titles, cells = columns(language), cells_of(self, language)
        return f"{titles[5]} {cells[5]} ({titles[6]} {cells[6]})"


@dataclass(frozen=True)
class Leaderboard:
    """Models by mean return, and those that could not be evaluated."""

    env_id: str
    episodes: int
    rows: tuple[Entrant, ...]
    problems: tuple[tuple[str, Unranked], ...]
    """Name and reason."""
    language: Language = "en"
    equal: tuple[tuple[str, ...], ...] = ()
    """Names of files with the same bytes."""


COLUMNS = ("place", "model", "algorithm", "steps", "seed", "mean return", "95 % CI", "success rate", "length")


def columns(language: Language) -> list[str]:
    """Returns the titles of the columns."""
    return [said(title, language=language) for title in COLUMNS]


def models(folder: Path) -> list[Path]:
    """Returns the model files in a folder and the folders in it, sorted; symbolic links are not followed.

    A run folder is one model, the best; its checkpoints and the models of the course of its training are none.

    Raises:
        FileNotFoundError: if there is no such folder, or no model in it.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    suffixes = (checkpoint.SUFFIX, ".zip")
    every = (Path(root, name) for root, _, names in os.walk(folder) for name in names)  # also if some cannot be read
    files = (path for path in every if path.suffix in suffixes and os.path.isfile(path) and not path.is_symlink())
    paths = {find_model(file.parent) if is_of_run(file) else file for file in files if not is_passing(file)}
    if not paths:
        raise FileNotFoundError(f"{folder} holds no {' or '.join(suffixes)} files; agent.save(name) writes them")
    return sorted(paths)


def is_passing(path: Path) -> bool:
    """Returns whether a file is of the course of the training of a run."""
    run, inner = RunFolder(path.parent.parent), RunFolder(path.parent)
    is_kept = path.parent == run.models and run.config.is_file()
    return is_kept or path.parent.name == run.checkpoints.name or (path == inner.live and inner.config.is_file())


def is_of_run(path: Path) -> bool:
    """Returns whether a file is one of the models of a run folder."""
    run = RunFolder(path.parent)
    return path in (run.best, run.agent) and run.config.is_file()


def name_of(path: Path, folder: Path, paths: Sequence[Path]) -> str:
    """Returns the name of a model among others: its path in the folder, of a run that of the run."""
    bare = path.parent if is_of_run(path) else path.with_suffix("")
    is_alone = sum(peer.with_suffix("") == bare for peer in paths) <= 1
    return shown((bare if is_alone else path).relative_to(folder).as_posix().replace(".", folder.name, bare == folder))


def equal_files(paths: Sequence[Path]) -> list[list[Path]]:
    """Returns the groups of files with the same bytes."""
    groups: dict[bytes, list[Path]] = {}
    for path in paths:
        with suppress(OSError):
            if 0 < path.stat().st_size <= MAX_BYTES and not is_sparse(path):
                groups.setdefault(hashlib.sha256(path.read_bytes()).digest(), []).append(path)
    return [group for group in groups.values() if len(group) > 1]


def usual_env_id(paths: Sequence[Path]) -> str:
    """Returns the environment that most models were trained on.

    Raises:
        ValueError: if no file says.
    """
    ids: Counter[str] = Counter()
    for path in paths:
        try:
            env_id = header(path).get("env_id")
        except PROBLEMS:
            continue
        if is_plain_id(env_id):
            ids[str(env_id)] += 1
    if not ids:
        raise ValueError("no model says which environment it was trained on; name it: --env ID")
    return ids.most_common(1)[0][0]


def header(path: Path) -> JsonObject:
    """Returns the header of a model file.

    Raises:
        Unranked: if the file is too large.
        ValueError: if it is damaged.
        OSError: if it cannot be read.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise Unranked("the file has {:,.0f} MiB, expected {} MiB at most", size / 2**20, MAX_BYTES >> 20)
    return dict(checkpoint.read_header(path, "agent"))


def board_of(
    folder: Path,
    paths: Sequence[Path],
    env_id: str,
    episodes: int,
    results: Mapping[Path, Entrant | Unranked],
    language: Language,
) -> Leaderboard:
    """Returns the leaderboard of the models that have a result.

    Args:
        folder: the names of the models are their paths in it.
        paths: the models.
        env_id: the environment that they were evaluated in.
        episodes: episodes of each model.
        results: the results by path.
        language: of the leaderboard.
    """
    problems = [(name_of(path, folder, paths), entry) for path, entry in results.items() if isinstance(entry, Unranked)]
    equal = tuple(tuple(name_of(path, folder, paths) for path in group) for group in equal_files(paths))
    rows = ranked(result for result in results.values() if isinstance(result, Entrant))
    return Leaderboard(env_id, episodes, rows, tuple(problems), language, equal)


def result_of(
    path: Path,
    name: str,
    env_id: str,
    env: VectorEnv,
    episodes: int,
    seed: int,
    seconds: float,
    success_threshold: float | None,
) -> Entrant | Unranked:
    """Returns a model with its evaluation, or why it has none.

    Args:
        path: the model.
        name: its name on the leaderboard.
        env_id: the environment that it must have been trained on.
        env: the environments, at most as many as episodes, which play them in turns. Each episode has a seed of its own.
        episodes: number of episodes.
        seed: seed of the environments, the same for all models.
        seconds: time of the model, without compilation.
        success_threshold: return of a successful episode, the same for all models, if the environment does not report success;
            None for the environment's own. That of a file is not used: its author could choose it.
    """
    try:
        trained_on = header(path).get("env_id")
        if trained_on != env_id:
            return Unranked("it was trained on {}, not on {}", shown(trained_on), env_id)
        end = xla.clock() + seconds
        agent = load(path)
        try:
            env.limit_actions(agent.config.action_share)
            agent.check_spaces(env, env_id)
        except ValueError as error:
            return Unranked("its spaces are others: {0}", error, env_id)
        choose = policy(agent, deterministic=True)

        def within_budget(obs: Observation, started: np.ndarray) -> np.ndarray:
            if xla.clock() > end:
                raise Unranked("it needs more than {:g} seconds for {} episodes", seconds, episodes)
            return choose(obs, started)

        evaluations = list[Evaluation]()
        for n_done in range(0, episodes, env.n_envs):
            n = min(env.n_envs, episodes - n_done)  # which the last n environments play
            of_first = seed + n_done + n - env.n_envs
            evaluations.append(evaluate(within_budget, env, n, success_threshold, of_first))
        columns = ("returns", "lengths", "successes")
        arrays = [np.concatenate([getattr(evaluation, column) for evaluation in evaluations]) for column in columns]
        result = Evaluation(arrays[0], arrays[1], arrays[2], sum(evaluation.cut for evaluation in evaluations))
        if not np.isfinite(result.returns).all():
            return Unranked("the return of an episode is not a finite number")
        return Entrant(name, agent.name, agent.num_timesteps, agent.seed, result)
    except Unranked as error:
        return error
    except PROBLEMS as error:
        text = str(error).replace(f"{path}: ", "").replace(str(path), "the file") or type(error).__name__
        return Unranked("it cannot be evaluated: {}", shown(" ".join(text.split()), 300))


def ranked(models: Iterable[Entrant]) -> tuple[Entrant, ...]:
    """Returns the models by mean return, with the places that their intervals allow."""
    done = sorted(models, key=lambda model: (-model.evaluation.mean_return, model.name))
    lows, highs = np.array([model.interval for model in done]).reshape(-1, 2).T
    return tuple(
        replace(model, first=1 + int(np.sum(lows > model.interval[1])), last=int(np.sum(highs >= model.interval[0])))
        for model in done
    )


def to_dict(board: Leaderboard) -> JsonObject:
    """Returns a leaderboard as JSON values."""
    rows = [
        {
            **{name: getattr(row, name) for name in ("name", "algorithm", "steps", "seed")},
            "places": [row.first, row.last],
            "mean_return": (result := row.evaluation).mean_return,
            "return_interval": [*row.interval],
            "success_rate": None if math.isnan(result.success_rate) else result.success_rate,
            "mean_length": result.mean_length,
            "returns": result.returns.tolist(),
        }
        for row in board.rows
    ]
    problems = [{"name": name, "reason": reason.said(board.language)} for name, reason in board.problems]
    return {
        "env_id": board.env_id,
        "episodes": board.episodes,
        "models": rows,
        "not_evaluated": problems,
        "equal_files": board.equal,
    }


def markdown(board: Leaderboard) -> str:
    """Returns a leaderboard as a Markdown table."""
    rows = [cells_of(row, board.language) for row in board.rows]
    lines = [markdown_table(columns(board.language), rows), ""]
    lines += [f"{board.env_id}, {said(EPISODES, board.episodes, language=board.language)}.", ""]
    lines += [f"- {cell(line)}" for line in notes(board)]
    return "\n".join(lines).rstrip() + "\n"


def notes(board: Leaderboard) -> list[str]:
    """Returns a line for each model without a place, and for each group of equal files."""
    say = partial(said, language=board.language)
    lines = [say("{}: {}", name, reason.said(board.language)) for name, reason in board.problems]
    return lines + [say("The same file: {}", ", ".join(names)) for names in board.equal]


def cells_of(row: Entrant, language: Language) -> list[str]:
    """Returns the cells of a row, in the order of the columns."""
    to, result = partial(said, "{} to {}", language=language), row.evaluation
    low, high = row.interval
    places = f"{row.first}" if row.first == row.last else to(row.first, row.last)
    numbers = [
        f"{row.steps:,}",
        f"{row.seed}",
        f"{result.mean_return:,.1f}",
        to(f"{low:,.1f}", f"{high:,.1f}"),
        "" if math.isnan(result.success_rate) else f"{result.success_rate:.0%}",
        f"{result.mean_length:,.0f}",
    ]
    return [places, row.name, row.algorithm, *(written(number, language) for number in numbers)]


def written(number: str, language: Language) -> str:
    """Returns a number as it is written in a language, from how it is written in English."""
    if language == "en":
        return number
    return number.replace(",", NARROW_SPACE).replace(".", ",").replace("%", f"{NARROW_SPACE}%")
