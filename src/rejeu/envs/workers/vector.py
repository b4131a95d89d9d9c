"""A vector environment with one worker per environment, in processes of this machine or in actors of a Ray cluster."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from rejeu.core.errors import BadEnvironmentError, DivergedError, WorkerError
from rejeu.core.spaces import leaves, rows, structure
from rejeu.core.types import Info, Observation
from rejeu.envs import goals as goals_module, snapshot, validation
from rejeu.envs.base import Seed, Step, VectorEnv, checked_seed, describe_spec, each_seed, success_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.workers import process
from rejeu.envs.workers.pool import RESTARTED, TIMEOUT, Processes, Restarted, Starter, Workers
from rejeu.envs.workers.process import Handover, WorkerFailure


class InWorkers(VectorEnv):
    """Environments in workers that are stepped in parallel.

    If a lost worker is replaced, its episode is truncated. The step has reward 0 and ``truncated=True``, the previous
    observation is repeated as the next observation, and ``info["worker_restarted"]`` contains the reason.

    Args:
        make_one: makes an environment. It is sent to the workers, and called once in this process.
        n_envs: number of environments.
        seed: seed of the first reset. The seed of a restarted worker is derived from the last seed of its environment.
        worker_timeout: timeout of a step or a reset, in seconds. None waits without limit.
        restart_workers: maximum number of lost workers that are replaced, in total.
        starter: starts workers elsewhere, which send their observations. None starts processes with shared memory.

    Raises:
        TypeError: if ``make_one`` cannot be pickled.
        WorkerError: if a worker cannot be started, or fails to make its environment.
    """

    def __init__(
        self,
        make_one: Callable[[], gym.Env],
        n_envs: int,
        seed: Seed = None,
        worker_timeout: float | None = TIMEOUT,
        restart_workers: int = 0,
        starter: Starter | None = None,
    ) -> None:
        env = make_one()
        if (fault := validation.environment_fault(env)) is not None:
            raise TypeError(fault)
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.env_id, self.max_episode_steps, self.reward_threshold = describe_spec(env)
        env.close()
        self.backend = "gymnasium-async" if starter is None else "ray"
        self.n_envs = n_envs
        self.n_steps = 0
        """Number of steps of the vector."""
        self._lost: dict[int, Restarted] = {}
        """Environments whose process was replaced between two steps. The next step reports it."""
        self._restarted: set[int] = set()
        """Environments in new processes that have not been reset yet."""
        self._reset_infos: dict[int, Info] = {}
        self._make_one = make_one
        self._seed = seed
        self._seeds: list[int | None] = [None] * n_envs
        """Last seed of each environment."""
        self._leaves = leaves(self.observation_space)
        self._stores = [np.zeros((n_envs, *leaf.shape), leaf.dtype) for leaf in self._leaves]
        self._obs = jax.tree.unflatten(structure(self.observation_space), self._stores)
        self._rows: list[np.ndarray] | None = None
        """Shared memory for the observations of all environments, None if workers send them."""
        starter = Processes(handovers=self._share) if starter is None else starter
        self.workers = Workers([make_one] * n_envs, starter, worker_timeout, restart_workers)
        for i, theirs in enumerate(self.workers.descriptions):
            if (theirs.observation_space, theirs.action_space) != (self.observation_space, self.action_space):
                self.close()
                raise BadEnvironmentError(
                    f"{self.env_id}, environment {i}: its spaces are {theirs.observation_space} and {theirs.action_space}, "
                    f"those of the first are {self.observation_space} and {self.action_space}; all must be the same"
                )

    def _share(self, context: Any) -> Callable[[int], Handover]:
        """Allocates shared memory for the observations, and returns a function that returns each worker's use of it."""
        buffers = [context.RawArray(ctypes.c_byte, max(self.n_envs * leaf.nbytes, 1)) for leaf in self._leaves]
        self._rows = process.rows(self.observation_space, buffers, self.n_envs)
        # Without the vector, which may be let go.
        return partial(partial, process.in_shared_memory, buffers, self.n_envs)

    def reset(self, seed: Seed = None) -> Observation:
        seed = self._seed if seed is None else checked_seed(seed, self.n_envs)
        self._seed = None
        return self._reset(dict(enumerate(each_seed(seed, self.n_envs))))

    def reset_done(self, done: np.ndarray) -> Observation:
        return self._reset(dict.fromkeys(np.flatnonzero(done).tolist()))

    def _reset(self, seeds: Mapping[int, int | None]) -> Any:
        """Resets the environments in ``seeds``, and repeats the reset of those whose worker was lost during it."""
        for i, seed in seeds.items():
            self._lost.pop(i, None)
            if seed is not None:
                self._seeds[i] = seed
        waiting = {i: ("reset", self._next_seed(i) if seed is None else seed) for i, seed in seeds.items()}
        while waiting:
            replies = self._heard(self.workers.ask(waiting), "reset")
            done = [i for i, reply in replies.items() if not isinstance(reply, Restarted)]
            self._take({i: replies[i] for i in done})
            self._reset_infos |= {i: replies[i][1] for i in done}
            waiting = {i: ("reset", self._next_seed(i)) for i in replies if i not in done}
        return self._obs

    def _next_seed(self, i: int) -> int | None:
        """Returns a seed derived from the last one for an environment in a new process, None for others."""
        if i not in self._restarted:
            return None
        self._restarted.discard(i)
        before = self._seeds[i]
        if before is None:
            return None
        seed = self._seeds[i] = int(np.random.SeedSequence([before, 1]).generate_state(1)[0])
        return seed

    def _step_all(self, action: np.ndarray) -> Step:
        return self._step_each(range(self.n_envs), action)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        return self._step_each(np.flatnonzero(active).tolist(), action)

    def _step_each(self, indices: Sequence[int], action: np.ndarray) -> Step:
        reward = np.zeros(self.n_envs, np.float32)
        terminated, truncated = np.zeros(self.n_envs, bool), np.zeros(self.n_envs, bool)
        info: list[Info] = [{}] * self.n_envs
        self.n_steps += 1
        lost = {i: self._lost.pop(i) for i in indices if i in self._lost}
        action = rows(action)
        asked = {i: ("step", action[i]) for i in indices if i not in lost}
        replies = {**self._heard(self.workers.ask(asked), "step"), **lost}
        stepped = {}
        for i, reply in replies.items():
            if isinstance(reply, Restarted):
                truncated[i], info[i] = True, {RESTARTED: reply.why}
            else:
                _, reward[i], terminated[i], truncated[i], info[i] = stepped[i] = reply
        self._take(stepped)
        return Step(self._obs, reward, terminated, truncated, info)

    def _take(self, replies: Mapping[int, Any]) -> None:
        """Writes the observations of answers, or copies them out of shared memory, which a lost worker may still change."""
        if self._rows is None:
            for i, reply in replies.items():
                for store, leaf in zip(self._stores, reply[0], strict=True):
                    store[i] = leaf
            return
        rows: Any = slice(None) if len(replies) == self.n_envs else [*replies]
        for store, shared in zip(self._stores, self._rows, strict=True):
            store[rows] = shared[rows]

    def _heard(self, replies: dict[int, Any], method: str) -> dict[int, Any]:
        """Returns the answers. Raises if one of them is a failure."""
        self._restarted.update(i for i, reply in replies.items() if isinstance(reply, Restarted))
        failed = {i: reply for i, reply in replies.items() if isinstance(reply, WorkerFailure)}
        if not failed:
            return replies
        first, failure = next(iter(failed.items()))
        if failure.cause == "bad answer":
            raise BadEnvironmentError(validation.with_location(self.env_id, first, self.n_steps, failure.message))
        where = f"environments {', '.join(map(str, failed))}" if len(failed) > 1 else f"environment {first}"
        raise WorkerError(f"{where} failed in a worker process, at a {method}:\n{failure.trace}")

    def infos(self, begun: bool = False) -> list[Info]:
        return [self._reset_infos[i] for i in range(self.n_envs)] if begun else super().infos()

    def call(self, name: str) -> list[Any]:
        replies = self.workers.ask(dict.fromkeys(range(self.n_envs), ("call", process.call_method, name, (), {})))
        for reply in replies.values():
            if isinstance(reply, WorkerFailure) and reply.cause == "no attribute":  # perhaps of something in the method
                raise AttributeError(f"{name}:\n{reply.trace}")
        self._lost |= {i: reply for i, reply in self._heard(replies, name).items() if isinstance(reply, Restarted)}
        return [None if i in self._lost else replies[i] for i in range(self.n_envs)]

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def goals(self) -> GoalFunctions | None:
        return goals_module.goal_functions(self._make_one())

    def snapshot(self) -> Any:
        replies = self._heard(self.workers.ask(dict.fromkeys(range(self.n_envs), ("snapshot",))), "snapshot")
        self._lost |= {i: reply for i, reply in replies.items() if isinstance(reply, Restarted)}
        is_supported = all(isinstance(state, list) for state in replies.values())  # None: not supported
        return [replies[i] for i in range(self.n_envs)] if is_supported else None

    def restore(self, saved: Any, obs: Observation) -> list[int]:
        snapshot.check_count(saved, self.n_envs)
        replies = self.workers.ask({i: ("restore", state) for i, state in enumerate(saved)})
        for i, reply in replies.items():
            if not isinstance(reply, bool):
                why = reply.message if isinstance(reply, WorkerFailure) else reply.why
                raise DivergedError(f"environment {i} cannot be restored: {why}")
        for store, leaf in zip(self._stores, jax.tree.leaves(obs), strict=True):
            store[...] = leaf
        self._seed = None
        return [i for i, is_over in replies.items() if is_over]

    def close(self) -> None:
        """Closes the environments and ends the processes. Further calls do nothing."""
        self.workers.close()
