"""The zip files and ``VecNormalize`` files of Stable-Baselines3 and its Contrib package, read without executing their code.

A zip file holds ``data``, JSON with the hyperparameters, in which some values are pickles; ``policy.pth`` with the weights,
one file of each optimizer's state, and ``pytorch_variables.pth``. :mod:`rejeu.checkpoints.pickled` reads pickles as data.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import msgspec
import numpy as np

from rejeu.agents import BUILT_IN, zoo
from rejeu.agents.agent import Agent
from rejeu.agents.conversion import EXTRACTORS, OriginalPolicy, action_layers, converted, parts_of, shares_extractor
from rejeu.checkpoints.agent_state import Identity
from rejeu.checkpoints.pickled import (
    MOST_FIELD,
    UNREADABLE,
    Name,
    PickledCall,
    array_of,
    content_of,
    explained,
    opened,
    parse,
    read_normalization,
    tensors_of,
)
from rejeu.core import algorithm as core, checkpoint, normalization, spaces
from rejeu.core.errors import CheckpointError
from rejeu.core.records import Malformed, brief, shown, stored_size
from rejeu.core.types import JsonObject, PyTree, Settings
from rejeu.core.validation import as_path, build

MOST_DATA = 16 * 2**20
"""Upper limit on the bytes of ``data``."""
MOST_TENSORS = 16
"""Upper limit on the files of tensors: of the policy, of each optimizer, and of variables."""
EXPANSION = 16
"""Upper limit on the size of the unpacked content relative to that of the file: weights can hardly be compressed."""
OWN_NETWORK = (
    "; write a network of your own with equinox and train again, as docs/coming-from-sb3.md shows, or use the model with "
    "Stable-Baselines3"
)
TENSORFLOW = (
    "models of Stable Baselines 2 (TensorFlow), which are not read; train again with rejeu.sb3, whose hyperparameters have "
    "nearly the same names"
)
OLD_HER = "goal_selection_strategy"
"""A setting that is among those of the agent where HER was an algorithm, in versions before 1.1."""
ON_POLICY = ("PPO", "A2C", "TRPO", "MaskablePPO", "RecurrentPPO")
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")
"""Hyperparameters that are numbers here and may be code in a file."""
IGNORED: tuple[str, ...] = (
    "action_noise",
    "exploration_schedule",
    "nonfinite",
    "optimizer",
    "policy_kwargs",
    "replay_buffer_class",
)
IGNORED += ("replay_buffer_kwargs", "train_freq")
"""Hyperparameters that have another form in a file."""
OWN = ("seed", "device", "stats_window_size")
"""Arguments of an agent that are no hyperparameters."""
OUTPUTS = {"verbose": int, "log": None, "tensorboard_log": str}
"""Those that say where it reports to, with their types in a file; None: not in a file."""


class Pickled(msgspec.Struct):
    """A value of ``data`` that is not JSON."""

    content: str | None = msgspec.field(default=None, name=":serialized:")


class Model(NamedTuple):
    """The content of a zip file."""

    fields: Mapping[str, msgspec.Raw]
    """The values of ``data``, still as JSON."""
    tensors: Mapping[str, Any]
    """Of each file with the ending ``.pth``, by its name without it."""
    room: int
    """Bytes of the file."""

    def value(self, key: str) -> Any:
        """Returns a value of ``data``; the parts that it would create by code are records. None if it is missing.

        Raises:
            Malformed: if it cannot be read as data.
        """
        raw = bytes(self.fields.get(key, b"null"))
        if len(raw) > MOST_FIELD:
            raise Malformed(f"{key} has more than {MOST_FIELD:,} bytes")
        if raw.startswith(b"{") and (text := msgspec.json.decode(raw, type=Pickled).content) is not None:
            with part_of(f"data: {key}", OWN_NETWORK if key in ("policy_class", "policy_kwargs") else ""):
                return parse(base64.b64decode(text))
        return msgspec.json.decode(raw)

    def readable(self, key: str) -> Any:
        """Returns a value of ``data``, or the error if it cannot be read as data."""
        try:
            return self.value(key)
        except Malformed as error:
            return error

    @property
    def group(self) -> Settings:
        """The settings of the policy's optimizer."""
        for name in ("policy.optimizer", "actor.optimizer"):
            if isinstance(optimizer := self.tensors.get(name), dict) and optimizer.get("param_groups"):
                return dict(optimizer["param_groups"][0])
        return {}


