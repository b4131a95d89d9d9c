"""Environments of the EnvPool package, stepped by threads in C++, and the log of their actions.

A pool does not expose its state, but is deterministic given its seed and the actions. It is restored by replaying the log of
all actions and resets since its creation. A log is a sequence of operations: a step of all environments, a step of some, a
reset of all, or a reset of some. An operation is stored as one byte for its kind, one bit per environment if it concerns only
some, and the actions. Blocks of about a megabyte are compressed.
"""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.core.spaces import action_scaler, cast, check_env_actions, leaves, random_action
from rejeu.core.validation import whole
from rejeu.envs import goals as goals_module
from rejeu.envs.base import SEEDS_END, SUCCESS_KEYS, DivergedError, Seed, Step, VectorEnv, checked_seed, replaced
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.registry import (
    import_envpool,
    in_envpool,
    make_env,
    newer_version,
    provider,
    register,
    unknown_environment,
)

STEP, STEP_SOME, RESET, RESET_SOME = range(4)
BLOCK = 2**20
"""Size of a block before compression, in bytes."""
MOST_STEPS = 500_000
"""Environment steps after which a log is full. Replaying takes 10 to 60 microseconds per step."""
MOST_IMAGE_STEPS = 100_000
"""The same for environments with image observations, which take about ten times as long."""
MOST_BYTES = 2**24
"""Bytes of actions after which a log is full, regardless of the number of steps."""
MANY_OPERATIONS = 20_000
"""Number of operations from which a progress bar is shown during replay."""


class LoggedOperation(NamedTuple):
    """One step or reset of the environments."""

    which: np.ndarray | None
    """Indices of the environments, ``int32 (k,)``; None for all."""
    action: np.ndarray | None
    """Their actions ``(k, ...)`` in the range of the action space; None for a reset."""


