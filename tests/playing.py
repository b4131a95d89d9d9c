"""Environments, an agent and scripted key presses for tests of the interactive player."""

import gymnasium as gym
import numpy as np
import pytest

from rejeu.teaching import play as play_package
from rejeu.teaching.play.window import Window
from tests.environments import Timed

pygame = pytest.importorskip("pygame")


class Lever(Timed):
    """Episodes of 5 steps. The reward is the action; a return of 5 is a success. The frame of step t is gray 40 t."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    observation_space = gym.spaces.Box(0, 255, (40, 40, 3), np.uint8)
    action_space = gym.spaces.Discrete(3)
    length, ends = 5, "terminated"

    def __init__(self, render_mode=None):
        self.render_mode, self.actions, self.seeds = render_mode, [], []

    def begin(self, seed):
        self.seeds.append(seed)

    def reward(self, action):
        self.actions.append(int(action))
        return float(action)

    def observe(self):
        return self.np_random.integers(0, 256, (40, 40, 3), np.uint8)

    def info(self):
        return {"is_success": sum(self.actions[-5:]) >= 5} if self.time == 5 else {}

    def render(self):
        return np.full((300, 400, 3), 40 * self.time, np.uint8)


class Dark(Lever):
    metadata = {"render_modes": ["ansi"]}


class Switches(Lever):
    action_space = gym.spaces.MultiBinary(3)


class Steps(Lever):
    action_space = gym.spaces.Discrete(4)


for env_class in (Lever, Dark, Switches, Steps):
    gym.register(f"rejeu-play-test/{env_class.__name__}-v0", f"{__name__}:{env_class.__name__}")
gym.register("rejeu-play-test/Class-v0", Lever)
LEVER = "rejeu-play-test/Lever-v0"


def perform(script, run, *arguments, **settings):
    """Runs a function that opens a window. A script advances before each turn, and the window closes when it ends."""
    scripts, real = [], play_package.turn

    def turn(window, game):
        scripts.append(scripts[0] if scripts else script(window, game))
        if next(scripts[0], "end") == "end":
            pygame.event.post(pygame.event.Event(pygame.QUIT))
        real(window, game)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play_package, "turn", turn)
        patch.setattr(Window, "wait", lambda self, fps: None)
        return run(*arguments, **settings)


def down(*names):
    for name in names:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(name)))


def up(*names):
    for name in names:
        pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.key.key_code(name)))


def tap(*names):
    down(*names)
    up(*names)


def lever(game):
    return game.players[0].env.unwrapped


def hold(names, steps, read, readings):
    """Returns a script that holds some keys for some steps and then appends ``read(env)`` to ``found``."""

    def script(window, game):
        down(*(names or ["p"]))
        for _ in range(steps):
            yield
        readings.append(read(game.players[0].env.unwrapped))

    return script


class Pull:
    """An agent that always selects action 2."""

    def predict(self, obs, state=None, episode_start=None, deterministic=False):
        assert deterministic
        return np.int64(2), None
