"""An environment in JAX as a Gymnasium environment, which can be drawn, recorded and played."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from rejeu.core.spaces import plain
from rejeu.core.types import Action, Info, JsonObject, Observation, PyTree
from rejeu.envs import functional
from rejeu.envs.canvas import Drawing, Scene
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import JaxVector


class GymnasiumEnv(gym.Env[Any, Any]):
    """A Gymnasium environment that steps an environment in JAX.

    A seed gives the episodes of ``rejeu.make_vector(env, 1, seed=seed)``. The info has ``is_success`` if the environment
    defines success, and ``action_mask`` if it has masks. Goal environments have ``compute_reward``, and
    ``compute_terminated`` if they define it.

    Args:
        env: the environment, or its id.
        render_mode: ``"rgb_array"`` or ``"human"``.
        drawing: a function that returns the :class:`Drawing`; given ``env`` and ``render_mode``. By default the
            registered one.
        env_kwargs: parameters of the environment, if ``env`` is an id.

    Raises:
        ValueError: if no environment has this id, for an unknown render mode, or one without a drawing.

    >>> from rejeu.envs.functional import make
    >>> env = GymnasiumEnv(make("jax/Pendulum-v1"))
    >>> obs, info = env.reset(seed=0)
    >>> obs.shape, info
    ((3,), {})
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    def __init__(
        self,
        env: FunctionalEnv | str,
        render_mode: str | None = None,
        drawing: functional.MakeDrawing | None = None,
        **env_kwargs: Any,
    ) -> None:
        if isinstance(env, str):
            spec = functional.REGISTRY.get(env)
            if spec is not None:
                drawing = functional.imported(spec.drawing) if drawing is None else drawing
                if spec.max_episode_steps:  # Gymnasium's wrapper applies it
                    env_kwargs["max_episode_steps"] = None
            env = functional.make(env, **env_kwargs)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode!r} must be None, 'human' or 'rgb_array'")
        if render_mode is not None and drawing is None:
            raise ValueError(f"{type(env).__name__} has no drawing; register it with one, or use render_mode=None")
        self.functional = env
        self.render_mode = render_mode
        self.observation_space, self.action_space = deepcopy((env.observation_space, env.action_space))
        self.over = True
        """Whether the episode has ended, or none has begun."""
        self._vector = JaxVector(env)
        self._make_drawing = drawing
        self._drawing: Drawing | None = None
        self._scene = Scene([], None, True)
        goals = self._vector.goals()
        if goals is not None:
            reward, judge = goals
            self.compute_reward = lambda achieved_goal, desired_goal, info: reward(achieved_goal, desired_goal)
            if judge is not None:
                self.compute_terminated = lambda achieved_goal, desired_goal, info: judge(achieved_goal, desired_goal)

    @property
    def max_episode_steps(self) -> int | None:
        """The time limit of the environment itself, None if it has none."""
        return self.functional.max_episode_steps

    @property
    def goal_camera(self) -> np.ndarray | None:
        """How goals are projected into the picture that was drawn last; None if that is unknown."""
        return None if self._drawing is None else self._drawing.camera

    @property
    def state(self) -> PyTree:
        """The state of the environment, None before the first reset."""
        return self._vector.state_of(0)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Starts an episode."""
        super().reset(seed=seed)
        obs = self._vector.reset(seed)
        self.over = False
        self._scene = Scene([], None, False)
        self._show(None)
        return _first(self.observation_space, obs), self._info()

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, Info]:
        """Steps the environment.

        Raises:
            gymnasium.error.ResetNeeded: if no episode has begun.
        """
        step = self._vector.step(jax.tree.map(lambda array: np.asarray(array)[None], action))
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self.over = terminated or truncated
        self._show(action)
        return _first(self.observation_space, step.obs), float(step.reward[0]), terminated, truncated, self._info()

    def render(self) -> np.ndarray | None:
        """Returns an image, ``uint8 (height, width, 3)``, or None if it is shown in a window.

        Raises:
            ValueError: if the environment was made without a render mode.
            MissingExtra: if a package for drawing is not installed.
        """
        if self.render_mode is None or self._make_drawing is None:
            raise ValueError("nothing is drawn without a render mode: gymnasium.make(..., render_mode='rgb_array')")
        if self._drawing is None:
            self._drawing = self._make_drawing(self.functional, self.render_mode)
            self.metadata = {**self.metadata, "render_fps": self._drawing.fps}
        return self._drawing.draw(self._scene)

    def close(self) -> None:
        """Closes the window if there is one."""
        if self._drawing is not None:
            self._drawing.close()
            self._drawing = None

    @property
    def needs_reset(self) -> bool:
        """Whether the environment must be reset before the next step."""
        return self.over

    def get_state(self) -> JsonObject:
        """Returns the state, including the random numbers, as arrays, for :meth:`set_state`."""
        return {"arrays": self._vector.snapshot(), "over": self.over, "rng": self.np_random.bit_generator.state}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restores a state of :meth:`get_state`.

        Raises:
            ValueError: if it is of another environment.
        """
        if state["arrays"] is not None:
            self._vector.restore(state["arrays"], None)
        self.np_random.bit_generator.state = state["rng"]
        self.over = bool(state["over"])
        self._scene = Scene([], None, self.over)
        if self.render_mode is not None and state["arrays"] is not None:
            self._scene.states.append(self.state)

    def _info(self) -> Info:
        success, mask = self.functional.success(self.state), self.functional.action_mask(self.state)
        info = {} if success is None else {"is_success": bool(success)}
        return info if mask is None else {**info, "action_mask": np.asarray(mask, np.int8)}

    def _show(self, action: Action) -> None:
        """Adds the state to the scene, and draws it in the window if there is one."""
        if self.render_mode is None:
            return
        self._scene = Scene([*self._scene.states, self.state], action, self.over)
        if self.render_mode == "human":
            self.render()


def _first(space: gym.Space, obs: Observation) -> Any:
    """Returns the observation of the only environment of a vector, with the declared dtypes, which JAX may not have."""
    return jax.tree.map(lambda batch, declared: np.array(batch[0], declared.dtype), obs, plain(space, space))
