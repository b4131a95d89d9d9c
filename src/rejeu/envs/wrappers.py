"""Wrappers for time limits, goals and old environments, and ``rejeu/CartPoleNoVelocity-v0``, which is partially observable."""

from __future__ import annotations

from functools import partial
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.wrappers import TransformObservation

from rejeu.core.spaces import check_goal_space, leaves
from rejeu.core.types import Action, Info, Observation
from rejeu.envs import snapshot
from rejeu.envs.goals import attribute


class TimeLimitTerminates(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Reports truncated episodes as terminated, so that agents do not bootstrap from the last observation.

    Some older exercises treat the time limit this way: the last transition has no next state. This is correct if the
    limit is part of the task and the observation contains the remaining time. Otherwise, the same observation has a low
    value at one time and a high value at another. Without this wrapper, agents bootstrap through time limits.

    >>> env = TimeLimitTerminates(gym.make("MountainCar-v0", max_episode_steps=2))
    >>> _ = env.reset(seed=0)
    >>> [env.step(0)[2:4] for _ in range(2)]
    [(False, False), (True, False)]
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        """Steps the environment, and reports truncation as termination."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or truncated, False, info


class FlatGoals(gym.ObservationWrapper, gym.utils.RecordConstructorArgs):
    """Makes goals that are nestings of Dict and Tuple one array, as hindsight replay needs them.

    The environment's ``compute_reward`` and ``compute_terminated`` receive goals as the environment returns them, or in
    place of each array one with a leading axis for a batch of goals. Choices of a Discrete or MultiDiscrete goal are one-hot
    encoded.

    Raises:
        ValueError: if it is not a goal environment.
        TypeError: if a part of the goals is not a fixed-size array.
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        space: Any = env.observation_space
        check_goal_space(space, nested=True)
        self._goal = space["achieved_goal"]
        leaves(self._goal)
        flat: Any = gym.spaces.flatten_space(self._goal)
        box = gym.spaces.Box(flat.low.astype(np.float32), flat.high.astype(np.float32))
        self.observation_space = gym.spaces.Dict({**space.spaces, "achieved_goal": box, "desired_goal": box})
        for name in ("compute_reward", "compute_terminated"):
            if attribute(env, name) is not None:
                setattr(self, name, partial(self._of_parts, name))

    def observation(self, observation: Observation) -> dict[str, Observation]:
        """Returns an observation with flat goals."""
        flat = {key: gym.spaces.flatten(self._goal, observation[key]) for key in ("achieved_goal", "desired_goal")}
        return {**observation, **{key: np.asarray(goal, np.float32) for key, goal in flat.items()}}

    def _of_parts(self, name: str, achieved: np.ndarray, desired: np.ndarray, info: object) -> Any:
        return self.env.get_wrapper_attr(name)(unflat(self._goal, achieved), unflat(self._goal, desired), info)


def unflat(space: gym.Space, flat: np.ndarray) -> Any:
    """Returns the elements of ``space`` whose flat arrays ``(..., n)`` are given, each leaf with the same leading axes.

    >>> space = gym.spaces.Dict(at=gym.spaces.Box(-1.0, 1.0, (2,)), open=gym.spaces.Discrete(2))
    >>> unflat(space, np.eye(2, 4, 2))["at"].shape
    (2, 2)
    """
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        spaces = [*space.spaces.values()] if isinstance(space, gym.spaces.Dict) else [*space.spaces]
        split = np.split(flat, np.cumsum([gym.spaces.flatdim(subspace) for subspace in spaces])[:-1], axis=-1)
        parts = [unflat(subspace, numbers) for subspace, numbers in zip(spaces, split, strict=True)]
        return dict(zip(space.spaces, parts, strict=True)) if isinstance(space, gym.spaces.Dict) else (*parts,)
    if isinstance(space, gym.spaces.Box):
        return flat.reshape(*flat.shape[:-1], *space.shape).astype(space.dtype)
    return np.apply_along_axis(lambda row: np.asarray(gym.spaces.unflatten(space, row)), -1, flat)


class OldEnvironment(gym.Env):
    """Makes an environment of Gymnasium from one written for the old package gym, or in its style.

    ``reset()`` of such an environment returns the observation, and ``step(action)`` ``(obs, reward, done, info)``. Its
    spaces may be of any class with ``low`` and ``high``, of ``shape`` if that is given, or with ``n``. An episode that is
    done counts as terminated, or as truncated if ``info["TimeLimit.truncated"]`` is true.

    Args:
        env: the old environment. If it has no ``seed`` method and draws from
            ``numpy.random``, its episodes are not repeatable.

    Raises:
        ValueError: if a space has neither bounds nor a number of choices.
    """

    def __init__(self, env: Any) -> None:
        self.old = env
        self.observation_space = to_space(env.observation_space)
        self.action_space = to_space(env.action_space)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Resets the environment, after its ``seed`` method was given the seed if it has one."""
        super().reset(seed=seed)
        if seed is not None and hasattr(self.old, "seed"):
            self.old.seed(seed)
        return self._converted(self.old.reset()), {}

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        """Steps the environment, and tells time limits from ends of the task."""
        obs, reward, done, info = self.old.step(action)
        cut = bool(done) and bool(info.get("TimeLimit.truncated", False))
        return self._converted(obs), reward, bool(done) and not cut, cut, info

    def render(self) -> Any:
        """Calls the environment's ``render``."""
        return self.old.render()

    def close(self) -> None:
        """Closes the environment if it can be closed."""
        getattr(self.old, "close", lambda: None)()

    def _converted(self, obs: Observation) -> Observation:
        return np.array(obs, np.float32) if self.observation_space.dtype == np.float32 else obs


def to_space(space: object) -> gym.Space:
    """Returns Gymnasium's space for one of another class: a Box for ``low`` and ``high``, Discrete for ``n``.

    Raises:
        ValueError: if it has neither.
    """
    if isinstance(space, gym.Space):
        return space
    if hasattr(space, "low") and hasattr(space, "high"):
        dtype = np.dtype(getattr(space, "dtype", None) or np.float32)
        dtype = np.dtype(np.int8) if dtype.kind == "b" else dtype
        shape = tuple(getattr(space, "shape", None) or np.shape(space.low))
        low, high = (np.broadcast_to(np.asarray(bound, dtype), shape) for bound in (space.low, space.high))
        return gym.spaces.Box(low, high, shape, dtype.type)
    if hasattr(space, "n"):
        return gym.spaces.Discrete(int(space.n))
    raise ValueError(
        f"expected a space with low and high, or with n, got {type(space).__name__}; give the environment spaces of "
        "gymnasium.spaces"
    )


def cart_pole_without_velocities(render_mode: str | None = None) -> gym.Env:
    """Returns Gymnasium's CartPole without velocities: only cart position and pole angle are observed.

    The optimal action depends on the velocities, so a policy needs memory. This is an early benchmark of recurrent
    policies (Wierstra et al. 2007, "Solving Deep Memory POMDPs with Recurrent Policy Gradients").

    >>> import rejeu
    >>> gym.make("rejeu/CartPoleNoVelocity-v0").observation_space.shape
    (2,)
    """
    env: gym.Env = CartPoleEnv(render_mode=render_mode)
    space = env.observation_space
    assert isinstance(space, gym.spaces.Box)
    shown = gym.spaces.Box(space.low[::2], space.high[::2], dtype=np.float32)
    return TransformObservation(env, lambda obs: obs[::2], shown)


snapshot.REMEMBERED |= {TimeLimitTerminates: {}, FlatGoals: {}}
