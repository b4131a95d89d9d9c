"""Valid and invalid environments for ``trials/environments.py``, each with the expected outcome of training.

They include the environments of ``tests/bad_environments.py``, each of which has one fault. This module adds all kinds
of spaces, spaces in which nothing can be learned, different lengths and ends of episodes, and environments that raise,
exit, hang or end their process.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tests.bad_environments import EVERY, Good, Line

TRAINS, ENDS, RAISES, REFUSED = "trains", "ends with our error", "ends with its own error", "refused"


class Kind(NamedTuple):
    """One kind of environment."""

    make: Callable[[], gym.Env]
    must: str
    """Expected outcome of training, one of the four above."""
    error: str = ""
    """Name of the exception that the environment raises."""
    sac: str = ""
    """Expected outcome of training with SAC, if it is different."""


class Spaces(Good):
    """Samples observations from any space and accepts any action space. Episodes have ten steps."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space | None = None) -> None:
        self.observation_space = observation_space
        self.action_space = Good.action_space if action_space is None else action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        gym.Env.reset(self, seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.time = 0
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict]:
        if not self.action_space.contains(action):
            raise AssertionError(f"{action!r} is not in {self.action_space}")
        self.time += 1
        return self.observe(), 1.0, False, self.time == 10, {}

    def observe(self) -> Any:
        return self.observation_space.sample()


class Course(Good):
    """Ends episodes by ``ends(time)``, which returns ``(terminated, truncated)``."""

    def __init__(self, ends: Callable[[int], tuple[Any, Any]]) -> None:
        self.ends = ends

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict]:
        obs, reward, _, _, info = super().step(action)
        return obs, reward, *self.ends(self.time), info


class Rewards(Good):
    """Rewards of any type or size."""

    def __init__(self, reward: Callable[[int], Any]) -> None:
        self.reward = reward

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict]:
        obs, _, *rest = super().step(action)
        return obs, self.reward(self.time), *rest


class Acts(Good):
    """Calls a function at the third step of its fifth episode, or where ``where`` specifies."""

    def __init__(self, act: Callable[[], Any], where: str = "step") -> None:
        self.act, self.where, self.episode = act, where, 0
        if where == "make":
            act()

    def reset(self, **kwargs: Any) -> tuple[Any, dict]:
        self.episode += 1
        if self.where == "reset" and self.episode == 5:
            self.act()
        return super().reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict]:
        if self.where == "step" and self.episode == 5 and self.late:
            self.act()
        return super().step(action)

    def close(self) -> None:
        if self.where == "close":
            self.act()


class Spoils(Good):
    """Modifies the action array that it receives."""

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict]:
        answer = super().step(action)
        action[...] = np.nan
        return answer


class Infinite(Good):
    """Returns an observation that is not finite."""

    def observe(self) -> Any:
        return np.array([0.0, np.inf if self.late else 0.0, 0.0], np.float32)


class Far(Good):
    """Returns observations a million times larger than declared."""

    def observe(self) -> Any:
        return 1e6 * super().observe()


