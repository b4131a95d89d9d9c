"""``rejeu course`` writes the notebooks of the courses and grades notebooks; ``rejeu class`` prints a leaderboard."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from rejeu.agents.policy import MOST_ENVS
from rejeu.core import atomic
from rejeu.core.language import chosen, said
from rejeu.core.types import JsonObject
from rejeu.core.validation import whole
from rejeu.lab.cli import dumps
from rejeu.lab.cli.commands import Class, Course
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.environment import from_run
from rejeu.lab.runs.output import echo
from rejeu.logs.formatting import quoted, show_table
from rejeu.teaching.courses import grading, leaderboard, write

MAX_EPISODES = 1_000


def run_course(arguments: Course) -> tuple[int, JsonObject]:
    """Writes or grades notebooks, and prints a line for each file."""
    if arguments.language == "grade":
        return grade(arguments)
    if len(arguments.paths) != 1:
        raise ValueError(f"rejeu course {arguments.language} needs one FOLDER, got {len(arguments.paths)}")
    written: list[Path] = []
    existing: list[Path] = []
    for path, is_new in write(arguments.language, arguments.paths[0]):
        (written if is_new else existing).append(path)
        change = "" if is_new else " exists and was not changed; delete or rename it to get a new copy"
        echo(f"{path}{change}")
    return 0, {"written": written, "kept": existing}


def grade(arguments: Course) -> tuple[int, JsonObject]:
    """Prints which checks each notebook passes; the exit status is 2 if a file could not be graded."""
    grades = []
    for path in arguments.paths:
        notebook = grading.grade(path)
        grades.append(notebook)
        say = partial(said, language=notebook.language)
        echo(say("{}: {}", path, notebook.error or say("{} of {} passed", notebook.n_passed, len(notebook.found))))
        for name, problem in notebook.found.items() if not notebook.error else ():
            if problem != "":
                text = problem or say("its check did not run; is there an error in its cell?")
                echo(say("{}: {}", f"  {name}", text))
    status = 2 if any(notebook.error for notebook in grades) else 0
    return status, {"notebooks": [notebook._asdict() | {"passed": notebook.n_passed} for notebook in grades]}


def run_class(arguments: Class) -> tuple[int, JsonObject]:
    """Evaluates the models in a folder, prints a line for each and the leaderboard, and writes it if asked to."""
    episodes = whole("--episodes", arguments.episodes, 1, MAX_EPISODES)
    formats = {".md": leaderboard.markdown, ".json": lambda board: dumps(leaderboard.to_dict(board)) + "\n"}
    out = arguments.out
    if out is not None and out.suffix not in formats:
        raise ValueError(
            f"--out {out} must end in {' or '.join(formats)}; the page is that of rejeu studio {arguments.folder}"
        )
    paths, language = leaderboard.models(arguments.folder), chosen(arguments.language)
    env_id = "" if arguments.env is not None else leaderboard.usual_env_id(paths)
    environment = from_run(RunConfig(env=env_id), arguments.folder, arguments)
    echo(said("{}, {} episodes of each of {} models", environment, episodes, len(paths), language=language))
    settings = episodes, arguments.seed, 60 * arguments.minutes, arguments.success_threshold
    results = {}
    with closing(environment.vector(min(episodes, MOST_ENVS), "gymnasium", arguments.seed)) as env:
        for path in paths:
            name = leaderboard.name_of(path, arguments.folder, paths)
            results[path] = result = leaderboard.result_of(path, name, environment.env_id, env, *settings)
            echo(said("{}: {}", name, result.said(language), language=language))
    board = leaderboard.board_of(arguments.folder, paths, environment.env_id, episodes, results, language)
    if not arguments.json:
        show_table(leaderboard.columns(language), [leaderboard.cells_of(row, language) for row in board.rows], 3)
        for note in leaderboard.notes(replace(board, problems=())):  # which were printed when they were met
            echo(note)
    echo(said("the page of the class: {}", f"rejeu studio {quoted(arguments.folder)}", language=language))
    if out is not None:
        echo(atomic.write(out, formats[out.suffix](board)))
    return 0, {**leaderboard.to_dict(board), "file": out}