class ActionLog:
    """The operations on ``n_envs`` environments since their creation. Mutable."""

    def __init__(self, n_envs: int, action_space: gym.Space, most_steps: int = MOST_STEPS) -> None:
        self.n_envs = n_envs
        self.n_steps = 0
        """Number of steps, summed over the environments."""
        self.n_operations = 0
        example = action_scaler(action_space)(random_action(action_space, 1, np.random.default_rng(0)))
        self._space, self._dtype, self._shape = action_space, example.dtype, example.shape[1:]
        self._row_bytes = example.nbytes
        self._most_steps = min(most_steps, MOST_BYTES // max(self._row_bytes, 1))
        self._blocks: list[np.ndarray] = []
        self._open = bytearray()

    @property
    def most_operations(self) -> int:
        """Maximum number of operations of a log: steps of single environments, each followed by a reset."""
        return 4 * self._most_steps + 2

    @property
    def is_full(self) -> bool:
        """Whether the log is so long that a replay would take too much time."""
        return self.n_steps >= self._most_steps

    @property
    def is_dropped(self) -> bool:
        """Whether recording has stopped: the environments were not reset for a long time after the log was full."""
        return self.n_steps >= 2 * self._most_steps

    def step(self, action: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Records a step and returns the actions as they are recorded, ``(k, ...)``.

        Args:
            action: actions of all environments, or of those in ``which``.
            which: indices of the environments that are stepped; None for all.
        """
        rows = self.n_envs if which is None else len(which)
        action = np.ascontiguousarray(action, self._dtype).reshape(rows, *self._shape)
        self._add(STEP if which is None else STEP_SOME, which, action.tobytes())
        self.n_steps += rows
        return action

    def reset(self, which: np.ndarray | None = None) -> None:
        """Records a reset of all environments, or of those in ``which``."""
        self._add(RESET if which is None else RESET_SOME, which, b"")

    def _add(self, kind: int, which: np.ndarray | None, action: bytes) -> None:
        if self.is_dropped:
            self._blocks, self._open = [], bytearray()
            return
        self.n_operations += 1
        self._open.append(kind)
        if which is not None:
            flags = np.zeros(self.n_envs, bool)
            flags[which] = True
            self._open += np.packbits(flags).tobytes()
        self._open += action
        if len(self._open) >= BLOCK:
            self._blocks.append(_compressed(self._open))
            self._open = bytearray()

    def to_plain(self) -> dict[str, Any]:
        """Returns the log as plain data (see :mod:`rejeu.core.records`)."""
        return {"n_operations": self.n_operations, "blocks": [*self._blocks, _compressed(self._open)]}

    def operations(self, saved: dict[str, Any]) -> Iterator[LoggedOperation]:
        """Yields the operations of a log that :meth:`to_plain` returned, oldest first.

        Raises:
            ValueError: if the log is corrupted, or belongs to other environments.
        """
        n_flags = (self.n_envs + 7) // 8
        longest = BLOCK + 1 + n_flags + self.n_envs * self._row_bytes
        for block in saved["blocks"]:
            data, at = _expanded(block, longest), 0
            while at < len(data):
                kind = data[at]
                at += 1
                if kind > RESET_SOME:
                    raise ValueError(f"{kind} is no kind of operation")
                which = None
                if kind in (STEP_SOME, RESET_SOME):
                    flags = np.unpackbits(_part(data, at, n_flags).view(np.uint8), count=self.n_envs)
                    which = np.flatnonzero(flags).astype(np.int32)
                    at += n_flags
                action = None
                if kind in (STEP, STEP_SOME):
                    rows = self.n_envs if which is None else len(which)
                    action = _part(data, at, rows * self._row_bytes).view(self._dtype).reshape(rows, *self._shape)
                    check_env_actions(self._space, action, "the record of actions")
                    at += rows * self._row_bytes
                yield LoggedOperation(which, action)


def replay(log: ActionLog, saved: dict[str, Any], title: str) -> Iterator[LoggedOperation]:
    """Yields the operations of a saved log. On a terminal, a progress bar is shown for long logs.

    Raises:
        ValueError: if the log is corrupted.
    """
    from rich.console import Console  # not loaded with every model
    from rich.progress import track

    n = whole("n_operations", saved["n_operations"], least=0, most=log.most_operations)
    console = Console(stderr=True)
    hidden = n < MANY_OPERATIONS or not (console.is_terminal or console.is_jupyter)
    operations = log.operations(saved)
    text = f"Replaying {title}"
    yield from islice(track(operations, text, total=n, console=console, transient=True, disable=hidden), n)
    if log.n_operations != n or next(operations, None) is not None:
        raise ValueError(f"the record of actions does not hold the {n} operations that it should")


def _compressed(data: bytearray) -> np.ndarray:
    return np.frombuffer(zlib.compress(bytes(data), 1), np.uint8)


def _expanded(block: Any, longest: int) -> bytes:
    """Returns the decompressed bytes of a block, at most ``longest``."""
    if not isinstance(block, np.ndarray) or block.dtype != np.uint8 or block.ndim != 1:
        raise ValueError("a block of the record of actions is no array of bytes")
    reader = zlib.decompressobj()
    try:
        data = reader.decompress(block.tobytes(), longest)
    except zlib.error as error:
        raise ValueError(f"a block of the record of actions is damaged: {error}") from None
    if not reader.eof:
        raise ValueError("a block of the record of actions is too long or cut short")
    return data


def _part(data: bytes, at: int, n: int) -> np.ndarray:
    if at + n > len(data):
        raise ValueError("the record of actions is cut short")
    return np.frombuffer(data, np.uint8, n, at).copy()


NO_LIMIT = 2**31 - 1
"""EnvPool's time limit of environments without one."""


class EnvPool(VectorEnv):
    """Environments of the EnvPool package, stepped by C++ threads.

    When the log of its actions is full (:attr:`ActionLog.is_full`), the pool is created again with a seed derived from the
    previous one, in every run, resumed or not.
    """

    backend = "envpool"

    def __init__(self, env_id: str, n_envs: int, seed: Seed = None) -> None:
        self.env_id = env_id
        self.n_envs = n_envs
        self._pool = self._make(int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed)
        self.observation_space = _corrected_bounds(self._pool.observation_space)
        self.action_space = _corrected_bounds(self._pool.action_space)
        limit = int(self._pool.spec.config.max_episode_steps)
        self.max_episode_steps = limit if 0 < limit < NO_LIMIT else None
        self.reward_threshold = reward_threshold(env_id, self._pool.spec.reward_threshold)
        self._leaves = leaves(self.observation_space)
        self._log = self._new_log()

    def _make(self, seed: int | Sequence[int]) -> Any:
        self._seed = seed
        # Environment i gets seed + i, an int32 in EnvPool.
        taken = seed % (2**31 - self.n_envs) if isinstance(seed, int) else list(seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the declared bounds of its spaces are rounded to float32
            pool = import_envpool().make_gymnasium(self.env_id, num_envs=self.n_envs, seed=taken)
            pool.observation_space, pool.action_space  # noqa: B018 - cached at the first access
        return pool

    def _new_log(self) -> ActionLog:
        draws_images = any(leaf.kind == "image" for leaf in self._leaves)
        return ActionLog(self.n_envs, self.action_space, MOST_IMAGE_STEPS if draws_images else MOST_STEPS)

    @property
    def must_reset(self) -> bool:
        return self._log.is_full

    def reset(self, seed: Seed = None) -> Any:
        if seed is None and self.must_reset:
            seed = next_seed(self._seed)
        if seed is not None:
            self._pool, self._log = self._make(seed), self._new_log()
        self._log.reset()
        self._obs = cast(self.observation_space, self._leaves, self._pool.reset()[0])
        return self._obs

    def _step_all(self, action: np.ndarray) -> Step:
        obs, reward, terminated, truncated, info = self._pool.step(self._log.step(action))
        self._obs = cast(self.observation_space, self._leaves, obs)
        return Step(self._obs, np.asarray(reward, np.float32), terminated, truncated, info)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        ids = np.flatnonzero(active).astype(np.int32)
        action = self._log.step(np.asarray(action)[ids], ids)
        obs, reward, terminated, truncated, info = self._pool.step(action, ids)  # rows in order of ids
        self._obs = replaced(self._obs, ids, cast(self.observation_space, self._leaves, obs))

        def spread(part: np.ndarray, dtype: Any) -> np.ndarray:
            whole = np.zeros(self.n_envs, dtype)
            whole[ids] = part
            return whole

        said = {key: spread(info[key], info[key].dtype) for key in SUCCESS_KEYS if key in info}
        return Step(self._obs, spread(reward, np.float32), spread(terminated, bool), spread(truncated, bool), said)

    def reset_done(self, done: np.ndarray) -> Any:
        ended = np.flatnonzero(done).astype(np.int32)
        self._log.reset(ended)
        fresh = cast(self.observation_space, self._leaves, self._pool.reset(ended)[0])
        self._obs = replaced(self._obs, ended, fresh)
        return self._obs

    def snapshot(self) -> dict[str, Any] | None:
        if self._log.is_dropped:
            return None
        seed = self._seed if isinstance(self._seed, int) else list(self._seed)
        return {"seed": seed, **self._log.to_plain()}

    def restore(self, saved: Any, obs: Any) -> list[int]:
        if not isinstance(saved, dict) or {*saved} != {"seed", "n_operations", "blocks"}:
            raise ValueError("the record of actions is not one of EnvPool")
        self._pool.close()
        self._pool, self._log = self._make(_saved_seed(saved["seed"], self.n_envs)), self._new_log()
        for which, action in replay(self._log, saved, self.env_id):
            active = np.isin(np.arange(self.n_envs), which) if which is not None else None
            if action is None:
                self.reset() if active is None else self.reset_done(active)
            elif active is None:
                self._step_all(action)
            else:
                every = np.zeros((self.n_envs, *action.shape[1:]), action.dtype)
                every[active] = action
                self._step_some(every, active)
        pairs = zip(jax.tree.leaves(self._obs), jax.tree.leaves(obs), strict=True)
        if not all(np.array_equal(here, there) for here, there in pairs):
            raise DivergedError(f"{self.env_id} on this EnvPool does not repeat the episodes of the run")
        return []

    def success(self, step: Step, env: int) -> float:
        value = step.info.get("is_success", step.info.get("success"))
        return float("nan") if value is None else float(value[env])

    def goals(self) -> GoalFunctions | None:
        if "desired_goal" not in getattr(self.observation_space, "spaces", ()):
            return None
        if self.env_id == "parking-v0":
            return GoalFunctions(goals_module.parking_reward)
        return goals_module.goal_functions(make_env(self.env_id))

    def close(self) -> None:
        self._pool.close()


def next_seed(seed: int | Sequence[int]) -> int | Sequence[int]:
    """Returns the seed of the next pool."""
    if isinstance(seed, int):
        return int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
    return tuple(int(np.random.SeedSequence([one, 1]).generate_state(1)[0]) % SEEDS_END for one in seed)


def _saved_seed(seed: Any, n_envs: int) -> int | Sequence[int]:
    """Returns the seed of a pool from a file.

    Raises:
        ValueError: if it is invalid.
    """
    several = checked_seed(seed, n_envs) if isinstance(seed, list) else None
    return whole("seed", seed, least=0) if several is None else several


def check_envpool_knows(env_id: str) -> None:
    """Checks that EnvPool has an environment.

    Raises:
        MissingExtra: if EnvPool is not installed.
        ValueError: if it does not have the environment, or if that has several players, with what to use instead.
    """
    if env_id not in import_envpool().list_all_envs():
        missing = f"EnvPool does not have {env_id}; use backend='gymnasium'"
        raise ValueError(missing if register(env_id) else unknown_environment(env_id))
    if (n := import_envpool().make_spec(env_id).config.max_num_players) > 1:
        raise ValueError(f"{env_id} of EnvPool has {n} players, and rejeu trains one; use an environment with one")


def envpool_knows(env_id: str) -> bool:
    """Returns whether EnvPool can be used for an id.

    It must be installed and have the environment. False if Gymnasium has only a newer version, or if the goals need a
    package that is not installed.
    """
    if not in_envpool(env_id) or (env_id not in gym.registry and newer_version(env_id) is not None):
        return False
    source = provider(env_id)
    needs_package_for_goals = source is not None and source.extra and env_id != "parking-v0"
    return not needs_package_for_goals or register(env_id)


def reward_threshold(env_id: str, declared: float | None) -> float | None:
    """Returns Gymnasium's reward threshold of an environment, or ``declared`` if Gymnasium does not have it."""
    if env_id in gym.registry:
        return gym.registry[env_id].reward_threshold
    return None if provider(env_id) is not None else declared


def _corrected_bounds(space: gym.Space) -> gym.Space:
    """Returns a space with infinite bounds where EnvPool declares the smallest positive and the largest float."""
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({key: _corrected_bounds(part) for key, part in space.spaces.items()})
    if isinstance(space, gym.spaces.Box) and space.dtype.kind == "f":
        limits = np.finfo(space.dtype)
        if (space.low == limits.tiny).all() and (space.high == limits.max).all():
            return gym.spaces.Box(-np.inf, np.inf, space.shape, space.dtype.type)
    return space
