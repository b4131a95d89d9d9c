"""Wrappers for Atari games (Mnih et al. 2015; Machado et al. 2018, arXiv 1709.06009). Images need OpenCV."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.core.errors import requires
from rejeu.core.types import Action, Info, Observation


class StickyActionEnv(gym.Wrapper):
    """Repeats the previous action with a probability; the first action of an episode is never replaced."""

    def __init__(self, env: gym.Env, action_repeat_probability: float) -> None:
        super().__init__(env)
        self.action_repeat_probability = action_repeat_probability
        self._sticky_action: Any = 0

    def reset(self, **kwargs: Any) -> Observation:
        self._sticky_action = 0
        return self.env.reset(**kwargs)

    def step(self, action: Action) -> Any:
        if self.np_random.random() >= self.action_repeat_probability:
            self._sticky_action = action
        return self.env.step(self._sticky_action)


def after(env: gym.Env, action: int, **kwargs: Any) -> tuple[Observation, Info]:
    """Returns observation and info of a step before an episode begins, or of another reset if the step has ended it."""
    obs, _, terminated, truncated, info = env.step(action)
    return env.reset(**kwargs) if terminated or truncated else (obs, info)


class NoopResetEnv(gym.Wrapper):
    """Begins episodes with 1 to ``noop_max`` steps of the action 0, which must do nothing."""

    def __init__(self, env: gym.Env, noop_max: int = 30) -> None:
        super().__init__(env)
        self.noop_max = noop_max
        self.override_num_noops: int | None = None

    def reset(self, **kwargs: Any) -> Observation:
        begun = self.env.reset(**kwargs)
        n = self.override_num_noops or int(self.unwrapped.np_random.integers(1, self.noop_max + 1))
        for _ in range(n):
            begun = after(self.env, 0, **kwargs)
        return begun


class FireResetEnv(gym.Wrapper):
    """Begins episodes with the actions 1 (FIRE) and 2, in games that start only then."""

    def reset(self, **kwargs: Any) -> Observation:
        self.env.reset(**kwargs)
        after(self.env, 1, **kwargs)
        return after(self.env, 2, **kwargs)


class EpisodicLifeEnv(gym.Wrapper):
    """Ends an episode with each lost life; the game is only reset when it is over."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.lives, self.was_real_done = 0, True

    def step(self, action: Action) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.was_real_done = terminated or truncated
        lives = self._lives()
        terminated = terminated or 0 < lives < self.lives
        self.lives = lives
        return obs, reward, terminated, truncated, info

    def reset(self, **kwargs: Any) -> Observation:
        begun = self.env.reset(**kwargs) if self.was_real_done else after(self.env, 0, **kwargs)  # or the life after
        self.lives = self._lives()
        return begun

    def _lives(self) -> int:
        game: Any = self.env.unwrapped
        return game.ale.lives()


class MaxAndSkipEnv(gym.Wrapper):
    """Repeats each action ``skip`` times, sums the rewards and shows the maximum of the last two frames."""

    def __init__(self, env: gym.Env, skip: int = 4) -> None:
        super().__init__(env)
        self._skip = skip

    def step(self, action: Action) -> Any:
        total, frames = 0.0, []
        for _ in range(self._skip):
            obs, reward, terminated, truncated, info = self.env.step(action)
            frames.append(obs)
            total += float(reward)
            if terminated or truncated:
                break
        return np.max(frames[-2:], axis=0), total, terminated, truncated, info


class ClipRewardEnv(gym.RewardWrapper):
    """Replaces rewards by their sign."""

    def reward(self, reward: SupportsFloat) -> float:
        return float(np.sign(float(reward)))


class WarpFrame(gym.ObservationWrapper):
    """Shows images in gray, ``uint8 (height, width, 1)``.

    Raises:
        MissingExtra: if OpenCV is not installed.
    """

    def __init__(self, env: gym.Env, width: int = 84, height: int = 84) -> None:
        super().__init__(env)
        with requires("WarpFrame", "opencv-python-headless"):
            import cv2
        self._cv2 = cv2
        self.width, self.height = width, height
        self.observation_space = spaces.Box(0, 255, (height, width, 1), np.uint8)

    def observation(self, frame: np.ndarray) -> np.ndarray:
        gray = self._cv2.cvtColor(frame, self._cv2.COLOR_RGB2GRAY)
        return self._cv2.resize(gray, (self.width, self.height), interpolation=self._cv2.INTER_AREA)[:, :, None]


class AtariWrapper(gym.Wrapper):
    """All of the above, in the usual order.

    Args:
        env: an Atari game, ``NoFrameskip``.
        noop_max: most steps without action at the start; 0 for none.
        frame_skip: steps for which an action is repeated, at least 1.
        screen_size: side of the images in pixels.
        terminal_on_life_loss: end episodes with a lost life.
        clip_reward: replace rewards by their sign.
        action_repeat_probability: of repeating the previous action.
    """

    def __init__(
        self,
        env: gym.Env,
        noop_max: int = 30,
        frame_skip: int = 4,
        screen_size: int = 84,
        terminal_on_life_loss: bool = True,
        clip_reward: bool = True,
        action_repeat_probability: float = 0.0,
    ) -> None:
        game: Any = env.unwrapped
        if action_repeat_probability > 0.0:
            env = StickyActionEnv(env, action_repeat_probability)
        if noop_max > 0:
            env = NoopResetEnv(env, noop_max)
        if frame_skip > 1:
            env = MaxAndSkipEnv(env, frame_skip)
        if terminal_on_life_loss:
            env = EpisodicLifeEnv(env)
        if "FIRE" in game.get_action_meanings():
            env = FireResetEnv(env)
        env = WarpFrame(env, screen_size, screen_size)
        super().__init__(ClipRewardEnv(env) if clip_reward else env)
