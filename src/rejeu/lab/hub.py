"""Models on the Hugging Face hub, or another server with its interface: a run folder as a repository, and back.

Nothing from a repository is executed: files are downloaded by a list of names, and a model is read like any other file.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path, PureWindowsPath
from typing import Any

from rejeu.agents import load, zip_files
from rejeu.agents.agent import Agent
from rejeu.checkpoints import pickled
from rejeu.checkpoints.run_folder import check_free, find_model
from rejeu.core import atomic
from rejeu.core.errors import requires
from rejeu.core.records import brief
from rejeu.core.types import JsonObject
from rejeu.core.validation import assign
from rejeu.lab.reporting import run_list
from rejeu.lab.runs import read as runs
from rejeu.logs import statistics
from rejeu.logs.formatting import counted

VIDEO = "video.mp4"
FILES = ("config.json", "episodes.csv", "metrics.csv", "evaluations.csv", "curve.png", VIDEO)
"""Files of a run folder that are pushed, besides the model."""
FULL_PATH = re.compile(r'"(?:/|[A-Za-z]:[/\\]|\\\\)(?:[^"\\]|\\.)*"')
"""A text of JSON that is a full path."""
MODEL, ONNX, CARD = "agent.safetensors", "policy.onnx", "README.md"
WANTED = (*FILES, MODEL, ONNX, f"{ONNX}.json", CARD, "*.zip", "*.pkl", "args.yml", "config.yml", "env_kwargs.yml")
"""Files that are pulled."""


@contextmanager
def interface() -> Iterator[Any]:
    """Yields the module ``huggingface_hub``, and turns its errors into ``OSError`` and ``ValueError`` of one line.

    Raises:
        MissingExtra: if it is not installed.
    """
    with requires("the hub", "huggingface-hub", "hub"):
        import huggingface_hub
        from huggingface_hub import errors
    transport: Any = errors.HfHubHTTPError.__bases__[0]  # of the library for HTTP, which depends on the version
    try:
        yield huggingface_hub
    except errors.HFValidationError as error:
        raise ValueError(f"not the name of a repository, such as USER/MODEL: {brief(error)}") from None
    except (errors.HfHubHTTPError, errors.LocalTokenNotFoundError) as error:
        raise OSError(f"the hub answered: {brief(error)}; hf auth login signs in") from None
    except transport as error:
        raise OSError(f"the hub cannot be reached: {brief(error)}") from None


def push(source: str | Path, repo: str, private: bool = False, note: Callable[[str], Any] = print) -> str:
    """Writes a model and the record of its training to a repository, which is created; returns its address.

    The repository gets the best model, an ONNX file if ``rejeu[export]`` is installed, the tables, the learning curve and
    the video of the run, and a card. Server and token are those of ``huggingface_hub`` (``HF_ENDPOINT``, ``HF_TOKEN``).

    Args:
        source: a run folder or a model file.
        repo: ``USER/NAME``.
        private: of a new repository.
        note: called with a line about what was left out.

    Raises:
        FileNotFoundError: if there is no model.
        CheckpointError: if the model is damaged.
        OSError: if the hub cannot be reached or refuses.
        MissingExtra: if ``huggingface-hub`` is not installed.
    """
    with tempfile.TemporaryDirectory() as folder, interface() as hub:
        agent = lay_out(source, Path(folder), repo, note)
        api = hub.HfApi()
        address = api.create_repo(repo, private=private or None, exist_ok=True)
        message = f"{agent.name}, {counted(agent.num_timesteps, 'step')}"
        api.upload_folder(repo_id=repo, folder_path=folder, commit_message=message)
    return str(address)


def lay_out(source: str | Path, folder: Path, repo: str, note: Callable[[str], Any] = print) -> Agent:
    """Writes the files of a repository to a new or empty folder, and returns the agent.

    The other arguments and errors are those of :func:`push`. The video of a model file has its name, as ``rejeu record``
    writes it.

    Raises:
        FileExistsError: if the folder holds something.
    """
    source = Path(source)
    model = find_model(source)
    agent = load(model)
    check_free(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(model, folder / MODEL)
    files = [source / name for name in FILES] if source.is_dir() else [source.with_suffix(".mp4")]
    for path in filter(runs.is_file, files):
        shutil.copyfile(path, folder / (path.name if source.is_dir() else VIDEO))
    if dataset := getattr(agent.config, "demonstrations", None):  # where it lies on this machine concerns nobody else
        assign(agent.config, demonstrations=Path(dataset).name)
        agent.save(folder / MODEL)
    for path in folder.glob("config.json"):  # nor where the file of an environment does, or another run
        name = lambda match: json.dumps(PureWindowsPath(json.loads(match[0])).name)  # noqa: E731
        atomic.write(path, FULL_PATH.sub(name, path.read_text("utf-8")))
    try:
        agent.export(folder / ONNX)
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        note(f"without {ONNX}: {brief(error)}")
    names = {path.name for path in folder.iterdir()}
    (folder / CARD).write_text(card(agent, repo, source, names), encoding="utf-8")
    return agent


def pull(repo: str, out: str | Path | None = None) -> Path:
    """Downloads a repository to a new folder, checks its model, and returns the folder.

    Only the files are downloaded that :func:`push` writes, and zip files of Stable-Baselines3 with their statistics.

    Args:
        repo: ``USER/NAME``.
        out: the folder; by default NAME.

    Raises:
        FileExistsError: if the folder exists and holds something.
        FileNotFoundError: if the repository has no model.
        CheckpointError: if the model is damaged; no folder is left.
        OSError: if the hub cannot be reached or refuses.
        MissingExtra: if ``huggingface-hub`` is not installed.
    """
    out = Path(repo.rpartition("/")[2] if out is None else out)
    check_free(out)
    parent = out.absolute().parent
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=parent) as temporary, interface() as hub:
        room = Path(temporary) / "model"
        names = [name for name in hub.HfApi().list_repo_files(repo) if is_wanted(name)]
        if MODEL not in names and not any(name.endswith(".zip") for name in names):
            raise FileNotFoundError(f"{repo} has no {MODEL}, and no zip file of Stable-Baselines3")
        for name in names:
            hub.hf_hub_download(repo, name, local_dir=room)
        shutil.rmtree(room / ".cache", ignore_errors=True)
        if MODEL in names:
            load(room / MODEL)
        for path in room.glob("*.zip"):
            with pickled.explained(path):
                zip_files.read(path)
        out.mkdir(exist_ok=True)  # which may be the current folder, or a link to one
        for path in room.iterdir():
            path.rename(out / path.name)
    return out


def is_wanted(name: str) -> bool:
    """Returns whether a file of a repository is downloaded: one of :data:`WANTED`, and in no folder."""
    is_plain = name.isprintable() and len(name) <= 200 and not {"/", "\\", ":"} & {*name}
    return is_plain and any(fnmatchcase(name, pattern) for pattern in WANTED)


def card(agent: Agent, repo: str, source: Path, names: set[str]) -> str:
    """Returns the model card: Markdown after a table of metadata that the hub reads.

    Args:
        agent: the model.
        repo: ``USER/NAME``.
        source: its run folder or file.
        names: of the other files in the repository.
    """
    env_id = agent.trained_on[0] if agent.trained_on is not None else "an unknown environment"
    evaluation = evaluated(source)
    header: JsonObject = {"library_name": "rejeu", "tags": ["reinforcement-learning", "rejeu", agent.name, env_id]}
    if evaluation is not None:
        metric = {"type": "mean_reward", "name": "mean return", "value": evaluation[1]}
        task, dataset = {"type": "reinforcement-learning"}, {"name": env_id, "type": env_id}
        results = [{"task": task, "dataset": dataset, "metrics": [metric]}]
        header["model-index"] = [{"name": agent.name, "results": results}]
    lines = ["---", *(f"{key}: {json.dumps(value)}" for key, value in header.items()), "---", ""]  # JSON is YAML
    lines += [f"# {agent.name} on {env_id}", "", f"Trained for {counted(agent.num_timesteps, 'step')} with rejeu.", ""]
    lines += [evaluation[0], ""] if evaluation is not None else []
    lines += ["```", f"rejeu pull {repo}", f"rejeu evaluate {repo.rpartition('/')[2]}/{MODEL}", "```", ""]
    lines += ["![Learning curve](curve.png)", ""] if "curve.png" in names else []
    lines += ['<video controls src="video.mp4"></video>', ""] if VIDEO in names else []
    if ONNX in names:
        lines += [f"`{ONNX}` is the policy from observation to action, with its normalization and scaling.", ""]
    return "\n".join(lines)


def evaluated(source: Path) -> tuple[str, float] | None:
    """Returns a sentence about the best evaluation of a run, with a 95 % interval, and its mean return; None without any."""
    if not (source / "config.json").is_file():  # a model, or a folder that was pulled
        return None
    table = run_list.read(source).evaluations
    if (row := runs.best_row(table)) is None:
        return None
    mean, std, n = (float(table.column(name)[row]) for name in ("mean_return", "std_return", "episodes"))
    low, high = map(float, statistics.student(mean, std, n))
    interval = "" if math.isnan(low) else f" (95 % confidence interval of the mean {low:.2f} to {high:.2f})"
    return f"Best evaluation in training: return {mean:.2f} ± {std:.2f}{interval}, {counted(int(n), 'episode')}.", mean
