"""A leaderboard of a folder of students' models, in English or French.

The files are untrusted: each is evaluated within limits, or named with the reason why not. Every model plays
the same episodes: each in an environment of its own, with the same seeds for all models.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

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

Language = Literal["en", "fr"]
MAX_MODELS = 1_000
"""Upper limit on the models of a folder; the others are left out, with a line that says so."""
MAX_BYTES = 2**28
"""Upper limit on the size of a model."""
TEXTS: dict[str, dict[str, Any]] = {
    "en": {
        "title": "Leaderboard:",
        "columns": ("place", "model", "algorithm", "steps", "seed", "mean return", "95 % CI", "success", "length"),
        "to": "to",
        "episodes": "Episodes of each model: {n}, with the same seeds",
        "places": "Models whose intervals overlap may be equally good: the place is the range that the intervals allow.",
        "none": "No model could be evaluated.",
        "problems": "Not evaluated",
        "other_env": "it was trained on {said}, not on {env_id}",
        "slow": "it needs more than {seconds:g} seconds for {n} episodes",
        "not_finite": "the return of an episode is not a finite number",
        "damaged": "{reason}",
        "more": "{n:,} more files",
        "first": "only the first {n:,} were evaluated",
    },
    "fr": {
        "title": "Classement :",
        "columns": (
            "place",
            "modèle",
            "algorithme",
            "pas",
            "graine",
            "retour moyen",
            "IC à 95 %",
            "succès",
            "longueur",
        ),
        "to": "à",
        "episodes": "Épisodes par modèle : {n}, avec les mêmes graines",
        "places": "Des modèles dont les intervalles se recouvrent peuvent être aussi bons l'un que l'autre : la place est "
        "l'étendue que permettent les intervalles.",
        "none": "Aucun modèle n'a pu être évalué.",
        "problems": "Non évalués",
        "other_env": "il a été entraîné sur {said}, et non sur {env_id}",
        "slow": "il lui faut plus de {seconds:g} secondes pour {n} épisodes",
        "not_finite": "le retour d'un épisode n'est pas un nombre fini",
        "damaged": "le fichier ne peut pas être lu : {reason}",
        "more": "{n} autres fichiers",
        "first": "seuls les {n} premiers ont été évalués",
    },
}
"""The texts of a leaderboard by language."""
NARROW_SPACE = "\N{NARROW NO-BREAK SPACE}"
PROBLEMS = (ArithmeticError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError)
"""Exceptions that a damaged or hostile model can cause."""


@dataclass(frozen=True)
class Model:
    """A model that was evaluated."""

    name: str
    algorithm: str
    steps: int
    """Environment steps of its training."""
    seed: int
    evaluation: Evaluation


@dataclass(frozen=True)
class Row:
    """A model with its places."""

    model: Model
    first: int
    """Best place that the intervals allow: 1 and the number of models whose whole interval is above."""
    last: int
    """Worst place that the intervals allow."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean return; the mean itself for a single episode."""
        return interval_of(self.model.evaluation)


