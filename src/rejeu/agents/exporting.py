"""``agent.export``: an agent's policy as a file of another format, compared with ``predict`` before it is kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.checkpoints.agent_state import AnyAgent
from rejeu.core import atomic, spaces, xla
from rejeu.core.algorithm import Masked
from rejeu.core.types import JsonObject, Observation
from rejeu.core.validation import as_path
from rejeu.envs.make import VectorEnv
from rejeu.envs.masks import mask_leaf
from rejeu.envs.registry import maker, register
from rejeu.export import FORMATS, check, npz_file, target_of
from rejeu.export.check import Check, SeenSteps
from rejeu.export.contract import CARD_VERSION, Exportable, FrameStack, Policy, frame_stack_of, policy_of
from rejeu.export.numpy_policy import NumpyPolicy
from rejeu.replay.ring import stacked_leaves
from rejeu.training import finite

MOST_SECONDS = 60.0
"""Wall time after which no further observation is recorded, in a slow environment."""


class Exported(NamedTuple):
    """The files that :meth:`rejeu.SAC.export` has written."""

    path: Path
    """Of the file."""
    card: Path
    """Of the card about it: names, shapes, dtypes and bounds of what it takes and returns, its origin, and the check."""
    target: str
    """The format."""
    bytes: int
    """Size of the file."""
    check: Check | None
    """How it compares with ``predict``; None if what runs such a file is not installed."""
    note: str = ""
    """Why it was not checked."""

    def __str__(self) -> str:
        return f"{self.path}: {self.bytes / 1000:,.1f} kB; {self.note or self.check}"

    def to_dict(self) -> JsonObject:
        """Returns it as JSON values."""
        return {**self._asdict(), "check": None if self.check is None else self.check._asdict()}


def export(
    agent: AnyAgent,
    path: str | Path,
    to: str | None,
    noise: bool,
    batch: int | None,
    make_env: Callable[[], Any] | None = None,
    source: str = "",
    frame_stack: int | None = None,
) -> Exported:
    """Writes the policy of an agent, and a card beside it; most arguments are those of :meth:`rejeu.SAC.export`.

    ``make_env`` makes an environment in which observations are recorded, None for that of the agent; ``source`` is the run
    or model that the policy is from, for the card.
    """
    path = as_path(path)
    target = target_of(path, to)
    form = FORMATS[target]
    path = path if path.suffix else path.with_suffix(form.suffix)
    form.check(target, noise, batch, frame_stack)
    batch = 1 if form.takes == "one" else batch
    stack = stack_of(agent, frame_stack) if form.frames else None
    single = policy_for(agent, noise, 1, stack)
    recording, duration, stack = record(agent, single, make_env, stack)
    single = single if stack is None else policy_for(agent, noise, 1, stack)
    policy = single if batch == 1 else policy_for(agent, noise, batch, stack)
    card = card_of(agent, policy, target, source, duration)
    if stack is not None:
        card["frame_stack"] = {"n": stack.n, "padding": "zero" if stack.zeros else "reset"}
    details = agent.observation_space, agent.action_space, path.stem, *(agent.origin or ())
    contents, run = form.files(Exportable(policy, single, card, *details))
    result = None if run is None else check.compare(single, recording, run)
    if result is not None and not result.difference <= result.allowed:
        raise ValueError(
            f"the {target} file differs from predict by {result.difference:.3g}, more than {result.allowed:.3g}, "
            f"on {result.n} observations ({result.source}), and was not kept; please report this with the model"
        )
    note = "" if run is not None else f"not checked, because {form.runner} is not installed"
    card |= {"sha256": hashlib.sha256(contents[0]).hexdigest(), "check": result and result._asdict()}
    card_path = path.with_name(f"{path.name}.json")
    files = [path, path.with_suffix(".h")][: len(contents)]
    contents = (*contents, json.dumps(card, indent=1).encode())
    with ExitStack() as opened:  # all of them, or none
        for file, content in zip((*files, card_path), contents, strict=True):
            out = opened.enter_context(atomic.replacing(file))
            out.write(content)
            out.flush()
    return Exported(path, card_path, target, len(contents[0]), result, note)


def stack_of(agent: AnyAgent, n: int | None) -> FrameStack | None:
    """Returns of which frames the observations of an agent are made; None if they are no stacks."""
    n_frames = getattr(agent.config, "frame_stack", None)
    if n is None and n_frames is not None:
        flags = stacked_leaves(agent.obs_leaves, n_frames)
        pairs = zip(agent.obs_leaves, flags, strict=True)
        return FrameStack(n_frames, tuple(-len(leaf.shape) if flag else None for leaf, flag in pairs))
    return None if n is None else frame_stack_of(agent.obs_leaves, n)


def policy_for(agent: AnyAgent, noise: bool, batch: int | None, stack: FrameStack | None = None) -> Policy:
    """Returns the policy of an agent as a program.

    Raises:
        ValueError: if its actions are a Dict or Tuple, or held for several steps.
    """
    if (repeat := agent.config.action_repeat) > 1:
        raise ValueError(
            f"a policy with action_repeat={repeat} cannot be exported: files hold no action; use rejeu.load"
        )
    if isinstance(agent.action_space, gym.spaces.Dict | gym.spaces.Tuple):
        raise ValueError("policies with Dict or Tuple actions cannot be exported; load the model with rejeu.load")
    algorithm = agent.learner.algorithm
    mask = mask_leaf(agent.action_space, "the environment") if agent.takes_masks else None
    actor = jax.tree.map(np.asarray, algorithm.actor(agent.state))
    return policy_of(algorithm, actor, agent.observation_space, agent.action_space, mask, batch, noise, stack)


def numpy_policy(agent: AnyAgent, source: str) -> NumpyPolicy:
    """Returns the policy of an agent in NumPy, without a file; ``source`` is for the card."""
    policy = policy_for(agent, False, None)
    card = card_of(agent, policy, "npz", source, None)
    exportable = Exportable(policy, policy, card, agent.observation_space, agent.action_space)
    return NumpyPolicy(*npz_file.content_of(exportable), spaces.MAX_NUMBERS)


def card_of(agent: AnyAgent, policy: Policy, target: str, source: str, duration: float | None) -> JsonObject:
    """Returns the contract of a policy in JSON values."""
    finite.settle(agent)
    weights = hashlib.sha256()
    for array in jax.tree.leaves(agent.learner.algorithm.actor(agent.state)):
        weights.update(np.ascontiguousarray(array).tobytes())
    env = agent.run.env
    wide = target in ("onnx", "c")
    narrow = lambda port: port if wide else port._replace(dtype=spaces.narrow(port.dtype))  # noqa: E731
    return {
        "card": CARD_VERSION,
        "rejeu": metadata.version("rejeu"),
        "target": target,
        "algorithm": agent.name,
        "env_id": env.env_id if env is not None else agent.identity.trained_on and agent.identity.trained_on[0],
        "source": source,
        "seed": agent.identity.seed,
        "steps": agent.run.step,
        "weights": weights.hexdigest(),
        "seconds_per_step": duration,
        "batch": "free" if policy.batch is None else policy.batch,
        "inputs": [narrow(port).to_json() for port in policy.inputs],
        "outputs": [narrow(port).to_json() for port in policy.outputs],
        "versions": {"jax": jax.__version__, "numpy": np.__version__},
    }


def record(
    agent: AnyAgent, policy: Policy, make_env: Callable[[], Any] | None, stack: FrameStack | None = None
) -> tuple[SeenSteps, float | None, FrameStack | None]:
    """Returns observations with the actions of ``predict``, the duration of a step in seconds if it is known, and the stack.

    Of stacks of frames the newest frames are kept; how an episode begins is read from its first observation.

    They are recorded in a new environment like those it was trained on, in which the agent acts; where none can be made,
    they are samples of the observation space.
    """
    vector, duration = environment(agent, make_env)
    ports = [port for port in policy.inputs if port.role in ("observation", "action_mask")]
    rows: list[list[np.ndarray]] = []
    actions, starts = [], []
    rng, end = np.random.default_rng(0), xla.clock() + MOST_SECONDS
    agent.observation_space.seed(0)
    memory, ended = None, np.ones(1, bool)
    obs = vector.reset(0) if vector is not None else _sample(agent, policy, rng)
    try:
        while len(rows) < check.OBSERVATIONS and xla.clock() < end:
            if vector is None and stack is not None:
                obs = _restacked(agent, stack, obs, rows[-1] if rows else None, bool(ended[0]))
            arrays = [np.array(array[0]) for array in jax.tree.leaves(obs)]
            action, memory = agent.predict(obs, memory, ended, deterministic=True)
            rows.append(arrays)
            actions.append(action[0])
            starts.append(bool(ended[0]))
            if vector is None:
                obs, ended = _sample(agent, policy, rng), np.array([len(rows) % 100 == 0])
                continue
            step = vector.step(action)
            ended = step.terminated | step.truncated
            obs = vector.reset_done(ended) if ended.any() else step.obs
    finally:
        if vector is not None:
            vector.close()
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    if stack is not None:
        n_leaves = len(stack.axes)
        if vector is not None:
            stack = stack._replace(zeros=stack.begins_with_zeros([column[starts] for column in columns[:n_leaves]]))
        columns[:n_leaves] = [np.asarray(stack.newest(i, column)) for i, column in enumerate(columns[:n_leaves])]
    inputs = {port.name: column.astype(port.dtype) for port, column in zip(ports, columns, strict=True)}
    inputs |= {port.name: np.array(starts) for port in policy.of("episode_start")}
    for port in policy.of("noise"):  # with these numbers a sample is the mode
        number = 0.0 if port.drawn == "normal" else 0.5
        inputs[port.name] = np.full((len(rows), *port.shape), number, port.dtype)
    return SeenSteps(inputs, np.stack(actions), "sampled" if vector is None else vector.env_id), duration, stack


def environment(agent: AnyAgent, make_env: Callable[[], Any] | None) -> tuple[VectorEnv | None, float | None]:
    """Returns a new environment like those of training, None if none can be made, and the duration of its steps."""
    origin = agent.origin
    if make_env is None and origin is not None and register(origin[0]):
        make_env = maker(origin[0], **origin[1])
    if make_env is None:
        return None, None
    env = make_env()
    vector = agent.make_envs(env, 1, seed=0)
    agent.check_spaces(vector, "the environment to record observations in")
    return vector, seconds_per_step(env)


def seconds_per_step(env: Any) -> float | None:
    """Returns the duration of a step in the time of an environment, None if it does not say."""
    inner = env.unwrapped
    config = getattr(inner, "config", None)
    if isinstance(config, dict) and "policy_frequency" in config:  # highway-env
        return 1.0 / float(config["policy_frequency"])
    seconds = next((value for name in ("dt", "tau") if isinstance(value := getattr(inner, name, None), float)), None)
    return None if seconds is None else float(seconds)


def _restacked(
    agent: AnyAgent, stack: FrameStack, obs: Observation, before: list[np.ndarray] | None, starts: bool
) -> Any:
    """Returns an observation whose newest frames are those of a sample, and the others those before."""
    masked = obs if isinstance(obs, Masked) else None
    leaves, structure = jax.tree.flatten(obs if masked is None else masked.obs)
    for i, axis in enumerate(stack.axes):
        if axis is not None:
            last = leaves[i][0] if before is None else before[i]
            leaves[i] = np.asarray(stack.pushed(i, last, stack.newest(i, leaves[i][0]), starts))[None]
    stacked = jax.tree.unflatten(structure, leaves)
    return stacked if masked is None else masked._replace(obs=stacked)


def moderate(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns a sample with numbers from a standard normal where bounds are practically infinite."""
    return np.where(np.abs(x) < 1e6, x, rng.normal(size=x.shape)).astype(x.dtype) if x.dtype.kind == "f" else x


def _sample(agent: AnyAgent, policy: Policy, rng: np.random.Generator) -> Any:
    """Returns a batch of one sample of the observation space, with a mask if the agent takes masks."""
    drawn = spaces.plain(agent.observation_space, agent.observation_space.sample())
    obs = jax.tree.map(lambda array: moderate(np.asarray(array)[None], rng), drawn)
    masks = policy.of("action_mask")
    if not masks:
        return obs
    mask = rng.random((1, *masks[0].shape)) < 0.7
    mask[:, 0] = True
    return Masked(obs, mask)