class Vast(Good):
    """Returns observations whose squares overflow float32: SAC's losses are not finite, and PPO's tanh saturates."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def observe(self) -> Any:
        return 1e30 * super().observe()


class ListInfo(Good):
    """Returns a list as info."""

    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], ["no dict"] if self.late else {}


class ResetWithoutInfo(Good):
    """Returns None as the info of ``reset``."""

    def reset(self, **kwargs: Any) -> Any:
        return super().reset(**kwargs)[0], None


class ThreeFromReset(Good):
    """Returns three values from ``reset``."""

    def reset(self, **kwargs: Any) -> Any:
        return *super().reset(**kwargs), {}


class NothingFromStep(Good):
    """Returns None from ``step``."""

    def step(self, action: Any) -> Any:
        answer = super().step(action)
        return None if self.late else answer


def raising(error: BaseException) -> Callable[[], Any]:
    def act() -> Any:
        raise error

    return act


def hanging() -> None:
    time.sleep(3600)


def box(shape: tuple[int, ...], low: Any = -1.0, high: Any = 1.0, dtype: Any = np.float32) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype)


SIGHT = box((3,))
IMAGE = box((36, 36, 3), 0, 255, np.uint8)

OBSERVATIONS: dict[str, tuple[spaces.Space, str]] = {
    "a number": (box(()), TRAINS),
    "two axes": (box((2, 3)), TRAINS),
    "unbounded": (box((3,), -np.inf, np.inf), TRAINS),
    "float64": (box((3,), dtype=np.float64), TRAINS),
    "float16": (box((3,), dtype=np.float16), TRAINS),
    "whole numbers": (box((3,), -5, 5, np.int64), TRAINS),
    "bytes": (box((4,), 0, 255, np.uint8), TRAINS),
    "an image": (IMAGE, TRAINS),
    "an image, channels first": (box((1, 36, 36), 0, 255, np.uint8), TRAINS),
    "a tiny image": (box((4, 4, 1), 0, 255, np.uint8), TRAINS),
    "a stack of images": (box((2, 12, 12, 1), 0, 255, np.uint8), TRAINS),
    "one of several": (spaces.Discrete(5), TRAINS),
    "one of several from -2": (spaces.Discrete(5, start=-2), TRAINS),
    "choices": (spaces.MultiDiscrete([2, 3]), TRAINS),
    "bits": (spaces.MultiBinary(3), TRAINS),
    "a dict": (spaces.Dict(b=SIGHT, a=spaces.Discrete(3)), TRAINS),
    "a dict in a dict": (spaces.Dict(a=spaces.Dict(b=SIGHT, c=spaces.MultiBinary(2)), d=SIGHT), TRAINS),
    "a tuple": (spaces.Tuple([SIGHT, spaces.Discrete(2)]), TRAINS),
    "a dict with an image": (spaces.Dict(camera=box((12, 12, 1), 0, 255, np.uint8), pose=SIGHT), TRAINS),
    "text": (spaces.Text(5), REFUSED),
    "a sequence": (spaces.Sequence(SIGHT), REFUSED),
    "a graph": (spaces.Graph(SIGHT, None), REFUSED),
    "an empty dict": (spaces.Dict(), REFUSED),
}
"""Observation spaces and their expected outcomes."""
ACTIONS: dict[str, tuple[spaces.Space, str]] = {
    "asymmetric bounds": (spaces.Box(np.float32([-3, 1]), np.float32([-1, 7]), dtype=np.float32), TRAINS),
    "two axes": (box((2, 2)), TRAINS),
    "float64": (box((2,), dtype=np.float64), TRAINS),
    "one of several": (spaces.Discrete(3), TRAINS),
    "one of several from -2": (spaces.Discrete(3, start=-2), TRAINS),
    "one of one": (spaces.Discrete(1), TRAINS),
    "choices": (spaces.MultiDiscrete([2, 3]), TRAINS),
    "bits": (spaces.MultiBinary(3), TRAINS),
    "unbounded": (box((2,), -np.inf, np.inf), TRAINS),
    "no dimension": (box((0,)), REFUSED),
    "whole numbers": (box((2,), -2, 2, np.int64), REFUSED),
    "a dict": (spaces.Dict(a=SIGHT), REFUSED),
    "a tuple": (spaces.Tuple([SIGHT]), REFUSED),
}
"""Action spaces and their expected outcomes."""
WITH_SAC = {"action: unbounded": REFUSED, "action: whole numbers": TRAINS}
"""Expected outcomes of spaces for which SAC and PPO differ."""

NEVER = (False, False)
COURSES: dict[str, Callable[[], gym.Env]] = {
    "episodes of one step": lambda: Course(lambda t: (True, False)),
    "terminated and truncated at once": lambda: Course(lambda t: (t == 7, t == 7)),
    "terminated and truncated in turn": lambda: Course(lambda t: (t % 8 == 4, t % 8 == 0)),
    "flags of NumPy": lambda: Course(lambda t: (np.bool_(t == 7), np.False_)),
    "never ends": lambda: Course(lambda t: NEVER),
    "a time limit around it": lambda: gym.wrappers.TimeLimit(Course(lambda t: NEVER), 6),
    "rewards of type int": lambda: Rewards(lambda t: t),
    "rewards of NumPy": lambda: Rewards(np.float64),
    "constant rewards of 0": lambda: Rewards(lambda t: 0),
    "writes into the action": Spoils,
    "observations far out of bounds": Far,
    "a large info": lambda: gym.wrappers.RecordEpisodeStatistics(Good()),
    "warns at every step": lambda: Acts(lambda: warnings.warn("as always", UserWarning, stacklevel=1)),
    "prints": lambda: Acts(lambda: print("as always", file=sys.stderr)),
    "draws from NumPy's global generator": lambda: Acts(lambda: np.random.rand()),  # noqa: NPY002
    "raises in close": lambda: Acts(raising(OSError("the door is stuck")), "close"),
    "a goal": Line,
    "good": Good,
}
"""Valid lengths and ends of episodes."""


def kinds() -> dict[str, Kind]:
    """Returns all environments that run in this process, by name."""
    found: dict[str, Kind] = {}
    for name, (space, must) in OBSERVATIONS.items():
        found[f"observation: {name}"] = Kind(lambda space=space: Spaces(space), must)
    for name, (space, must) in ACTIONS.items():
        found[f"action: {name}"] = Kind(lambda space=space: Spaces(SIGHT, space), must)
    for name, make in COURSES.items():
        found[name] = Kind(make, TRAINS)
    for name, fault in EVERY.items():
        found[f"fault: {name}"] = Kind(fault.make, TRAINS if fault.trained is None else ENDS)
    for name, kind in (
        ("infinite observation", Infinite),
        ("info is a list", ListInfo),
        ("reset gives no info", ResetWithoutInfo),
        ("reset gives three values", ThreeFromReset),
        ("step gives nothing", NothingFromStep),
    ):
        found[f"fault: {name}"] = Kind(kind, ENDS)
    for where in ("step", "reset"):
        found[f"raises in {where}"] = Kind(
            lambda where=where: Acts(raising(OSError("no signal")), where), RAISES, "OSError"
        )
    found["sys.exit in step"] = Kind(lambda: Acts(lambda: sys.exit(3)), RAISES, "SystemExit")
    found["KeyboardInterrupt in step"] = Kind(lambda: Acts(raising(KeyboardInterrupt())), RAISES, "KeyboardInterrupt")
    found["raises where it is made"] = Kind(lambda: Acts(raising(OSError("no device")), "make"), RAISES, "OSError")
    found["observations of 1e30"] = Kind(Vast, TRAINS, "NonFiniteError", sac=RAISES)
    found["rewards of 1e30"] = Kind(lambda: Rewards(lambda t: 1e30), RAISES, "NonFiniteError")
    for name, must in WITH_SAC.items():
        found[name] = found[name]._replace(sac=must)
    return found


def raises_in_worker() -> gym.Env:
    return Acts(raising(OSError("no signal")))


def raises_in_reset() -> gym.Env:
    return Acts(raising(OSError("no signal")), "reset")


def exits() -> gym.Env:
    return Acts(lambda: sys.exit(3))


def exits_at_once() -> gym.Env:
    return Acts(lambda: os._exit(3))


def killed() -> gym.Env:
    return Acts(lambda: os.kill(os.getpid(), signal.SIGKILL))


def crashes() -> gym.Env:
    return Acts(lambda: os.kill(os.getpid(), signal.SIGSEGV))


def hangs() -> gym.Env:
    return Acts(hanging)


WORKERS: dict[str, tuple[Callable[[], gym.Env], str]] = {
    "good": (Good, TRAINS),
    "raises in step": (raises_in_worker, ENDS),
    "raises in reset": (raises_in_reset, ENDS),
    "sys.exit in step": (exits, ENDS),
    "os._exit in step": (exits_at_once, ENDS),
    "killed (SIGKILL)": (killed, ENDS),
    "crashes (SIGSEGV)": (crashes, ENDS),
    "hangs": (hangs, ENDS),
    "NaN observation": (EVERY["nan seen"].make, ENDS),
    "four values": (EVERY["four values"].make, ENDS),
    "only observation from reset": (EVERY["only observation"].make, ENDS),
}
"""Environments that run in worker processes. The functions can be sent to other processes."""