@dataclass(frozen=True)
class Leaderboard:
    """Models by mean return, and those that could not be evaluated."""

    env_id: str
    episodes: int
    rows: tuple[Row, ...]
    problems: tuple[tuple[str, str], ...]
    """Name and reason."""
    language: Language = "en"

    @property
    def texts(self) -> Mapping[str, Any]:
        """The texts in its language."""
        return TEXTS[self.language]


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
    success_threshold: float | None = None,
    language: Language = "en",
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
        success_threshold: return of a successful episode, the same for all models, if the environment does not report success;
            None for the environment's own. That of a file is not used: its author could choose it.
        language: of the leaderboard.
        report: called with a line for each model.
    """
    done: list[Model] = []
    problems = []
    texts = TEXTS[language]
    if len(paths) > MAX_MODELS:
        problems.append((texts["more"].format(n=len(paths) - MAX_MODELS), texts["first"].format(n=MAX_MODELS)))
    with closing(make_vector(episodes)) as env:
        for path in paths[:MAX_MODELS]:
            name = shown(path.relative_to(folder).with_suffix("").as_posix())
            try:
                model = evaluated(name, path, env_id, env, episodes, seed, seconds, success_threshold, texts)
            except Unranked as error:
                reason = str(error)
            except PROBLEMS as error:
                text = str(error).replace(f"{path}: ", "").replace(str(path), "the file") or type(error).__name__
                reason = texts["damaged"].format(reason=shown(" ".join(text.split()), 300))
            else:
                done.append(model)
                report(f"{name}: {model.evaluation}")
                continue
            problems.append((name, reason))
            report(f"{name}: {reason}")
    return Leaderboard(env_id, episodes, ranked(done), tuple(problems), language)


class Unranked(Exception):
    """A model cannot be ranked; the message says why, in the language of the leaderboard."""


def evaluated(
    name: str,
    path: Path,
    env_id: str,
    env: VectorEnv,
    episodes: int,
    seed: int,
    seconds: float,
    success_threshold: float | None,
    texts: Mapping[str, Any],
) -> Model:
    """Returns a model with its evaluation.

    Raises:
        Unranked: if it is of another environment, takes too long, or has returns that are not finite.
        ValueError: if it is damaged.
    """
    said = header(path).get("env_id")
    if said != env_id:
        raise Unranked(texts["other_env"].format(said=shown(said), env_id=env_id))
    end = time.perf_counter() + seconds
    agent = load(path)
    agent.check_spaces(env, env_id)
    choose = policy(agent, deterministic=True)

    def within_budget(obs: Any, started: np.ndarray) -> np.ndarray:
        if time.perf_counter() > end:
            raise Unranked(texts["slow"].format(seconds=seconds, n=episodes))
        return choose(obs, started)

    result = evaluate(within_budget, env, episodes, success_threshold, seed)
    if not np.isfinite(result.returns).all():
        raise Unranked(texts["not_finite"])
    return Model(name, agent.name, agent.num_timesteps, agent.seed, result)


def interval_of(evaluation: Evaluation) -> tuple[float, float]:
    """Returns the 95 % confidence interval of the mean return; the mean twice for a single episode."""
    low, high = evaluation.return_interval
    return (evaluation.mean_return,) * 2 if math.isnan(low) else (low, high)


def ranked(models: Iterable[Model]) -> tuple[Row, ...]:
    """Returns the rows by mean return, with the places that their intervals allow."""
    done = sorted(models, key=lambda one: (-one.evaluation.mean_return, one.name))
    intervals = [interval_of(one.evaluation) for one in done]
    return tuple(
        Row(
            one,
            first=1 + sum(other_low > high for other_low, _ in intervals),
            last=len(done) - sum(other_high < low for _, other_high in intervals),
        )
        for one, (low, high) in zip(done, intervals, strict=True)
    )


def to_dict(board: Leaderboard) -> dict[str, Any]:
    """Returns a leaderboard as JSON values."""
    rows = [
        {
            "name": row.model.name,
            "algorithm": row.model.algorithm,
            "steps": row.model.steps,
            "seed": row.model.seed,
            "places": [row.first, row.last],
            "mean_return": (result := row.model.evaluation).mean_return,
            "return_interval": [*row.interval],
            "success_rate": None if math.isnan(result.success_rate) else result.success_rate,
            "mean_length": result.mean_length,
            "returns": result.returns.tolist(),
        }
        for row in board.rows
    ]
    problems = [{"name": name, "reason": reason} for name, reason in board.problems]
    return {"env_id": board.env_id, "episodes": board.episodes, "models": rows, "not_evaluated": problems}


def markdown(board: Leaderboard) -> str:
    """Returns a leaderboard as a Markdown table."""
    columns = board.texts["columns"]
    rows = [columns, ["---"] * len(columns), *([quoted(cell) for cell in cells_of(row, board)] for row in board.rows)]
    lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    lines += ["", f"{board.env_id}, {board.texts['episodes'].format(n=board.episodes)}.", ""]
    lines += [f"- {quoted(name)}: {quoted(reason)}" for name, reason in board.problems]
    return "\n".join(lines).rstrip() + "\n"


def cells_of(row: Row, board: Leaderboard) -> list[str]:
    """Returns the cells of a row, in the order of the columns."""
    to, result = board.texts["to"], row.model.evaluation
    low, high = row.interval
    place = f"{row.first}" if row.first == row.last else f"{row.first} {to} {row.last}"
    numbers = [
        f"{row.model.steps:,}",
        f"{row.model.seed}",
        f"{result.mean_return:,.1f}",
        f"{low:,.1f} {to} {high:,.1f}",
        "" if math.isnan(result.success_rate) else f"{result.success_rate:.0%}",
        f"{result.mean_length:,.0f}",
    ]
    if board.language == "fr":
        numbers = [one.replace(",", NARROW_SPACE).replace(".", ",").replace("%", f"{NARROW_SPACE}%") for one in numbers]
    return [place, row.model.name, row.model.algorithm, *numbers]


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
    means = [row.model.evaluation.mean_return for row in board.rows]
    bars = [
        [100 * (end - low) / width for end in (*row.interval, mean)]
        for row, mean in zip(board.rows, means, strict=True)
    ]
    rows = [(cells_of(row, board), bar) for row, bar in zip(board.rows, bars, strict=True)]
    return f"{template().render(board=board, texts=board.texts, rows=rows)}\n"


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