@contextlib.contextmanager
def part_of(name: str, advice: str = "") -> Iterator[None]:
    """Turns errors of a damaged part into ``Malformed`` with its name."""
    try:
        yield
    except UNREADABLE as error:
        raise Malformed(f"{name}: {brief(error)}{advice}") from None


def read(path: Path) -> Model:
    """Returns the content of a zip file.

    Raises:
        Malformed: if it is damaged, too large, or no model of Stable-Baselines3.
    """
    room = stored_size(path)
    with path.open("rb") as file:
        if file.read(1) == b"\x80":
            raise Malformed(f"it is a pickle, as statistics of VecNormalize are and {TENSORFLOW}")
    with path.open("rb") as file, opened(file, EXPANSION * room + 2**20) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
        if {"data", "parameters"} <= sizes.keys():
            raise Malformed(f"it has data and parameters, as {TENSORFLOW}")
        if not {"data", "policy.pth"} <= sizes.keys() or sizes["data"] > MOST_DATA:
            raise Malformed("it has no data and policy.pth, or too much data")
        if (n_tensors := sum(name.endswith(".pth") for name in sizes)) > MOST_TENSORS:
            raise Malformed(f"it has {n_tensors} files of tensors, expected at most {MOST_TENSORS}")
        fields = msgspec.json.decode(content_of(archive, "data"), type=dict[str, msgspec.Raw])
        tensors = {}
        for name in sizes:
            if name.endswith(".pth"):
                with part_of(name):
                    tensors[name.removesuffix(".pth")] = tensors_of(content_of(archive, name))
    weights = tensors["policy"]
    if not isinstance(weights, dict) or not all(isinstance(array, np.ndarray) for array in weights.values()):
        raise Malformed("policy.pth holds something else than tensors by name")
    return Model(fields, tensors, room)


def algorithm_of(model: Model) -> str:
    """Returns the name of the algorithm, which the weights and hyperparameters tell.

    Raises:
        Malformed: if it is none of those that rejeu has.
    """
    modules = {".".join(key.split(".")[:2]) for key in model.tensors["policy"]} | set(model.tensors["policy"])
    roots = {name.split(".")[0] for name in modules}
    if "quantile_net" in roots or "q_net" in roots:
        return "QRDQN" if "quantile_net" in roots else "DQN"
    if "lstm_actor" in roots:
        return "RecurrentPPO"
    if roots == {"action_net"} and "n_delta" in model.fields:
        return "ARS"
    if "action_net" in roots and "value_net" in roots:
        if "clip_range" not in model.fields:
            return "TRPO" if "cg_max_steps" in model.fields else "A2C"
        policy = model.value("policy_class")
        return "MaskablePPO" if isinstance(policy, Name) and "maskable" in policy.module.lower() else "PPO"
    if "actor.latent_pi" in modules and "critic" in roots:
        if "critic_target" not in roots:
            return "CrossQ"
        return "TQC" if "top_quantiles_to_drop_per_net" in model.fields else "SAC"
    if {"actor.mu", "critic.qf0", "actor_target.mu"} <= modules:
        is_ddpg = model.value("policy_delay") == 1 and "critic.qf1" not in modules
        return "DDPG" if is_ddpg and model.value("target_noise_clip") == 0 else "TD3"
    return unknown(roots)


def unknown(roots: set[str]) -> str:
    """Raises ``Malformed`` for a policy of another algorithm."""
    raise Malformed(
        f"its policy has the parts {shown(', '.join(sorted(roots)))}, of no algorithm that rejeu has; it reads DQN, QRDQN, "
        "PPO, A2C, TRPO, ARS, SAC, TD3, DDPG, TQC, CrossQ, RecurrentPPO and MaskablePPO"
    )


