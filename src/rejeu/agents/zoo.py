"""Folders of RL Zoo: the files that lie beside a zip file and say how its policy must be used, read as data.

``a2c/Pendulum-v1_1`` holds ``Pendulum-v1.zip``, ``best_model.zip``, and in ``Pendulum-v1`` its ``vecnormalize.pkl``, the
hyperparameters ``config.yml`` and the command line ``args.yml``. On the hub all of them lie beside each other.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from rejeu.checkpoints.pickled import check_size
from rejeu.core.records import WRONG, Malformed, brief, read_bytes, shown
from rejeu.core.types import JsonObject, Settings

BEST = "best_model"
STATISTICS = ("vecnormalize.pkl", "vec_normalize.pkl")
NO_MODEL = re.compile(r"best_model|train_eval_metrics|.*_\d+_steps")
"""Names of zip files that are not the last model of a folder."""
MOST_TEXT = 64 * 2**10
"""Upper limit on the bytes of a YAML file."""
TIME_FEATURE = "rejeu.sb3_contrib.common.wrappers:TimeFeatureWrapper"
HERE = {"sb3_contrib.": "rejeu.sb3_contrib.", "stable_baselines3.": "rejeu.sb3."}
"""Where the wrappers of a package are in rejeu."""


def model_in(folder: Path, wanted: Literal["best", "last"]) -> Path:
    """Returns the zip file of a folder.

    Raises:
        FileNotFoundError: unless there is exactly one.
    """
    names = [path for path in sorted(folder.glob("*.zip")) if (path.stem == BEST) is (wanted == "best")]
    paths = [path for path in names if wanted == "best" or not NO_MODEL.fullmatch(path.stem)]
    if len(paths) != 1:
        others = ", ".join(path.name for path in sorted(folder.glob("*.zip"))) or "no zip file"
        raise FileNotFoundError(
            f"{folder} has {len(paths)} files that could be the {wanted} model, expected one; it holds {others}: name the file"
        )
    return paths[0]


def folders(path: Path) -> list[Path]:
    """Returns where the files lie that belong to a zip file, the nearest first; those of the last model are the best's too."""
    last = [path.parent / path.parent.name.rpartition("_")[0]] if path.stem == BEST and path.parent.name else []
    return [path.with_suffix(""), *last, path.parent]


def statistics_beside(path: Path) -> Path | None:
    """Returns the file of the ``VecNormalize`` that belongs to a zip file by its name and place; None if there is none.

    ``PREFIX_vecnormalize_N_steps.pkl`` belongs to ``PREFIX_N_steps.zip``, as ``CheckpointCallback`` writes them.
    """
    prefix, _, steps = path.stem.removesuffix("_steps").rpartition("_")
    names = f"{prefix}_vecnormalize_{steps}_steps.pkl", f"{path.stem}_vecnormalize.pkl"
    files = [path.with_name(name) for name in names]
    files += [folder / name for folder in folders(path) for name in STATISTICS]
    return next((file for file in files if file.is_file()), None)


def notes_beside(path: Path, used: Any, changes: Any = ()) -> list[str]:
    """Returns notes about the files beside a zip file: what rejeu does not do by itself, and which of them are not read.

    Args:
        path: of the zip file.
        used: the file of the ``VecNormalize`` that is used; None if there is none.
        changes: names of hyperparameters that replace those of the file.
    """
    notes = []
    unread = {file.name for folder in folders(path)[:-1] for file in folder.glob("*.pkl") if file != used}
    unread |= {file.name for file in path.parent.glob(f"{path.stem}*.pkl") if file != used}
    if unread:
        notes.append(f"not read: {shown(', '.join(sorted(unread)), 200)}")
    args: Settings = {}
    for name in ("args.yml", "config.yml", "env_kwargs.yml"):
        yaml_file = next((folder / name for folder in folders(path) if (folder / name).is_file()), None)
        try:
            args |= {} if yaml_file is None else read_yaml(yaml_file)
        except (*WRONG, OSError, ImportError) as error:
            notes.append(f"{yaml_file} is not read: {brief(error)}")
    kwargs = args.get("env_kwargs")
    if env := args.get("env"):
        text = f" with {shown(kwargs, 200)}" if kwargs else ""
        notes.append(f"args.yml: it was trained on {shown(env, 80)}{text}; --env gives the model its environment")
    for key in ("env_wrapper", "vec_env_wrapper"):
        if wrapper := args.get(key):
            names = re.findall(r"[A-Za-z_]\w*(?:\.\w+)+", shown(wrapper, 300))
            starts = [(name, start) for name in names for start in HERE if name.startswith(start)]
            paths = [f"{HERE[start]}{name.removeprefix(start)}" for name, start in starts]
            ours = [f"--wrapper {':'.join(path.rsplit('.', 1))}" for path in paths]
            notes.append(
                f"config.yml: it was trained behind {shown(wrapper, 200)}; wrap the environment: {' '.join(ours)}"
            )
    if args.get("frame_stack"):
        n = shown(args["frame_stack"], 20)
        notes.append(
            f"config.yml: its observations are stacks of {n} frames; wrap the environment in FrameStackObservation"
        )
    schedules = {key: args[key] for key in ("learning_rate", "clip_range", "delta_std") if key in {*args} - {*changes}}
    if schedules:
        written = " ".join(f"{key}={shown(value, 40)}" for key, value in schedules.items())
        notes.append(f"config.yml: it began with {written}; to train on so: --set {written}")
    if args.get("normalize") and used is None:
        notes.append(
            "config.yml: it was trained behind VecNormalize, whose file is missing: without it actions are others"
        )
    return notes


def read_yaml(path: Path) -> JsonObject:
    """Returns the content of a YAML file of RL Zoo; of Python's objects ``OrderedDict`` and ``tuple`` are read, as data.

    Raises:
        ImportError: if PyYAML is not installed.
        Malformed: if it is too large, or not valid.
    """
    try:
        import yaml  # noqa: TID251 - of which only the loader of plain values is used
    except ImportError:
        raise ImportError('PyYAML is not installed; pip install "rejeu[zoo]"') from None

    class Reader(yaml.SafeLoader):
        """Creates numbers, texts, lists and dicts only. Merged dicts, which may double with each line, are refused."""

        def flatten_mapping(self, node: object) -> None:
            """Leaves the keys as they are."""

    def items(reader: Any, node: Any) -> list[Any]:
        return list(reader.construct_sequence(node, deep=True))

    for name in ("object/apply:collections.OrderedDict", "tuple"):
        Reader.add_constructor(f"tag:yaml.org,2002:python/{name}", items)
    text = read_bytes(path, MOST_TEXT)
    try:
        content = Reader(text).get_single_data()
    except yaml.YAMLError as error:
        raise Malformed(brief(error)) from None
    check_size(content, 2**20)
    return {str(key): value for key, value in dict(content[0] if isinstance(content, list) else content or {}).items()}
