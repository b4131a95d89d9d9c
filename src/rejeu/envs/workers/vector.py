"""A vector environment with one worker per environment, in processes of this machine or in actors of a Ray cluster."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, NamedTuple

import gymnasium as gym
import jax
import msgspec
import numpy as np
from msgspec import Meta

from rejeu.core.errors import BadEnvironmentError, DivergedError, WorkerError
from rejeu.core.records import Count, convert
from rejeu.core.spaces import Leaf, leaves, rows, structure
from rejeu.envs import goals as goals_module, snapshot, validation
from rejeu.envs.base import SUCCESS_KEYS, Seed, Step, VectorEnv, describe_spec, each_seed, success_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.workers import process
from rejeu.envs.workers.pool import RESTARTED, TIMEOUT, Processes, Restarted, Starter, Workers
from rejeu.envs.workers.process import Handover, WorkerFailure

INDEX = np.uint16
"""Data type of the indices of environments in a record."""


class Arrival(NamedTuple):
    """What an environment returned for an action, and the observation to act on next."""

    obs: list[np.ndarray]
    """Leaves of the true successor."""
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    begun: list[np.ndarray] | None
    """Leaves of the first observation of the next episode, None if the episode goes on."""


class SavedResult(msgspec.Struct, forbid_unknown_fields=True):
    """A result in a file. Of its info only the success is kept."""

    env: Count
    obs: list[np.ndarray]
    reward: Annotated[float, Meta(ge=-1e300, le=1e300)]
    terminated: bool
    truncated: bool
    success: Annotated[float, Meta(ge=0, le=1)] | None
    begun: list[np.ndarray] | None


def to_saved(env: int, result: Arrival) -> dict[str, Any]:
    """Returns a result of environment ``env`` as plain data."""
    success = success_of(result.info)
    saved = {"env": env, **result._asdict(), "success": None if np.isnan(success) else success}
    del saved["info"]
    return saved


def from_saved(saved: Any, leaves: Sequence[Leaf]) -> tuple[int, Arrival]:
    """Returns the index of the environment, and what :func:`to_saved` was given.

    Raises:
        CheckpointError, ValueError: if it is damaged.
    """
    one = convert(saved, SavedResult)
    for parts in (one.obs, *(() if one.begun is None else (one.begun,))):
        found = [(part.shape, part.dtype) for part in parts]
        if found != [(leaf.shape, leaf.dtype) for leaf in leaves]:
            raise ValueError(f"a result that waits has observations of {found}, not those of the environments")
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError("a result that waits is not finite")
    if (one.terminated or one.truncated) != (one.begun is not None):
        raise ValueError("a result that waits does not say where the next episode begins")
    info = {} if one.success is None else {SUCCESS_KEYS[0]: one.success}
    return one.env, Arrival(one.obs, one.reward, one.terminated, one.truncated, info, one.begun)


class InWorkers(VectorEnv):
    """Environments in workers that are stepped in parallel.

    If a lost worker is replaced, its episode is truncated. The step has reward 0 and ``truncated=True``, the previous
    observation is repeated as the next observation, and ``info["worker_restarted"]`` contains the reason.

    With ``wait_for``, the environments can also step on their own: :meth:`send` gives actions to those that await one, and
    :meth:`receive` returns the results that arrive first. The other methods step and reset all environments together.

    Args:
        make_one: makes an environment. It is sent to the workers, and called once in this process.
        n_envs: number of environments.
        seed: seed of the first reset. The seed of a restarted worker is derived from the last seed of its environment.
        worker_timeout: timeout of a step or a reset, in seconds. None waits without limit.
        restart_workers: maximum number of lost workers that are replaced, in total.
        wait_for: number of results that :meth:`receive` returns.
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
        wait_for: int | None = None,
        starter: Starter | None = None,
    ) -> None:
        one = make_one()
        if (fault := validation.environment_fault(one)) is not None:
            raise TypeError(fault)
        self.observation_space, self.action_space = one.observation_space, one.action_space
        self.env_id, self.max_episode_steps, self.reward_threshold = describe_spec(one)
        one.close()
        self.backend = "gymnasium-async" if starter is None else "ray"
        self.n_envs, self.wait_for = n_envs, wait_for
        self.n_steps = 0
        """Number of steps of the vector."""
        self._lost: dict[int, Restarted] = {}
        """Environments whose process was replaced between two steps. The next step reports it."""
        self._restarted: set[int] = set()
        """Environments in new processes that have not been reset yet."""
        self._reset_infos: dict[int, dict[str, Any]] = {}
        self._make_one = make_one
        self._seed = seed
        self._seeds: list[int | None] = [None] * n_envs
        """Last seed of each environment."""
        self._results: dict[int, Arrival] = {}
        """Results that have arrived and were not taken yet, by environment, the oldest first."""
        self._begun: dict[int, list[np.ndarray]] = {}
        """First observations of episodes that environments have begun by themselves, where no result was taken since."""
        self._pending: set[int] = set()
        """Environments that are stepping on their own."""
        self._leaves = leaves(self.observation_space)
        self._stores = [np.zeros((n_envs, *leaf.shape), leaf.dtype) for leaf in self._leaves]
        self._obs = jax.tree.unflatten(structure(self.observation_space), self._stores)
        self._rows: list[np.ndarray] | None = None
        """Shared memory for the observations of all environments, None if workers send them."""
        starter = Processes(handovers=self._share) if starter is None else starter
        self.workers = Workers([make_one] * n_envs, starter, worker_timeout, restart_workers)
        for i, made in enumerate(self.workers.descriptions):
            if (made.observation_space, made.action_space) != (self.observation_space, self.action_space):
                self.close()
                raise BadEnvironmentError(
                    f"{self.env_id}, environment {i}: its spaces are {made.observation_space} and {made.action_space}, "
                    f"those of the first are {self.observation_space} and {self.action_space}; all must be the same"
                )

    def _share(self, context: Any) -> Callable[[int], Handover]:
        """Allocates shared memory for the observations, and returns a function that returns each worker's use of it."""
        buffers = [context.RawArray(ctypes.c_byte, max(self.n_envs * leaf.nbytes, 1)) for leaf in self._leaves]
        self._rows = process.rows(self.observation_space, buffers, self.n_envs)
        return partial(
            partial, process.in_shared_memory, buffers, self.n_envs
        )  # without the vector, which may be let go

    def reset(self, seed: Seed = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        self._results, self._begun, self._pending = {}, {}, set()
        return self._reset(dict(enumerate(each_seed(seed, self.n_envs))))

    def reset_done(self, done: np.ndarray) -> Any:
        rest = []
        for i in np.flatnonzero(done).tolist():
            if i in self._begun:
                self._put(i, self._begun.pop(i))
            else:
                rest.append(i)
        return self._reset(dict.fromkeys(rest))

    def _reset(self, seeds: Mapping[int, int | None]) -> Any:
        """Resets the environments in ``seeds``, and repeats the reset of those whose worker was lost during it."""
        for i, seed in seeds.items():
            self._lost.pop(i, None)
            if seed is not None:
                self._seeds[i] = seed
        waiting = {i: ("reset", self._next_seed(i) if seed is None else seed) for i, seed in seeds.items()}
        while waiting:
            said = self._heard(self.workers.ask(waiting), "reset")
            done = [i for i, answer in said.items() if not isinstance(answer, Restarted)]
            self._take({i: said[i] for i in done})
            self._reset_infos |= {i: said[i][1] for i in done}
            waiting = {i: ("reset", self._next_seed(i)) for i in said if i not in done}
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

    def _step_each(self, which: Sequence[int], action: np.ndarray) -> Step:
        reward = np.zeros(self.n_envs, np.float32)
        terminated, truncated = np.zeros(self.n_envs, bool), np.zeros(self.n_envs, bool)
        info: list[dict[str, Any]] = [{}] * self.n_envs
        self.n_steps += 1
        lost = {i: self._lost.pop(i) for i in which if i in self._lost}
        action = rows(action)
        asked = {i: ("step", action[i]) for i in which if i not in lost}
        said = {**self._heard(self.workers.ask(asked), "step"), **lost}
        stepped = {}
        for i, answer in said.items():
            if isinstance(answer, Restarted):
                truncated[i], info[i] = True, {RESTARTED: answer.why}
            else:
                _, reward[i], terminated[i], truncated[i], info[i] = stepped[i] = answer
        self._take(stepped)
        return Step(self._obs, reward, terminated, truncated, info)

    def _take(self, answers: Mapping[int, Any]) -> None:
        """Writes the observations of answers, or copies them out of shared memory, which a lost worker may still change."""
        if self._rows is None:
            for i, answer in answers.items():
                self._put(i, answer[0])
            return
        rows: Any = slice(None) if len(answers) == self.n_envs else [*answers]
        for store, shared in zip(self._stores, self._rows, strict=True):
            store[rows] = shared[rows]

    def _put(self, i: int, parts: Sequence[np.ndarray]) -> None:
        """Writes the leaves of an observation of environment ``i``."""
        for store, part in zip(self._stores, parts, strict=True):
            store[i] = part

    def _parts(self, i: int, encoded: Any) -> list[np.ndarray]:
        """Returns the leaves of an observation of environment ``i`` that has just arrived."""
        return encoded if self._rows is None else [np.array(shared[i]) for shared in self._rows]

    def send(self, action: np.ndarray) -> None:
        """Gives actions to the environments that await one, which step on their own, and reset where an episode ends.

        Args:
            action: in the environment's own range, ``(n_envs, ...)``; other rows are ignored.
        """
        idle = [i for i in range(self.n_envs) if i not in self._pending and i not in self._results]
        lost, action = [i for i in idle if i in self._lost], rows(action)
        self.workers.send({i: ("step_and_reset", action[i]) for i in idle if i not in self._lost})
        self._pending.update(idle)
        for i in lost:
            self._arrived(i, self._lost.pop(i))

    def receive(self) -> Step:
        """Returns the first ``wait_for`` results that arrive; ``which`` of the step says whose they are.

        The observations of the other environments are those that they were given actions for. Where an episode ended, the
        next has begun; :meth:`reset_done` returns its first observation.

        Raises:
            WorkerError, BadEnvironmentError: as for :meth:`step`.
        """
        assert self.wait_for is not None
        while len(self._results) < self.wait_for:
            self._listen()
        which = np.array(sorted([*self._results][: self.wait_for]))
        self.n_steps += 1
        reward = np.zeros(self.n_envs, np.float32)
        terminated, truncated = np.zeros(self.n_envs, bool), np.zeros(self.n_envs, bool)
        info: list[dict[str, Any]] = [{}] * self.n_envs
        self.info = info
        for i in which.tolist():
            result = self._results.pop(i)
            self._put(i, result.obs)
            reward[i], terminated[i], truncated[i], info[i] = result[1:5]
            if result.begun is not None:
                self._begun[i] = result.begun
        return Step(self._obs, reward, terminated, truncated, info, which=which)

    def _listen(self) -> None:
        """Waits until at least one environment that steps on its own has answered."""
        said = self.workers.first(self._pending)
        for i, answer in said.items():
            if isinstance(answer, WorkerFailure):
                self._pending.discard(i)
            else:
                self._arrived(i, answer)
        self._heard({i: answer for i, answer in said.items() if isinstance(answer, WorkerFailure)}, "step")

    def _arrived(self, i: int, answer: Any) -> None:
        """Keeps the result of an environment. One whose worker was lost has none until its new episode has begun."""
        if isinstance(answer, Restarted):
            self._lost[i] = answer
            self._restarted.add(i)
            self.workers.send({i: ("reset", self._next_seed(i))})
            return
        self._pending.discard(i)
        begun = self._parts(i, answer[0])
        if i in self._lost:
            before = [np.array(store[i]) for store in self._stores]
            why = {RESTARTED: self._lost.pop(i).why}
            self._results[i] = Arrival(before, 0.0, False, True, why, begun)
            return
        _, reward, terminated, truncated, info, final, _ = answer
        self._results[i] = Arrival(
            begun if final is None else final, reward, terminated, truncated, info, None if final is None else begun
        )

    def _heard(self, said: dict[int, Any], what: str) -> dict[int, Any]:
        """Returns the answers. Raises if one of them is a failure."""
        self._restarted.update(i for i, answer in said.items() if isinstance(answer, Restarted))
        failed = {i: answer for i, answer in said.items() if isinstance(answer, WorkerFailure)}
        if not failed:
            return said
        first, failure = next(iter(failed.items()))
        if failure.kind == "bad answer":
            raise BadEnvironmentError(validation.with_location(self.env_id, first, self.n_steps, failure.message))
        which = f"environments {', '.join(map(str, failed))}" if len(failed) > 1 else f"environment {first}"
        raise WorkerError(f"{which} failed in a worker process, at a {what}:\n{failure.trace}")

    def infos(self, begun: bool = False) -> list[dict[str, Any]]:
        return [self._reset_infos[i] for i in range(self.n_envs)] if begun else super().infos()

    def call(self, name: str) -> list[Any]:
        said = self.workers.ask(dict.fromkeys(range(self.n_envs), ("call", process.call_method, name, (), {})))
        for answer in said.values():
            if (
                isinstance(answer, WorkerFailure) and answer.kind == "no attribute"
            ):  # perhaps of something in the method
                raise AttributeError(f"{name}:\n{answer.trace}")
        self._lost |= {i: answer for i, answer in self._heard(said, name).items() if isinstance(answer, Restarted)}
        return [None if i in self._lost else said[i] for i in range(self.n_envs)]

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def goals(self) -> GoalFunctions | None:
        return goals_module.goal_functions(self._make_one())

    def snapshot(self) -> Any:
        while self._pending:
            self._listen()
        said = self._heard(self.workers.ask(dict.fromkeys(range(self.n_envs), ("snapshot",))), "snapshot")
        self._lost |= {i: answer for i, answer in said.items() if isinstance(answer, Restarted)}
        for i in self._lost:
            self._results.pop(i, None)
        known = all(isinstance(one, list) for one in said.values())  # None: not supported
        states = [said[i] for i in range(self.n_envs)] if known else None
        if states is None or self.wait_for is None:
            return states
        results = [to_saved(i, result) for i, result in self._results.items()]
        return {"states": states, "wait_for": self.wait_for, "results": results}

    def restore(self, saved: Any, obs: Any) -> list[int]:
        if isinstance(saved, dict) and {*saved} == {"states", "wait_for", "results"}:
            self._restore_results(saved)
            saved = saved["states"]
        snapshot.check_count(saved, self.n_envs)
        replies = self.workers.ask({i: ("restore", one) for i, one in enumerate(saved)})
        for i, answer in replies.items():
            if not isinstance(answer, bool):
                why = answer.message if isinstance(answer, WorkerFailure) else answer.why
                raise DivergedError(f"environment {i} cannot be restored: {why}")
        for store, leaf in zip(self._stores, jax.tree.leaves(obs), strict=True):
            store[...] = leaf
        self._seed = None
        return [i for i, is_over in replies.items() if is_over]

    def _restore_results(self, saved: Mapping[str, Any]) -> None:
        """Restores the results that waited.

        Raises:
            CheckpointError, ValueError: if they are damaged, or of another ``wait_for``.
        """
        if self.wait_for is None or saved["wait_for"] != self.wait_for:
            raise ValueError(f"the run had wait_for={saved['wait_for']!r}, and the environments have {self.wait_for}")
        results = [from_saved(one, self._leaves) for one in convert(saved["results"], list[Any])]
        if len({i for i, _ in results}) < len(results) or any(i >= self.n_envs for i, _ in results):
            raise ValueError(f"the results that wait are not those of {self.n_envs} environments")
        self._results = dict(results)

    def close(self) -> None:
        """Closes the environments and ends the processes. Further calls do nothing."""
        self.workers.close()