def described(value: Any) -> Any:
    """Returns the description of a space as :func:`rejeu.core.spaces.describe` gives it, from what a file says of it.

    Raises:
        Malformed: for another kind of space.
    """
    name = value.name.rpartition(".")[2] if isinstance(value, PickledCall) and ".spaces." in value.name else ""
    state = value.state if name else None
    if not isinstance(state, dict):
        raise Malformed("it is no space of Gymnasium")
    if name == "Dict" and isinstance(state["spaces"], dict):
        return {"Dict": {str(key): described(subspace) for key, subspace in state["spaces"].items()}}
    if name == "Box":
        low, high = array_of(state["low"]), array_of(state["high"])
        return {"Box": {"low": low.tolist(), "high": high.tolist(), "shape": list(low.shape), "dtype": low.dtype.name}}
    if name == "Discrete":
        return {"Discrete": {"n": int(array_of(state["n"])), "start": int(array_of(state.get("start", 0)))}}
    if name == "MultiDiscrete":
        n = array_of(state["nvec"])
        start = array_of(state["start"]) if isinstance(state.get("start"), PickledCall) else np.zeros_like(n)
        return {"MultiDiscrete": {"nvec": n.tolist(), "start": start.tolist()}}
    if name == "MultiBinary":
        shape = state["n"] if isinstance(state["n"], tuple | list) else [state["n"]]
        return {"MultiBinary": {"shape": [int(array_of(n)) for n in shape]}}
    raise Malformed(f"it is the space {shown(name, 40)}, which policies of Stable-Baselines3 do not take")


def space_of(model: Model, key: str) -> tuple[gym.Space, list[str]]:
    """Returns a space, and the keys of a Dict in the order of the file.

    Raises:
        Malformed: if it cannot be read.
    """
    with part_of(f"data: {key}"):
        description = described(model.value(key))
        return spaces.rebuild(description, max(spaces.MAX_NUMBERS, model.room)), [*description.get("Dict", ())]


def with_goals(model: Model, space: gym.Space) -> tuple[gym.Space, list[str], dict[str, np.ndarray]]:
    """Returns the Dict of observations, its keys, and weights for it, of a policy that took observation and goal in one array.

    The achieved goal, which it did not take, has weights of 0.

    Raises:
        Malformed: if the file does not tell the sizes of observation and goals.
    """
    last = model.readable("_last_obs")
    keys = ["observation", "desired_goal", "achieved_goal"]
    n_obs, n_goal, n_achieved = (array_of(last[key]).shape[-1] for key in keys)
    if space.shape != (n_obs + n_goal,) or n_achieved != n_goal:
        raise Malformed("its observation space is not made of the observation and the desired goal of the last step")
    parts = zip(keys, (n_obs, n_goal, n_goal), strict=True)
    whole = gym.spaces.Dict({key: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for key, n in parts})
    weights = dict(model.tensors["policy"])
    for name, array in weights.items():
        if name.endswith(".0.weight") and array.ndim == 2 and not name.endswith(".mu.0.weight"):
            weights[name] = np.insert(array, [n_obs + n_goal] * n_goal, 0.0, axis=1)
    return whole, keys, weights


def observation_space_of(old: gym.Space, new: gym.Space | None) -> gym.Space:
    """Returns the observation space of an agent: that of the environment, if it is given.

    Raises:
        Malformed: if the policy was trained on another; the axes of images may be in another order, as behind
            Stable-Baselines3's ``VecTransposeImage``.
    """
    if new is None:
        return old
    plain = lambda leaf: leaf if leaf.kind != "image" else dataclasses.replace(leaf, shape=tuple(sorted(leaf.shape)))  # noqa: E731
    if [*map(plain, spaces.leaves(old))] != [*map(plain, spaces.leaves(new))]:
        longer = 1 + new.shape[0] if isinstance(new, gym.spaces.Box) and len(new.shape) == 1 else 0
        missing = old.shape == (longer,) and isinstance(old, gym.spaces.Box) and (old.low[-1], old.high[-1]) == (0, 1)
        hint = f"; wrap it as the policy was trained, --wrapper {zoo.TIME_FEATURE}" if missing else ""
        raise Malformed(f"its observation space is {old}, and the environment's is {new}{hint}")
    return new


def number_of(value: object) -> Any:
    """Returns the number that a schedule of Stable-Baselines3 always gives; other values as they are."""
    for key in ("value_schedule", "val"):
        value = value.state.get(key) if isinstance(value, PickledCall) and isinstance(value.state, dict) else value
    return array_of(value).item() if isinstance(value, PickledCall) and value.name.endswith(".scalar") else value


