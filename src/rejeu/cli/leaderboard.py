"""``rejeu class``: a leaderboard of the models in a folder."""

from __future__ import annotations

from functools import partial

from rejeu.cli import environment, jsonout
from rejeu.cli.commands import Class
from rejeu.courses import leaderboard
from rejeu.io import atomic
from rejeu.validation import whole

MAX_EPISODES = 1_000


def run(arguments: Class) -> int:
    """Evaluates the models, prints a line for each, writes the leaderboard and returns the exit status."""
    episodes = whole("--episodes", arguments.episodes, 1, MAX_EPISODES)
    formats = {".html": leaderboard.page, ".md": leaderboard.markdown, ".json": as_json}
    out = arguments.out
    if out.suffix not in formats:
        raise ValueError(f"--out {out} must end in {', '.join(formats)}")
    paths = leaderboard.models(arguments.folder)
    if out.suffix == ".html":
        leaderboard.template()  # a missing package is named before the evaluations
    made = environment.from_arguments(arguments.env or leaderboard.usual_env_id(paths), arguments)
    with jsonout.messages(arguments.json) as output:
        print(f"{made}, {episodes} episodes of each of {len(paths)} models", flush=True)
        board = leaderboard.build(
            arguments.folder,
            paths,
            made.env_id,
            lambda n: made.vector(n, "gymnasium", arguments.seed),
            episodes,
            arguments.seed,
            60 * arguments.minutes,
            arguments.success_threshold,
            arguments.language,
            partial(print, flush=True),
        )
        text = formats[out.suffix](board)
        with atomic.replacing(out) as file:
            file.write(text.encode())
        print(out, flush=True)
        if arguments.json:
            jsonout.emit({**leaderboard.to_dict(board), "file": out}, output)
    return 0


def as_json(board: leaderboard.Leaderboard) -> str:
    """Returns a leaderboard as JSON text."""
    return jsonout.dumps(leaderboard.to_dict(board)) + "\n"
