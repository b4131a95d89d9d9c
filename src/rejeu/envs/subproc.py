"""Vector environments with one process for each environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from rejeu.envs.faults import blamed
from rejeu.envs.vec_env import Indices, StepResult, VecEnv
from rejeu.envs.workers.pool import RESTARTED, TIMEOUT, Restarted, Workers
from rejeu.envs.workers.process import Failure
from rejeu.errors import BadEnvironmentError, WorkerError


class SubprocVecEnv(VecEnv):
    """Environments that step at the same time, one process each; an ended one is reset within the step that ended it.

    It pays where a step takes longer than some tenths of a millisecond. The processes begin anew and import what they
    need, so a script that makes one must do so under ``if __name__ == "__main__":``.

    Args:
        env_fns: functions that each make a new environment, lambdas too.
        start_method: of ``multiprocessing``; None: ``"forkserver"`` on Linux, else ``"spawn"``. ``"fork"`` is
            unsafe once JAX has started.
        worker_timeout: seconds that the environments have for a step or a reset; None: for ever.
        restart_workers: how many processes that ended or gave no answer are started anew. The episode there is over,
            truncated with the reward 0, and its last observation is repeated as ``terminal_observation``.

    Raises:
        TypeError: if a function cannot be sent to another process.
        BadEnvironmentError: if an environment returns what nothing can be learnt from.
        WorkerError: if an environment raises, with its traceback, if a process ends or gives no answer, or if the script
            would be run again by the processes.
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
        """The observations last shown."""
        self.workers = Workers(env_fns, start_method, worker_timeout, restart_workers)
        first = self.workers.descriptions[0]
        super().__init__(len(env_fns), first.observation_space, first.action_space)
        self.metadata, self.render_mode = first.metadata, first.render_mode

    @property
    def closed(self) -> bool:
        """Whether the processes were ended."""
        return self.workers.closed

    @property
    def processes(self) -> list[Any]:
        """The processes, one for each environment."""
        return [worker.process for worker in self.workers.workers]

    def reset(self) -> Any:
        """Resets every environment, with the seeds and options set before, and returns the observations."""
        for i, (obs, info) in self._reset(range(self.num_envs)).items():
            self._last[i], self.reset_infos[i] = obs, info
        self._reset_seeds()
        self._reset_options()
        return self._stack(self._last)

    def _reset(self, numbers: Sequence[int]) -> dict[int, tuple[Any, dict[str, Any]]]:
        """Resets some environments, again where a process was lost at that; returns observations and infos."""
        done: dict[int, tuple[Any, dict[str, Any]]] = {}
        while len(done) < len(numbers):
            waiting = {i: ("reset", self._seeds[i], self._options[i]) for i in numbers if i not in done}
            self.workers.send(waiting)
            said = self._receive(waiting)
            done |= {i: answer for i, answer in said.items() if not isinstance(answer, Restarted)}
        return done

    def step_async(self, actions: Any) -> None:
        """Begins a step with one action for each environment."""
        if len(actions) != self.num_envs:
            raise ValueError(f"step got {len(actions)} actions for {self.num_envs} environments")
        self._n_steps += 1
        self.workers.send({i: ("step and reset", action) for i, action in enumerate(actions)})
        self.waiting = True

    def step_wait(self) -> StepResult:
        """Waits for the step that :meth:`step_async` began and returns what :meth:`step` does."""
        self.waiting = False
        answers = self._receive(range(self.num_envs))
        lost = {i: answer.why for i, answer in answers.items() if isinstance(answer, Restarted)}
        for i, (obs, reset_info) in self._reset([*lost]).items():
            info = {"TimeLimit.truncated": True, "terminal_observation": self._last[i], RESTARTED: lost[i]}
            answers[i] = obs, 0.0, True, info, reset_info
        obs, rewards, dones, infos, reset_infos = zip(*(answers[i] for i in range(self.num_envs)), strict=True)
        for i in np.flatnonzero(dones).tolist():
            self.reset_infos[i] = reset_infos[i]
        self._last = list(obs)
        return self._stack(self._last), np.array(rewards, np.float32), np.array(dones, bool), list(infos)

    def close(self) -> None:
        """Ends the processes; a second call does nothing."""
        self.workers.close()

    def get_images(self) -> list[np.ndarray]:
        """Returns the picture of each environment, ``uint8 (height, width, 3)``."""
        return self._ask(range(self.num_envs), "render")

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of each environment, found through its wrappers."""
        return self._ask(self._get_indices(indices), "get_attr", attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of each environment, where it exists, be that beneath wrappers."""
        self._ask(self._get_indices(indices), "set_attr", attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of each environment, found through its wrappers, and returns what each returned."""
        return self._ask(self._get_indices(indices), "env_method", method_name, method_args, method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Returns for each environment whether a wrapper of that class is around it."""
        return self._ask(self._get_indices(indices), "is_wrapped", wrapper_class)

    def _ask(self, indices: Sequence[int] | range, *request: Any) -> list[Any]:
        self.workers.send(dict.fromkeys(indices, request))
        answers = self._receive(indices)
        for i, answer in answers.items():
            if isinstance(answer, Restarted):
                self.close()
                raise WorkerError(f"the process of environment {i} was lost outside of a step: {answer.why}")
        return [answers[i] for i in indices]

    def _receive(self, indices: Any) -> dict[int, Any]:
        """Returns the answers to requests, none of which is a failure; after one, all processes are ended."""
        answers = self.workers.answers(indices)
        for i, answer in answers.items():
            if isinstance(answer, Failure):
                if answer.kind == "no attribute":
                    raise AttributeError(answer.message)
                self.close()
                if answer.kind == "bad answer":
                    raise BadEnvironmentError(blamed(type(self).__name__, i, self._n_steps, answer.message))
                raise WorkerError(f"environment {i} raised an error:\n{answer.trace}")
        return answers

    def _stack(self, parts: list[Any]) -> Any:
        empty: Any = create_empty_array(self.observation_space, self.num_envs)
        return concatenate(self.observation_space, parts, empty)
