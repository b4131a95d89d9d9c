"""Buffers with Stable-Baselines3's attributes and methods: what ``model.replay_buffer`` and ``model.rollout_buffer`` return.

They show the buffers of :mod:`rejeu.replay` from which an agent learns, and only agents make them. Their arrays are copies
that cannot be written to. To store and draw transitions yourself use :class:`rejeu.replay.replay_memory.ReplayMemory`.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

from rejeu.core.algorithm import unmasked
from rejeu.core.types import Observation
from rejeu.replay.hindsight import GoalSelectionStrategy
from rejeu.replay.ring import LAST, TERMINATED
from rejeu.sb3.common.preprocessing import get_action_dim, get_obs_shape, maybe_transpose
from rejeu.sb3.common.type_aliases import (
    DictReplayBufferSamples,
    DictRolloutBufferSamples,
    ReplayBufferSamples,
    RolloutBufferSamples,
)
from rejeu.sb3.common.utils import Tensor
from rejeu.sb3.common.vec_env.base_vec_env import TIME_LIMIT_TRUNCATED

KEY_TO_GOAL_STRATEGY = {strategy.value: strategy for strategy in GoalSelectionStrategy}
"""Where the goals of hindsight come from, by name."""


def by_leaf(function: Callable[..., Any], *observations: Observation) -> Any:
    """Returns a function of arrays applied to observations, key by key where they are dicts."""
    if isinstance(observations[0], dict):
        return {key: by_leaf(function, *(observation[key] for observation in observations)) for key in observations[0]}
    return function(*observations)


def fixed(array: object) -> np.ndarray:
    """Returns an array that cannot be written to: writing to a copy would change nothing that is learned from."""
    array = np.asarray(array)
    array.flags.writeable = False
    return array


class BaseBuffer:
    """The steps that an agent holds. Abstract."""

    agent: Any
    """The agent."""
    optimize_memory_usage, handle_timeout_termination = False, True

    def __init__(self, *args: object, **kwargs: Any) -> None:
        raise TypeError(
            f"{type(self).__name__} shows the buffer of an agent, as model.replay_buffer or model.rollout_buffer, and cannot "
            "be made by hand; use rejeu.replay.replay_memory.ReplayMemory to store transitions yourself"
        )

    @classmethod
    def of(cls, agent: Any) -> Any:
        """Returns a view of the buffer of an agent."""
        view: Any = cls.__new__(cls)
        view.agent, view.device = agent, agent.device
        view.observation_space, view.action_space = agent.observation_space, agent.action_space
        view.obs_shape, view.action_dim = get_obs_shape(agent.observation_space), get_action_dim(agent.action_space)
        return view

    def reset(self) -> None:
        """Empties the buffer of the agent; new episodes begin."""
        self.agent.run.replay = self.agent.make_buffer(self.agent.run.env)
        self.agent.abandon_episodes()

    def to_torch(self, array: object, copy: bool = True) -> Tensor:
        """Returns a NumPy array with the methods of tensors."""
        return Tensor.of(np.array(array) if copy else array)

    @staticmethod
    def swap_and_flatten(arr: np.ndarray) -> np.ndarray:
        """Returns ``(n_steps, n_envs, ...)`` as ``(n_envs * n_steps, ...)``."""
        arr = arr[..., None] if arr.ndim < 3 else arr
        return arr.swapaxes(0, 1).reshape(-1, *arr.shape[2:])


class ReplayBuffer(BaseBuffer):
    """A replay buffer."""

    own: Any = None
    """The buffer of a copy; None for that of the agent as it is now."""
    seen: tuple[Any, dict[str, Any]] = (None, {})
    """The arrays, and when they were read."""
    SHOWN: ClassVar = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")

    @property
    def core(self) -> Any:
        """The buffer that is shown; None of an agent that was loaded without environments."""
        return self.agent.run.replay if self.own is None else self.own

    @property
    def n_envs(self) -> int:
        """Number of environments."""
        return 1 if self.core is None else self.core.ring.n_envs

    @property
    def buffer_size(self) -> int:
        """Rows for steps of every environment; each finished episode uses one for its last observation."""
        return self.agent.config.buffer_size if self.core is None else self.core.ring.rows

    @property
    def pos(self) -> int:
        """Number of steps of every environment."""
        return 0 if self.core is None else int(self.core.ring.n_steps.min())

    @property
    def full(self) -> bool:
        """Whether new steps replace the oldest."""
        return self.core is not None and bool((self.core.ring.head >= self.core.ring.rows).all())

    def size(self) -> int:
        """Returns the number of steps of every environment; of a full buffer its size, as scripts compare them."""
        return self.buffer_size if self.full else self.pos

    def __getattr__(self, name: str) -> Any:
        if name not in self.SHOWN or self.core is None:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        ring, n = self.core.ring, self.pos
        if self.seen[0] == (now := (id(ring), ring.head.tobytes())):
            return self.seen[1][name]
        times = [np.arange(ring.oldest()[env], ring.head[env]) for env in range(ring.n_envs)]
        stored_times = [t[ring.kind[ring.index(np.full(len(t), env), t)] != LAST][-n:] for env, t in enumerate(times)]
        time = np.stack(stored_times, axis=1).ravel() if n else np.zeros(0, int)
        envs = np.tile(np.arange(ring.n_envs), n)
        following = ring.index(envs, time + 1)
        step, obs = ring.read(ring.index(envs, time))
        shaped = lambda array: fixed(np.array(array).reshape(n, ring.n_envs, *array.shape[1:]))  # noqa: E731
        tree = lambda leaves: unmasked(ring.tree([shaped(leaf) for leaf in leaves]))[0]  # noqa: E731
        terminated = ring.kind[ring.index(envs, time)] == TERMINATED
        ended = terminated | (ring.kind[following] == LAST)
        parts = [tree(obs), tree(ring.read(following)[1]), shaped(step["action"]), shaped(step["reward"])]
        parts += [shaped(ended.astype(np.float32)), shaped((ended & ~terminated).astype(np.float32))]
        self.seen = now, dict(zip(self.SHOWN, parts, strict=True))
        return self.seen[1][name]

    def __deepcopy__(self, memo: Any) -> Any:
        """Returns a view of a copy of the buffer, which is no agent's until ``model.replay_buffer`` is set to it."""
        new = self.of(self.agent)
        new.own = copy.copy(self.core)
        new.own.ring, new.own.priorities = copy.deepcopy((self.core.ring, self.core.priorities), memo)
        for name in ("begin", "add", "draw"):  # those of the agent's VecNormalize
            new.own.__dict__.pop(name, None)
        return new

    def add(
        self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: Any
    ) -> None:
        """Adds one step of every environment to the buffer of the agent, whose running episodes end.

        Args:
            obs: observations before the step, ``(n_envs, ...)``; of one environment also without this axis.
            next_obs: those after it, the final ones where an episode ended.
            action: ``(n_envs, action_dim)``, in [-1, 1].
            reward: ``(n_envs,)``.
            done: whether an episode ended, ``(n_envs,)``.
            infos: one dict for each environment; ``TimeLimit.truncated`` says whether only a time limit ended it.
        """
        timeouts = np.array([bool(info.get(TIME_LIMIT_TRUNCATED, False)) for info in infos])
        terminated, reward = np.ravel(done).astype(bool) & ~timeouts, np.ravel(reward).astype(np.float32)
        rows = lambda leaf, space: maybe_transpose(np.asarray(leaf), space).reshape(self.n_envs, *space.shape)  # noqa: E731
        obs, next_obs = (by_leaf(rows, tree, self.observation_space) for tree in (obs, next_obs))
        # Methods of the class take what is given, also behind those of VecNormalize.
        ring, buffer_class = self.core.ring, type(self.core)
        buffer_class.begin(self.core, obs)
        actions = np.asarray(action, ring.action.dtype).reshape(ring.n_envs, *ring.action.shape[1:])
        buffer_class.add(self.core, actions, reward, terminated, next_obs)
        if self.own is None:
            self.agent.abandon_episodes()

    def extend(self, *args: object) -> None:
        """Adds several rows, with the arguments of :meth:`add` and a leading axis."""
        for row in zip(*args, strict=True):
            self.add(*row)

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Returns transitions drawn as for the agent's updates, with replacement.

        They are drawn by NumPy's global generator, as scripts seed it, and do not change what the agent draws.

        Args:
            batch_size: number of transitions.
            env: a ``VecNormalize`` that scales them; None for observations and rewards as they are stored.

        Raises:
            ValueError: if the buffer holds no steps.
        """
        if not self.pos:
            raise ValueError(
                f"the replay buffer of this {self.agent.name} holds no steps; learn or load_replay_buffer first"
            )
        rng = np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002 - as scripts seed it
        batch = type(self.core).draw(self.core, rng, (batch_size,))[0]
        scaled = (lambda obs: obs) if env is None else env.normalize_obs
        obs, following = (by_leaf(Tensor.of, scaled(unmasked(tree)[0])) for tree in (batch.obs, batch.next_obs))
        reward = batch.reward if env is None else env.normalize_reward(batch.reward).astype(np.float32)
        samples_class = DictReplayBufferSamples if isinstance(obs, dict) else ReplayBufferSamples
        column = lambda array: self.to_torch(array).reshape(-1, 1)  # noqa: E731
        actions = self.to_torch(batch.action).reshape(batch_size, -1)
        samples = samples_class(obs, actions, following, column(np.float32(batch.discount == 0)), column(reward))
        return samples._replace(discounts=column(batch.discount)) if self.agent.config.n_steps > 1 else samples


class DictReplayBuffer(ReplayBuffer):
    """A replay buffer for Dict observations."""


class NStepReplayBuffer(ReplayBuffer):
    """A replay buffer with n-step returns."""

    @property
    def n_steps(self) -> int:
        """Number of rewards that are summed."""
        return self.agent.config.n_steps

    @property
    def gamma(self) -> float:
        """Discount factor."""
        return self.agent.config.gamma


class HerReplayBuffer(ReplayBuffer):
    """A replay buffer that gives most sampled transitions a goal that was reached later (hindsight experience replay)."""

    @property
    def n_sampled_goal(self) -> float:
        """Number of transitions with new goals for each with the one that was pursued."""
        return self.agent.config.hindsight.n_sampled_goal

    @property
    def her_ratio(self) -> float:
        """Share of the sampled transitions that get new goals."""
        return self.n_sampled_goal / (self.n_sampled_goal + 1)

    @property
    def goal_selection_strategy(self) -> Any:
        """Which steps new goals are taken from."""
        return self.agent.config.hindsight.goal_selection_strategy

    def set_env(self, env: Any) -> None:
        """Sets the environments whose ``compute_reward`` is used."""
        self.agent.keep_buffer(self.agent.make_envs(env))

    def truncate_last_trajectory(self) -> None:
        """Ends the running episodes; warns if there are any."""
        if self.agent.run.obs is not None and self.pos:
            warnings.warn("The last trajectory in the replay buffer will be truncated.", UserWarning, stacklevel=2)
        self.agent.abandon_episodes()


class RolloutBuffer(BaseBuffer):
    """The steps of one rollout, with their advantages."""

    observations: Observation
    pos: int
    """Number of steps of each environment."""
    full: bool
    """Whether the rollout is complete."""

    def size(self) -> int:
        """Returns the number of steps of each environment."""
        return self.pos

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:
        """Yields minibatches in random order; None for one of all steps.

        Raises:
            AssertionError: if the buffer is not full.
        """
        if not self.full:
            raise AssertionError(f"the rollout has {self.pos} of {self.buffer_size} steps")
        order = np.random.permutation(self.buffer_size * self.n_envs)  # noqa: NPY002
        samples_class = DictRolloutBufferSamples if isinstance(self.observations, dict) else RolloutBufferSamples
        for start in range(0, len(order), batch_size or len(order)):
            indices = order[start : start + (batch_size or len(order))]
            parts = (self.observations, self.actions, self.values, self.log_probs, self.advantages, self.returns)
            flat = [
                by_leaf(lambda leaf, indices=indices: self.to_torch(self.swap_and_flatten(leaf)[indices]), leaves)
                for leaves in parts
            ]
            yield samples_class(flat[0], flat[1].astype(np.float32), *(leaves.reshape(-1) for leaves in flat[2:]))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"{type(self).__name__} has no attribute {name!r}; agents with memory, normalize or rnd, and ARS, show no values"
        )


class DictRolloutBuffer(RolloutBuffer):
    """A rollout buffer for Dict observations."""
