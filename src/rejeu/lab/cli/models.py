"""``rejeu evaluate``, ``record``, ``export``, ``watch``, ``play``, ``import``, ``push`` and ``pull``: models and agents."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejeu.agents import Agent, load
from rejeu.agents.exporting import export
from rejeu.agents.policy import MOST_ENVS
from rejeu.checkpoints.run_folder import RunFolder, find_model
from rejeu.core import checkpoint, devices
from rejeu.core.errors import CheckpointError
from rejeu.core.types import Action, JsonObject
from rejeu.export import FORMATS, target_of
from rejeu.lab.cli.commands import Evaluate, Export, Import, Play, Pull, Push, Record, Watch, Which
from rejeu.lab.runs.config import value
from rejeu.lab.runs.environment import Environment, environment_of, from_arguments
from rejeu.lab.runs.output import echo
from rejeu.logs.formatting import counted, quoted
from rejeu.logs.video import record_video

if TYPE_CHECKING:
    from rejeu.teaching.play import Game


def run_evaluate(arguments: Evaluate) -> tuple[int, JsonObject]:
    """Evaluates an agent on whole episodes and prints the result."""
    devices.start_with("--device", arguments.device)
    episodes, minutes = arguments.episodes, arguments.minutes
    model = find_model(arguments.run, arguments.best_or_last)
    environment = environment_of(model, arguments)
    agent = load(model, device=arguments.device)
    n_envs = min(episodes or MOST_ENVS, MOST_ENVS)
    with closing(environment.vector(n_envs, arguments.backend, arguments.seed)) as env:
        echo(f"{environment} on {env.backend}, {model}")
        evaluation = agent.evaluate(episodes, env=env, success_threshold=arguments.success_threshold, minutes=minutes)
        echo(evaluation)
    each = {"returns": evaluation.returns, "lengths": evaluation.lengths, "successes": evaluation.successes}
    facts = {"model": model, "env_id": environment.env_id, "backend": env.backend}
    return 0, {**facts, **evaluation.to_dict(), **each}


def run_record(arguments: Record) -> tuple[int, JsonObject]:
    """Records a video of an agent and prints its path."""
    model = find_model(arguments.run, arguments.best_or_last)
    default = RunFolder(arguments.run).video if arguments.run.is_dir() else model.with_suffix(".mp4")
    out = default if arguments.out is None else arguments.out
    environment = environment_of(model, arguments)
    path = record_video(load(model), out, env=environment.rendering, episodes=arguments.episodes, seed=arguments.seed)
    echo(f"{path}: {counted(arguments.episodes, 'episode')} of {model} in {environment}")
    return 0, {"video": path, "episodes": arguments.episodes, "model": model, "env_id": environment.env_id}


def run_export(arguments: Export) -> tuple[int, JsonObject]:
    """Writes the policy of an agent to a file of another format, and prints how it compares with ``predict``."""
    model = find_model(arguments.run, arguments.best_or_last)
    out, to = arguments.out, arguments.to
    if out is None or out.is_dir():
        to = to or "onnx"
        beside = model.parent / "policy" if arguments.run.is_dir() else model.with_suffix("")
        out = (beside if out is None else out / beside.name).with_suffix(FORMATS[target_of(out or beside, to)].suffix)
    target_of(out, to)  # an error before the agent is loaded
    environment = None
    try:
        environment = environment_of(model, arguments)
    except (CheckpointError, ImportError, ValueError) as error:
        if arguments.env is not None:
            raise
        echo(f"the observations are sampled from the observation space, because there is no environment: {error}")
    agent, make_env = load(model), None if environment is None else environment.make
    if arguments.env is not None and environment is not None and not environment.wrappers:
        agent.trained_on = environment.env_id, environment.run.env_kwargs
    exported = export(
        agent, out, to, arguments.noise, arguments.batch, make_env, str(arguments.run), arguments.frame_stack
    )
    echo(exported)
    return 0, exported.to_dict()


def run_watch(arguments: Watch) -> tuple[int, JsonObject | None]:
    """Shows an agent in a window, and prints its scores; or two in the web browser."""
    from rejeu.teaching.play import watch

    if len(arguments.runs) > 1:
        return watch_together(arguments)
    model = find_model(arguments.runs[0], arguments.best_or_last)
    environment = environment_of(model, arguments)
    game = watch(load(model), environment.make, seed=arguments.seed, fps=arguments.fps, episodes=arguments.episodes)
    echo(scores(game))
    return 0, as_dict(game)


def watch_together(arguments: Watch) -> tuple[int, None]:
    """Shows two agents side by side in the studio.

    Raises:
        ValueError: for more than two, twice the same, or options of the window.
    """
    from rejeu.lab.cli.studio import open_studio

    if len(arguments.runs) > 2 or arguments.runs[0] == arguments.runs[1]:
        raise ValueError("rejeu watch takes one or two different agents; rejeu studio compares more")
    if arguments.fps is not None or arguments.episodes is not None:
        raise ValueError("--fps and --episodes are for one agent, in a window; leave them out")
    models = [find_model(run, arguments.best_or_last) for run in arguments.runs]
    pairs = zip(arguments.runs, models, strict=True)
    guests = {str(run): (model, environment_of(model, arguments)) for run, model in pairs}
    seed = [] if arguments.seed is None else [("seed", str(arguments.seed))]
    page = "/play", [*(("agent", name) for name in guests), ("watch", "1"), *seed]
    open_studio(Path("runs"), guests=guests, page=page, options=arguments)
    return 0, None


def run_play(arguments: Play) -> tuple[int, JsonObject]:
    """Lets a person play, alone or next to an agent, and prints the scores."""
    from rejeu.teaching.play import play
    from rejeu.teaching.play.keys import full_name

    environment = from_arguments(full_name(arguments.env), arguments)
    against = arguments.against
    agent = None if against is None else agent_of("--against", against, arguments.best_or_last, environment)
    options = {name: getattr(arguments, name) for name in ("seed", "fps", "episodes", "record")}
    game = play(environment.make, keys=parse_keys(arguments.keys), against=agent, **options)
    echo(scores(game))
    if (recording := game.players[0].recording) is not None:
        echo(recording)
    return 0, as_dict(game)


def agent_of(option: str, run: Path, best_or_last: Which, environment: Environment, device: str = "auto") -> Agent:
    """Returns the agent of a run folder or model file that an option names.

    Raises:
        ValueError: if it was trained on another environment.
    """
    model = find_model(run, best_or_last)
    if (trained_on := checkpoint.read_header(model, "agent").get("env_id")) != environment.env_id:
        raise ValueError(f"{option} {run}: that agent plays {trained_on}, not {environment.env_id}")
    return load(model, device=device)


def parse_keys(assignments: Iterable[str]) -> dict[str, Action]:
    """Returns the action of each combination of keys.

    Raises:
        ValueError: for an assignment without ``=``.

    >>> parse_keys(["a=0", "a+w=[1,-0.5]", "none=wait"])
    {'a': 0, 'a+w': [1, -0.5], 'none': 'wait'}
    """
    result = {}
    for assignment in assignments:
        keys, equals, text = assignment.rpartition("=")
        if not equals or not keys:
            raise ValueError(f"--keys {assignment!r} must be keys=action, such as a=0 or a+w=[1,-1]")
        result[keys.strip()] = value(text)
    return result


def as_dict(game: Game) -> JsonObject:
    """Returns the players with their scores."""
    facts = [(player.name, len(player.scores), player.mean, player.best, player.scores) for player in game.players]
    names = ("name", "episodes", "mean", "best", "scores")
    return {"players": [dict(zip(names, values, strict=True)) for values in facts]}


def scores(game: Game) -> str:
    """Returns a line for each player: number of complete episodes, mean and best score."""
    lines = []
    for player in game.players:
        n = len(player.scores)
        episodes = counted(n, "episode")
        lines.append(f"{player.name}: {episodes}" + (f", mean {player.mean:.2f}, best {player.best:.2f}" if n else ""))
    return "\n".join(lines)


def run_import(arguments: Import) -> tuple[int, JsonObject]:
    """Converts a model of Stable-Baselines3 and prints what was taken over."""
    from rejeu.agents.zip_files import load_zip
    from rejeu.agents.zoo import model_in

    model = arguments.model
    model = model_in(model, arguments.best_or_last) if model.is_dir() else model
    statistics: Any = False if str(arguments.vecnormalize) == "none" else arguments.vecnormalize
    out = model.with_suffix(".safetensors") if arguments.out is None else arguments.out
    if out.exists():
        raise FileExistsError(f"{out} exists; name another file with --out")
    env = None if arguments.env is None else from_arguments(arguments.env, arguments).vector(1, "auto", None)
    with nullcontext() if env is None else closing(env):
        agent = load_zip(model, env, statistics, **arguments.hyperparameters)
        path = agent.save(out)
    echo(f"{path}: {agent.name}, {counted(agent.num_timesteps, 'step')}, {counted(agent.n_updates, 'update')}")
    for note in agent.notes:
        echo(f"note: {note}")
    return 0, {"model": path, "algorithm": agent.name, "notes": agent.notes}


def run_push(arguments: Push) -> tuple[int, JsonObject]:
    """Uploads a model, or writes the files that would be, and prints where they are."""
    from rejeu.lab import hub

    if arguments.out is not None:
        hub.lay_out(arguments.run, arguments.out, arguments.repo, echo)
        echo(f"{arguments.out}: {', '.join(sorted(path.name for path in arguments.out.iterdir()))}")
        return 0, {"folder": arguments.out}
    address = hub.push(arguments.run, arguments.repo, arguments.private, echo)
    echo(address)
    return 0, {"address": address}


def run_pull(arguments: Pull) -> tuple[int, JsonObject]:
    """Downloads a model and prints what to do with it."""
    from rejeu.lab import hub

    folder = hub.pull(arguments.repo, arguments.out)
    models = sorted([*folder.glob("*.safetensors"), *folder.glob("*.zip")])
    for model in models:
        echo(f"rejeu {'import' if model.suffix == '.zip' else 'evaluate'} {quoted(model)}")
    return 0, {"folder": folder, "models": models}
