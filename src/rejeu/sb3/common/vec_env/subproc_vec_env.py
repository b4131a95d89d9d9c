"""Environments in worker processes, behind Stable-Baselines3's interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym

from rejeu.core.errors import BadEnvironmentError, WorkerError
from rejeu.core.types import Action, Info, Observation
from rejeu.envs.validation import with_location
from rejeu.envs.workers.pool import RESTARTED, TIMEOUT, Processes, ProcessWorker, Restarted, Workers
from rejeu.envs.workers.process import WorkerFailure
from rejeu.sb3.common.vec_env.base_vec_env import SingleEnvs, VecEnvIndices, VecEnvStepReturn, stacked


class SubprocVecEnv(SingleEnvs):
    """Environments stepped in parallel, one process each, and reset within the step that ends an episode.

    Worth it where a step takes longer than a few tenths of a millisecond. The processes import the main script, so it must
    create the environment under ``if __name__ == "__main__":``.

    Args:
        env_fns: functions that each return a new environment; lambdas are allowed.
        start_method: start method of ``multiprocessing``; None: ``"forkserver"`` on Linux, else ``"spawn"``. ``"fork"`` is
            unsafe once JAX has started.
        worker_timeout: maximum time of a step or a reset in seconds; None for no limit.
        restart_workers: how many times a process that crashed or hung is replaced. Its episode is truncated with the
            reward 0, and its last observation is repeated as ``terminal_observation``.

    Raises:
        TypeError: if a function cannot be sent to another process.
        BadEnvironmentError: if an environment returns invalid values.
        WorkerError: if an environment raises, with its traceback; if a process crashes or hangs; if the main script
            cannot be imported.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        start_method: str | None = None,
        worker_timeout: float | None = TIMEOUT,
        restart_workers: int = 0,
    ) -> None:
        if not env_fns:
            raise ValueError("env_fns is empty; give one function for each environment")
        self.waiting = False
        self._n_steps = 0
        self._last: list[Any] = [None] * len(env_fns)
        """The last observation of each environment."""
        self.workers = Workers(env_fns, Processes(start_method, preload=__name__), worker_timeout, restart_workers)
        first = self.workers.descriptions[0]
        super().__init__(len(env_fns), first.observation_space, first.action_space)
        self.metadata, self.render_mode = first.metadata, first.render_mode

    @property
    def closed(self) -> bool:
        """Whether the processes have been ended."""
        return self.workers.closed

    @property
    def processes(self) -> list[Any]:
        """The processes, one for each environment."""
        return [worker.process for worker in self.workers.workers if isinstance(worker, ProcessWorker)]

    def reset(self) -> Observation:
        for i, (obs, info) in self._reset(range(self.num_envs)).items():
            self._last[i], self.reset_infos[i] = obs, info
        self._reset_seeds()
        self._reset_options()
        return stacked(self.observation_space, self._last)

    def _reset(self, numbers: Sequence[int]) -> dict[int, tuple[Observation, Info]]:
        """Resets some environments, again where the process had to be replaced; returns observations and infos."""
        done: dict[int, tuple[Observation, Info]] = {}
        while len(done) < len(numbers):
            waiting = {i: ("reset", self._seeds[i], self._options[i]) for i in numbers if i not in done}
            self.workers.send(waiting)
            replies = self._receive(waiting)
            done |= {i: reply for i, reply in replies.items() if not isinstance(reply, Restarted)}
        return done

    def step_async(self, actions: Action) -> None:
        self._check_count(actions)
        self._n_steps += 1
        pairs = zip(range(self.num_envs), actions, strict=False)
        self.workers.send({i: ("step_and_reset", action) for i, action in pairs})
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        self.waiting = False
        replies = self._receive(range(self.num_envs))
        lost = {i: reply.why for i, reply in replies.items() if isinstance(reply, Restarted)}
        for i, (obs, reset_info) in self._reset([*lost]).items():
            replies[i] = obs, 0.0, False, True, {RESTARTED: lost[i]}, self._last[i], reset_info
        self._last = [replies[i][0] for i in range(self.num_envs)]
        return self._stepped(replies[i] for i in range(self.num_envs))

    def close(self) -> None:
        """Ends the processes; a second call does nothing."""
        self.workers.close()

    def _call(self, indices: VecEnvIndices, function: Callable[..., Any], *arguments: object) -> list[Any]:
        """Calls ``function(env, *arguments)`` in some processes and returns the results.

        Raises:
            AttributeError: if the function does; the processes then keep running.
        """
        env_indices = self._get_indices(indices)
        self.workers.send(dict.fromkeys(env_indices, ("call", function, *arguments)))
        replies = self._receive(env_indices, attribute_errors=True)
        for i, reply in replies.items():
            if isinstance(reply, Restarted):
                self.close()
                raise WorkerError(f"the process of environment {i} was lost outside of a step: {reply.why}")
        return [replies[i] for i in env_indices]

    def _receive(self, indices: Any, attribute_errors: bool = False) -> dict[int, Any]:
        """Returns the replies of some processes; ends all processes if one of the replies is a failure."""
        replies = self.workers.answers(indices)
        for i, reply in replies.items():
            if isinstance(reply, WorkerFailure):
                if attribute_errors and reply.cause == "no attribute":
                    raise AttributeError(reply.message)
                self.close()
                if reply.cause == "bad answer":
                    raise BadEnvironmentError(with_location(type(self).__name__, i, self._n_steps, reply.message))
                raise WorkerError(f"environment {i} raised an error:\n{reply.trace}")
        return replies