def settings_of(config_class: Any, model: Model, notes: list[str], changed: Collection[str] = ()) -> Settings:
    """Returns the hyperparameters of a file that rejeu has too, but for those ``changed``; what is left out is noted."""
    names = {field.name for field in dataclasses.fields(config_class)}
    settings: Settings = {}
    names -= {"max_grad_norm"} if number_of(model.readable("max_grad_norm")) == 0 else set()  # of TRPO, without effect
    stored = {name: f"{name}_schedule" if name == "delta_std" else name for name in names - {*IGNORED}}
    for name in sorted(name for name, key in stored.items() if key in model.fields and name not in changed):
        value = number_of(model.readable(stored[name]))
        is_code = name in SCHEDULES and not isinstance(value, int | float | None)
        if is_code:
            value = model.group.get("lr") if name == "learning_rate" else None
        if name == "learning_rate" and isinstance(value, int | float) and value <= 0:  # a schedule may end below 0
            value = 0.0
            notes.append("learning_rate had ended at 0, which is used; to train on, give another: learning_rate=3e-4")
        elif is_code:
            used = f"{value:g}" if isinstance(value, int | float) else "the default"
            notes.append(f"{name} is code in the file; {used} is used")
        if isinstance(value, bool | int | float | str) or name not in SCHEDULES:
            settings[name] = value
    if "train_freq" in names and isinstance(value := model.readable("train_freq"), PickledCall | int):
        n, unit = value.arguments if isinstance(value, PickledCall) else (value, "step")
        n, unit = (n, unit) if n != -1 else (model.readable("n_episodes_rollout"), "episode")  # of versions before 1.0
        unit = unit.arguments[0] if isinstance(unit, PickledCall) else unit
        settings["train_freq"] = n if unit == "step" else (n, unit)
    if isinstance(buffer := model.readable("replay_buffer_class"), Name) and buffer.name == "HerReplayBuffer":
        kwargs = model.readable("replay_buffer_kwargs")
        settings |= hindsight(kwargs.get if isinstance(kwargs, dict) else {}.get)
    elif OLD_HER in model.fields:
        settings |= hindsight(model.readable)
    if "action_noise" in names and (noise := model.readable("action_noise")) is not None:
        state = noise.state if isinstance(noise, PickledCall) and isinstance(noise.state, dict) else {}
        sigma = np.unique(array_of(state["_sigma"])) if "_sigma" in state and "_theta" not in state else np.zeros(2)
        if sigma.size == 1 and not array_of(state["_mu"]).any():
            settings["action_noise"] = float(sigma[0])
        else:
            notes.append("action_noise is not taken over; give it again for training")
    if "rms_prop_eps" in names:
        settings |= {"rms_prop_eps": model.group.get("eps", 1e-5), "use_rms_prop": "alpha" in model.group}
    return settings


def hindsight(setting: Callable[[str], Any]) -> Settings:
    """Returns the hyperparameters of hindsight replay, from a function that returns a setting by its name."""
    kwargs = {key: value for key in ("n_sampled_goal", OLD_HER) if (value := setting(key)) is not None}
    if isinstance(strategy := kwargs.get(OLD_HER), PickledCall):
        kwargs[OLD_HER] = ("future", "final", "episode")[strategy.arguments[0]]
    return {"replay_buffer_class": "HerReplayBuffer", "replay_buffer_kwargs": kwargs}


