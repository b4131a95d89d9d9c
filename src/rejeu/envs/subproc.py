"""Vector environments with one process for each environment."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper, concatenate, create_empty_array

from rejeu.envs import workers
from rejeu.envs.vec_env import Indices, StepResult, VecEnv, is_wrapped
from rejeu.errors import WorkerError
from rejeu.video import rgb_frame

CLOSE_SECONDS = 5.0
"""How long a process has to end before it is ended."""


class SubprocVecEnv(VecEnv):
    """Environments that step at the same time, one process each; an ended one is reset within the step that ended it.

    It pays where a step takes longer than some tenths of a millisecond. The processes begin anew and import what they
    need, so a script that makes one must do so under ``if __name__ == "__main__":``.

    Args:
        env_fns: functions that each make a new environment, lambdas too.
        start_method: of ``multiprocessing``; None: ``"forkserver"`` on Linux, else ``"spawn"``. ``"fork"`` is
            unsafe once JAX has started.

    Raises:
        TypeError: if a function cannot be sent to another process.
        WorkerError: if an environment raises, with its traceback, or the script would be run again by the processes.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], start_method: str | None = None) -> None:
        if not env_fns:
            raise ValueError("env_fns is empty; give one function for each environment")
        for function in env_fns:
            workers.check_sendable(function)
        start_method = workers.START_METHOD if start_method is None else start_method
        if start_method != "fork" and workers.main_runs_again():
            raise WorkerError(
                "SubprocVecEnv's processes run the main script again from its beginning, so what makes it must stand under "
                "`if __name__ == '__main__':`"
            )
        context: Any = multiprocessing.get_context(start_method)
        if start_method == "forkserver":
            context.set_forkserver_preload([__name__])  # imports it once for all
        self.waiting = False
        self.closed = False
        self.remotes: list[Connection] = []
        self.processes: list[Any] = []
        for function in env_fns:
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, CloudpickleWrapper(function)), daemon=True)
            process.start()
            theirs.close()
            self.remotes.append(ours)
            self.processes.append(process)
        try:
            observation_space, action_space, metadata, render_mode = self._ask([0], "describe")[0]
        except BaseException:
            self.close()
            raise
        super().__init__(len(env_fns), observation_space, action_space)
        self.metadata, self.render_mode = metadata, render_mode

    def reset(self) -> Any:
        """Resets every environment, with the seeds and options set before, and returns the observations."""
        for i, remote in enumerate(self.remotes):
            _send(remote, ("reset", self._seeds[i], self._options[i]))
        answers = self._receive(range(self.num_envs))
        self.reset_infos = [info for _, info in answers]
        self._reset_seeds()
        self._reset_options()
        return self._stack([obs for obs, _ in answers])

    def step_async(self, actions: Any) -> None:
        """Begins a step with one action for each environment."""
        if len(actions) != self.num_envs:
            raise ValueError(f"step got {len(actions)} actions for {self.num_envs} environments")
        for remote, action in zip(self.remotes, actions, strict=True):
            _send(remote, ("step", action))
        self.waiting = True

    def step_wait(self) -> StepResult:
        """Waits for the step that :meth:`step_async` began and returns what :meth:`step` does."""
        answers = self._receive(range(self.num_envs))
        self.waiting = False
        obs, rewards, dones, infos, reset_infos = zip(*answers, strict=True)
        for i in np.flatnonzero(dones).tolist():
            self.reset_infos[i] = reset_infos[i]
        return self._stack(list(obs)), np.array(rewards, np.float32), np.array(dones, bool), list(infos)

    def close(self) -> None:
        """Ends the processes; a second call does nothing."""
        if self.closed:
            return
        self.closed = True
        for remote in self.remotes:
            _send(remote, ("close",))
        for process, remote in zip(self.processes, self.remotes, strict=True):
            process.join(CLOSE_SECONDS)
            if process.is_alive():
                process.terminate()
            remote.close()

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
        for i in indices:
            _send(self.remotes[i], request)
        return self._receive(indices)

    def _receive(self, indices: Sequence[int] | range) -> list[Any]:
        answers = [self._receive_from(i) for i in indices]  # all of them, or the next request would get the rest
        for i, answer in zip(indices, answers, strict=True):
            if isinstance(answer, _Failure):
                if answer.no_attribute:
                    raise AttributeError(answer.message)
                self.close()
                raise WorkerError(f"environment {i} raised an error:\n{answer.trace}")
        return answers

    def _receive_from(self, i: int) -> Any:
        try:
            return _received(self.remotes[i])
        except (EOFError, ConnectionResetError):
            self.close()
            code = self.processes[i].exitcode
            raise WorkerError(f"the process of environment {i} has ended (exit code {code})") from None

    def _stack(self, parts: list[Any]) -> Any:
        empty: Any = create_empty_array(self.observation_space, self.num_envs)
        return concatenate(self.observation_space, parts, empty)


class _Failure:
    """What went wrong in a worker."""

    def __init__(self, message: str, trace: str, no_attribute: bool) -> None:
        self.message, self.trace, self.no_attribute = message, trace, no_attribute


def _send(remote: Connection, what: Any) -> None:
    """Sends anything, lambdas and classes of a script too; what it said last can be read from a side that has gone."""
    with suppress(BrokenPipeError, ConnectionResetError):
        remote.send(CloudpickleWrapper(what))


def _received(remote: Connection) -> Any:
    return remote.recv().fn


def _work(remote: Connection, make: CloudpickleWrapper) -> None:
    """Serves one environment until it is told to close or the other side is gone."""
    env: gym.Env | None = None
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches all processes; the one that trains decides what it means
    try:
        env = make.fn()
        while (request := _received(remote))[0] != "close":
            try:
                answer = _answer(env, *request)
            except AttributeError as error:
                if request[0] not in ("get_attr", "set_attr", "env_method"):
                    raise
                answer = _Failure(str(error), traceback.format_exc(), True)
            _send(remote, answer)
    except (EOFError, ConnectionResetError):
        pass
    except Exception as error:  # whatever it is, the other side raises it
        _send(remote, _Failure(str(error), traceback.format_exc(), False))
    finally:
        if env is not None:
            env.close()
        remote.close()


def _answer(env: gym.Env, name: str, *arguments: Any) -> Any:
    """Returns what an environment says to one request."""
    if name == "step":
        return _step(env, arguments[0])
    if name == "reset":
        return env.reset(seed=arguments[0], options=arguments[1])
    if name == "describe":
        return env.observation_space, env.action_space, env.metadata, env.render_mode
    if name == "render":
        return env.render() if env.render_mode == "human" else rgb_frame(env)
    if name == "get_attr":
        return env.get_wrapper_attr(arguments[0])
    if name == "set_attr":
        return env.set_wrapper_attr(*arguments)
    if name == "env_method":
        method, args, kwargs = arguments
        return env.get_wrapper_attr(method)(*args, **kwargs)
    assert name == "is_wrapped", name
    return is_wrapped(env, arguments[0])


def _step(env: gym.Env, action: Any) -> tuple[Any, float, bool, dict[str, Any], dict[str, Any]]:
    """Steps an environment, resets it if the episode has ended, and returns also what the reset said."""
    obs, reward, terminated, truncated, info = env.step(action)
    info = {**info, "TimeLimit.truncated": bool(truncated and not terminated)}
    done = bool(terminated or truncated)
    reset_info: dict[str, Any] = {}
    if done:
        info["terminal_observation"] = obs
        obs, reset_info = env.reset()
    return obs, float(reward), done, info, reset_info
