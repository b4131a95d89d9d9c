"""Environments of tests that run in worker processes.

Every worker imports this module, so it imports neither JAX nor pytest.
"""

import multiprocessing
import os
import random
import signal
import sys
import threading
import time
from random import SystemRandom

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tests.environments import Counter

ACTIONS = {
    "discrete": spaces.Discrete(5),
    "shifted": spaces.Discrete(4, start=-2),
    "multi": spaces.MultiDiscrete([2, 3, 4]),
    "binary": spaces.MultiBinary(4),
}


class UnsendableError(Exception):
    """An exception that pickle can neither write nor read again."""

    def __init__(self, code, text):
        super().__init__(text)
        self.lock = threading.Lock()


class Faulty(Counter):
    """Fails in worker processes, in the way that ``fault`` says."""

    def __init__(self, fault):
        super().__init__((3,))
        self.fault = fault
        if fault == "make" and multiprocessing.parent_process() is not None:
            raise UnsendableError(1, "no such device")

    def reset(self, **kwargs):
        if self.fault == "reset":
            raise UnsendableError(1, "cannot begin")
        return super().reset(**kwargs)

    def step(self, action):
        if action[0] > 0.5:
            if self.fault == "exit":
                os._exit(3)
            raise UnsendableError(1, "the wheel came off")
        return super().step(action)


class Losable(Counter):
    """Crashes or hangs at the actions 1 and 2; at resets, while the file ``at_reset`` is there, which it removes."""

    def __init__(self, at_reset=None):
        super().__init__((9,))
        self.action_space = gym.spaces.Box(-2.0, 2.0, (1,))
        self.at_reset = at_reset

    def reset(self, **kwargs):
        if self.at_reset is not None and self.at_reset.exists():
            self.at_reset.unlink()
            os._exit(5)
        return super().reset(**kwargs)

    def step(self, action):
        if action[0] == 1:
            os.kill(os.getpid(), signal.SIGKILL) if hasattr(signal, "SIGKILL") else os._exit(9)
        if action[0] == 2:
            time.sleep(600)
        return super().step(action)


class Rare(Losable):
    """Crashes at one step in ten, whatever the action."""

    def step(self, action):
        return super().step(np.ones(1) if self.np_random.uniform() < 0.1 else np.zeros(1))


def sizes(space):
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    return [int(n) for n in space.nvec] if isinstance(space, spaces.MultiDiscrete) else [1] * space.n


class Rules(gym.Env):
    """Allows something else at every step, and refuses to take what it forbade; episodes of 1 to 6 steps.

    The observation is noise, so nothing but the mask says what is allowed. The mask is given by ``info`` or by method.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, kind="discrete", by="info", all_at_end=True):
        self.action_space = ACTIONS[kind]
        self.by, self.all_at_end = by, all_at_end
        self.taken, self.masks, self.seeds = 0, [], []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.time, self.length = 0, int(self.np_random.integers(1, 7))
        return self.see(), self.info()

    def step(self, action):
        assert self.allows(action), f"{action} is forbidden by {self.mask}"
        self.taken += 1
        self.time += 1
        over = self.time >= self.length
        reward = float(np.sum(action))
        obs = self.see()
        if over and not self.all_at_end:
            self.mask = np.zeros_like(self.mask)
        return obs, reward, over and self.taken % 2 == 0, over and self.taken % 2 == 1, self.info()

    def see(self):
        masks = []
        for n in sizes(self.action_space):
            mask = self.np_random.random(n) < 0.4
            if not isinstance(self.action_space, spaces.MultiBinary):
                mask[self.np_random.integers(n)] = True
            masks.append(mask)
        self.mask = np.concatenate(masks)
        self.masks.append(self.mask)
        return self.np_random.normal(size=2).astype(np.float32)

    def info(self):
        return {"action_mask": self.mask.astype(np.int8)} if self.by == "info" else {}

    def action_masks(self):
        if self.by == "info":
            raise AssertionError("the info says it already")
        return self.mask

    def allows(self, action):
        space = self.action_space
        assert space.contains(action) or space.contains(np.asarray(action, space.dtype)), action
        if isinstance(space, spaces.MultiBinary):
            return bool(np.all(self.mask | (np.asarray(action) == 0)))
        choices = np.atleast_1d(action) - (space.start if isinstance(space, spaces.Discrete) else 0)
        ends = np.cumsum([0, *sizes(space)])[:-1]
        return bool(self.mask[ends + choices].all())


class Silent(Rules):
    """Says nowhere what is allowed."""

    def __init__(self):
        super().__init__(by="nowhere")

    action_masks = property(lambda self: self.no_such_attribute)  # as where there is no method


class Leaving(gym.Env):
    """Allows both of two actions, at the second of which its process ends."""

    observation_space = spaces.Box(0.0, 9.0, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {"action_mask": [1, 1]}

    def step(self, action):
        if action == 1:
            os._exit(3)
        return np.ones(1, np.float32), 0.0, False, False, {"action_mask": [1, 1]}


class Paced(gym.Env):
    """Adds its actions up, in episodes of 2 to 6 steps, half of which succeed.

    Every step takes a time of its own, up to twice ``seconds``, which no seed determines. The state can be saved.
    """

    observation_space = spaces.Box(-99.0, 99.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, seconds=0.0):
        self.seconds = seconds

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.total, self.length = 0, float(self.np_random.uniform()), int(self.np_random.integers(2, 7))
        return self.see(), {}

    def step(self, action):
        time.sleep(2 * self.seconds * SystemRandom().random())
        self.time, self.total = self.time + 1, self.total + float(action[0])
        over, even = self.time >= self.length, self.length % 2 == 0
        return self.see(), -abs(self.total), over and even, over and not even, {"is_success": even} if over else {}

    def see(self):
        return np.array([self.time, self.total, self.length], np.float32)

    def get_state(self):
        return {
            "place": [self.time, self.total, self.length],
            "rng": None if self._np_random is None else self._np_random.bit_generator.state,
        }

    def set_state(self, state):
        self.time, self.total, self.length = state["place"]
        self.np_random.bit_generator.state = state["rng"]


class DrawsGlobally(gym.Env):
    """Draws from the global generators of NumPy and Python, when it is made, reset and stepped."""

    observation_space = spaces.Box(0.0, 1.0, (3,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self):
        self.made = np.random.random()  # noqa: NPY002

    def reset(self, *, seed=None, options=None):
        return self.see(), {}

    def step(self, action):
        return self.see(), 0.0, False, False, {}

    def see(self):
        return np.array([self.made, np.random.random(), random.random()])  # noqa: NPY002


def process_id(env):
    return os.getpid()


def imports_jax(env):
    return "jax" in sys.modules