def policy_settings(model: Model, policy: OriginalPolicy, algorithm: str) -> Settings:
    """Returns ``policy_kwargs``, and hyperparameters that are among those of the policy there.

    The widths of layers are those of the weights.

    Raises:
        Malformed: for settings of a policy that rejeu does not have.
    """
    kwargs = model.value("policy_kwargs") or {}
    if not isinstance(kwargs, dict):
        raise Malformed("data: policy_kwargs are no dict")
    extractor = kwargs.get("features_extractor_class")
    if extractor is not None and not (isinstance(extractor, Name) and extractor.name in EXTRACTORS):
        raise Malformed(
            f"its feature extractor is of another kind than {', '.join(EXTRACTORS)}, and no file holds code"
        )
    for key, expected in {"use_expln": False, "full_std": True, "clip_mean": 2.0}.items():
        if kwargs.get(key, expected) != expected:
            raise Malformed(f"policy_kwargs has {key}={shown(kwargs[key], 40)}, which is not read")
    shape: Settings = {"normalize_images": kwargs.get("normalize_images", True)}
    if (activation := kwargs.get("activation_fn")) is not None:
        shape["activation_fn"] = activation.name.lower() if isinstance(activation, Name) else "of another kind"
        if shape["activation_fn"] == "gelu":
            raise Malformed("its activation_fn is GELU, of which JAX has an approximation; the outputs would differ")
    dims = {policy.n_features(leaf) for leaf in policy.leaves if policy.is_image(leaf)}
    if len(dims) > 1:
        raise Malformed(f"its images have {sorted(dims)} features, expected one number")
    shape |= {"cnn_features": dims.pop()} if dims else {}
    changes: Settings = {"policy_kwargs": shape}
    if algorithm in ON_POLICY:
        shared = policy.widths("mlp_extractor.shared_net")
        nets = {"pi": "policy_net", "vf": "value_net"}
        shape["net_arch"] = {key: shared + policy.widths(f"mlp_extractor.{name}") for key, name in nets.items()}
        shape["squash_output"] = policy.squashes
        shape["share_features_extractor"] = shares_extractor(policy)
        if algorithm == "RecurrentPPO":
            if "lstm_actor.weight_ih_l1" in policy.weights or policy.has("critic"):
                raise Malformed("it has several layers of LSTM, or a critic without one, which rejeu does not have")
            shape["lstm_hidden_size"] = int(policy.weights["lstm_actor.weight_hh_l0"].shape[1])
            shape["shared_lstm"] = not policy.has("lstm_critic")
        return changes
    if algorithm == "ARS":
        *shape["net_arch"], _ = (len(policy.weights[f"{name}.weight"]) for name in action_layers(policy))
        squashes = kwargs.get("squash_output", bool(shape["net_arch"]))
        if isinstance(policy.action_space, gym.spaces.Box) and squashes is not bool(shape["net_arch"]):
            raise Malformed("its actions are squashed behind a linear policy, or clipped behind hidden layers")
        return changes
    if "actor.log_std" in policy.weights and algorithm == "CrossQ":
        raise Malformed("it explores by state-dependent noise (use_sde=True), which CrossQ does not have in rejeu")
    if algorithm in ("DQN", "QRDQN"):
        name = "q_net" if algorithm == "DQN" else "quantile_net"
        *widths, n_outputs = policy.widths(f"{name}.{name}")
        shape["net_arch"] = widths
        return changes | ({} if algorithm == "DQN" else {"n_quantiles": n_outputs // int(policy.action_space.n)})  # type: ignore[attr-defined]
    *critic, n_outputs = policy.widths("critic.qf0")
    pi = policy.widths("actor.latent_pi") if algorithm in ("SAC", "TQC", "CrossQ") else policy.widths("actor.mu")[:-1]
    shape["net_arch"] = {"pi": pi, "qf": critic}
    if algorithm != "DDPG":
        changes["n_critics"] = len({key.split(".")[1] for key in policy.weights if key.startswith("critic.qf")})
    return changes | ({"n_quantiles": n_outputs} if algorithm == "TQC" else {})


def moments(field: str, value: object) -> dict[str, np.ndarray]:
    """Returns the arrays of a running mean and variance."""
    if not isinstance(value, PickledCall) or not isinstance(value.state, dict):
        raise Malformed(f"it has no running statistics for {field}")
    mean, variance, count = (array_of(value.state[key]) for key in ("mean", "var", "count"))
    n_seen = min(float(count), normalization.MAX_COUNT)
    if not (np.isfinite(mean).all() and np.isfinite(variance).all() and (variance >= 0).all() and n_seen >= 0):
        raise Malformed("its statistics have negative variances or counts, or values that are not finite")
    if max(np.abs(mean).max(), variance.max()) > np.finfo(np.float32).max:
        raise Malformed("its statistics are larger than float32 can hold")
    return {f"{field}.mean": mean, f"{field}.variance": variance, f"{field}.n_seen": np.asarray(n_seen)}


def equal(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> bool:
    """Returns whether two collections of arrays are the same."""
    return all(np.array_equal(a[key], b[key]) for key in a)


def unresolved(value: Any) -> int:
    """Returns how many components have a deviation that is no more than 400 steps of float32 at their mean, but for 0."""
    mean, variance = (array_of(value.state[key]) for key in ("mean", "var"))
    steps = np.spacing(np.abs(mean).astype(np.float32))
    return int(((mean != 0) & (np.sqrt(variance + 1e-8) < 400 * steps)).sum())


def statistics_of(
    state: Mapping[str, Any], leaves: tuple[spaces.Leaf, ...], notes: list[str]
) -> tuple[JsonObject, dict[str, np.ndarray]]:
    """Returns the setting ``normalize`` and the statistics of a ``VecNormalize`` as those of an agent.

    Raises:
        Malformed: if they cannot be expressed.
    """
    keys = ("norm_obs", "norm_reward", "clip_obs", "clip_reward", "epsilon")
    settings = {key: state[key] for key in keys}
    arrays = moments("statistics.returns", state["ret_rms"])
    obs = state["obs_rms"] if state["norm_obs"] else None
    goals = []
    if isinstance(obs, dict) and {*spaces.GOAL_KEYS} <= {*obs}:
        goals = [obs[key] for key in spaces.GOAL_KEYS[1:]]
    if goals and not equal(*(moments("", rms) for rms in goals)):
        settings["share_goals"] = False
    for leaf, group in zip(leaves, spaces.groups(leaves, settings.get("share_goals", True)), strict=True):
        if obs is None or (group is None and not isinstance(obs, dict)):
            continue
        rms = obs.get(leaf.path) if isinstance(obs, dict) else obs
        if (rms is None) != (group is None):
            raise Malformed(f"it normalizes other parts of observations than an agent does: {leaf.path}")
        if group is not None:
            field = f"statistics.obs.{group}"
            arrays |= moments(field, rms)
    if moving := sum(map(unresolved, obs.values() if isinstance(obs, dict) else [obs] if obs else [])):
        notes.append(
            f"{moving} numbers of the observations vary by less than float32, in which rejeu holds them, tells apart: "
            "actions differ by more than rounding"
        )
    return settings, arrays


def load_zip(
    path: str | Path,
    env: Any = None,
    vecnormalize: str | Path | Literal[False] | None = None,
    kind: type[Agent] | None = None,
    which: Literal["best", "last"] = "last",
    **changes: Any,
) -> Agent:
    """Returns the agent of a zip file that Stable-Baselines3 or its Contrib package saved. No code from the file is run.

    The agent acts as the original does: actions, values and probabilities are equal up to rounding. It holds the
    optimizer's state and the counters, so ``learn(..., reset_num_timesteps=False)`` continues. What could not be taken over is
    in its attribute ``notes``. See ``docs/sb3-models.md``.

    Args:
        path: of the file, ``.zip`` is added if it has no suffix; or a folder of RL Zoo.
        env: environments to continue training in, as for ``load`` of its class; None for an agent that only predicts.
        vecnormalize: the file of the ``VecNormalize`` that the policy was trained behind. The agent normalizes by its
            statistics and takes raw observations. None: the one that lies beside the zip file; False: none.
        kind: class of the agent, whose algorithm must be that of the file; None for the one in :mod:`rejeu`.
        which: in a folder, ``"best"`` for ``best_model.zip`` or ``"last"`` for the model at the end of training.
        changes: constructor arguments and hyperparameters that replace those of the file.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if the file is damaged, names code, or its policy cannot be expressed; the message says which part.
        TypeError, ValueError: for unknown or invalid ``changes``.
    """
    path = as_path(path)
    path = zoo.model_in(path, which) if path.is_dir() else path
    path = path if path.suffix else path.with_name(f"{path.name}.zip")
    with explained(path):
        model = read(path)
        algorithm = algorithm_of(model)
        if kind is not None and (name := kind.algorithm.Config.name) != algorithm:
            raise Malformed(f"it is a model of {algorithm}, not of {name}; load it with {algorithm}.load")
    vecnormalize, notes = normalization_for(path, vecnormalize, changes)
    policy_class = model.readable("policy_class")
    packages = ("stable_baselines3.", "sb3_contrib.")
    is_original = isinstance(policy_class, Name) and policy_class.module.startswith(packages)
    if policy_class is not None and not is_original:
        notes.append(
            f"its policy class is not of Stable-Baselines3: it is read as {algorithm}, and what that class adds, such as "
            "action masks, is lost"
        )
    cls = kind or BUILT_IN[algorithm]
    arguments = {key: changes.pop(key) for key in [*changes] if key in (*OWN, *OUTPUTS)}
    outputs = {key: arguments.pop(key) for key in [*arguments] if key in OUTPUTS}
    with explained(path):
        arguments = arguments_of(model) | arguments
        policy, space = policy_of(model, algorithm)
        settings = settings_of(cls.algorithm.Config, model, notes, changes)
        settings |= policy_settings(model, policy, algorithm)
    arrays: dict[str, np.ndarray] = {}
    if vecnormalize:
        with explained(vecnormalize):
            settings["normalize"], arrays = statistics_of(read_normalization(vecnormalize), policy.leaves, notes)
    with explained(path):
        cls.algorithm.Config(**settings)  # what the file says is judged apart from what the user says
    agent: Agent = cls.__new__(cls)
    agent.notes = notes  # before it is built, when only known attributes can be set
    agent.configure(build(cls.algorithm.Config, settings | changes), Identity.of(name_of(policy), **arguments))
    agent.set_outputs(**outputs)
    vector = None if env is None else agent.make_envs(env, 1, seed=agent.seed)
    env_space = None if vector is None else vector.observation_space
    with explained(path):
        agent.build(observation_space_of(space, env_space), policy.action_space)
        restore(agent, model, policy, algorithm, arrays)
    restore_windows(agent, model.readable)
    if kind is not None:  # as the original's load does
        saved = {key: model.readable(key) for key in OUTPUTS}
        agent.set_outputs(**{key: x for key, x in saved.items() if type(x) is OUTPUTS[key]} | outputs)
    if vector is not None:
        agent.set_env(vector)
        agent.made_from_id = isinstance(env, str)
    return agent


def normalization_for(
    path: Path, vecnormalize: str | Path | Literal[False] | None, changes: Mapping[str, object]
) -> tuple[Path | None, list[str]]:
    """Returns the file of the statistics that a policy was trained behind, if any, and notes about what lies beside it."""
    notes: list[str] = []
    if vecnormalize is None and (vecnormalize := zoo.statistics_beside(path)) is not None:
        notes.append(
            f"observations are normalized by {vecnormalize}, which lies beside it; vecnormalize=False leaves it out"
        )
        if path.stem == zoo.BEST:
            notes.append(
                "these statistics may be of the end of training, and the model is not: it can act worse than it did"
            )
    return Path(vecnormalize) if vecnormalize else None, notes + zoo.notes_beside(path, vecnormalize or None, changes)


def arguments_of(model: Model) -> Settings:
    """Returns the arguments of an agent that are no hyperparameters."""
    seed, window = model.value("seed"), model.readable("_stats_window_size")
    arguments = {"seed": seed if isinstance(seed, int) and 0 <= seed < 2**32 else None}
    return arguments | ({"stats_window_size": window} if isinstance(window, int) and 0 < window < 2**31 else {})


def policy_of(model: Model, algorithm: str) -> tuple[OriginalPolicy, gym.Space]:
    """Returns the networks of a file, and the space of their observations."""
    space, keys = space_of(model, "observation_space")
    action_space, _ = space_of(model, "action_space")
    kwargs, weights = model.readable("policy_kwargs"), model.tensors["policy"]
    squashes = algorithm in ON_POLICY and isinstance(kwargs, dict) and kwargs.get("squash_output") is True
    if OLD_HER in model.fields and not keys:
        space, keys, weights = with_goals(model, space)
    return OriginalPolicy(weights, spaces.leaves(space), keys, action_space, squashes), space


def name_of(policy: OriginalPolicy) -> str:
    """Returns the name of a policy by what it observes."""
    return spaces.POLICIES[1] if policy.keys else spaces.POLICIES[2 if policy.is_image(policy.leaves[0]) else 0]


def restore(
    agent: Agent, model: Model, policy: OriginalPolicy, algorithm: str, statistics: Mapping[str, np.ndarray]
) -> None:
    """Starts a run of an agent with the weights, the optimizers and the counters of a file."""
    prefix = "" if agent.config.normalize is None else "learner."
    parts = parts_of(algorithm, policy, getattr(agent.config, "n_quantiles", 1))
    values, left_out = converted(parts, policy, model.tensors)
    agent.notes += [f"the state of {name} is not taken over: it is of another optimizer" for name in left_out]
    values |= counts_of(algorithm, model)
    arrays = {**statistics, **{f"{prefix}{key}": value for key, value in values.items()}}
    arrays = checked(agent.learner.shapes, arrays, [f"{prefix}{component.field}." for component in parts])
    agent.start_run(None)
    agent.set_parameters(arrays, exact_match=False)
    restore_counters(agent, model, values)


def counts_of(algorithm: str, model: Model) -> dict[str, np.ndarray]:
    """Returns the counters and the temperature among the arrays of a state."""
    variables = model.tensors.get("pytorch_variables", model.tensors.get("tensors"))
    counts: JsonObject = {}
    if isinstance(variables, dict) and isinstance(log_alpha := variables.get("log_ent_coef"), np.ndarray):
        counts["log_alpha"] = log_alpha.reshape(())
        optimizer = model.tensors.get("ent_coef_optimizer")
        moments = next(iter(optimizer["state"].values()), None) if isinstance(optimizer, dict) else None
        if moments:
            counts |= {"alpha_optimizer.count": np.asarray(int(moments["step"]))}
            for ours, theirs in (("mu", "exp_avg"), ("nu", "exp_avg_sq")):
                counts[f"alpha_optimizer.{ours}"] = moments[theirs].reshape(())
    if algorithm in ("DQN", "QRDQN"):
        counts["step"] = np.asarray(model.value("num_timesteps"))
    return counts


def checked(shapes: PyTree, arrays: Mapping[str, np.ndarray], fields: list[str]) -> dict[str, np.ndarray]:
    """Returns arrays in the dtypes of the state, after their shapes have been compared with those of our networks.

    Raises:
        CheckpointError: if one is missing or of another shape.
    """
    expected = dict(zip(core.names(shapes), jax.tree.leaves(shapes), strict=True))
    for name, leaf in expected.items():
        if name not in arrays and name.startswith(tuple(fields)):
            raise CheckpointError(f"it has nothing for {name} {list(leaf.shape)}: the policy is of another structure")
    for name, array in arrays.items():
        if name not in expected or expected[name].shape != array.shape:
            wanted = list(expected[name].shape) if name in expected else "nothing of that name"
            raise CheckpointError(
                f"{name} is {list(array.shape)}, expected {wanted}: the policy is of another structure"
            )
    result = {name: np.asarray(array, expected[name].dtype) for name, array in arrays.items()}
    checkpoint.require_finite(result, "its weights")
    return result


def restore_windows(agent: Agent, value: Callable[[str], Any]) -> None:
    """Fills the buffers of recent episodes from what ``value`` says a file has by a name; it ends at what is no episode."""
    for name in ("ep_info_buffer", "ep_success_buffer"):
        window, number = value(name), lambda x: array_of(x).item()
        with contextlib.suppress(*UNREADABLE):
            for episode in (window.state if isinstance(window, PickledCall) else window) or ():
                entry = {key: number(episode[key]) for key in "rlt"} if name == "ep_info_buffer" else number(episode)
                getattr(agent, name).append(entry)


def restore_counters(agent: Agent, model: Model, arrays: Mapping[str, np.ndarray]) -> None:
    """Sets steps, episodes and gradient steps of an agent, which Stable-Baselines3 counts in epochs for PPO."""
    step, episode, n_updates = (model.value(key) for key in ("num_timesteps", "_episode_num", "_n_updates"))
    counts = [value if isinstance(value, int) and 0 <= value < 2**31 else 0 for value in (step, episode, n_updates)]
    if "optimizer.count" in arrays:
        counts[2] = int(arrays["optimizer.count"])
    agent.run.step, agent.run.episode, agent.run.n_updates = counts
    names = [name for name in core.names(agent.learner.shapes) if name.split(".")[-1] == "n_updates"]
    agent.set_parameters({name: np.asarray(counts[2], np.int32) for name in names}, exact_match=False)
