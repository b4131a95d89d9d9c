"""Environments on MuJoCo's engine in JAX (MJX), and an example: an inverted pendulum.

They need the packages ``mujoco`` and ``mujoco-mjx``, in equal versions: ``pip install "rejeu[mjx]"``. MJX is made for
thousands of environments on a GPU.
"""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.errors import requires
from rejeu.core.types import Observation, PyTree
from rejeu.envs.functional.protocol import FunctionalEnv, time_is_up

INVERTED_PENDULUM = Path(__file__).with_name("inverted_pendulum.xml").read_text(encoding="utf-8")
"""The model of :class:`InvertedPendulum`, in MuJoCo's XML."""


class State(NamedTuple):
    """The state of the simulation, and the number of steps of the episode."""

    qpos: Array
    """Positions of the joints, ``float (nq,)``."""
    qvel: Array
    """Velocities, ``float (nv,)``."""
    time: Array
    """``int32 ()``."""


class MjxEnv(FunctionalEnv):
    """An environment whose state is the positions and velocities of a MuJoCo model.

    Subclasses define :meth:`start`, :meth:`observe`, :meth:`judge` and the spaces. Warm starts of the constraint solver,
    activations of muscles and bodies moved by mocap are not kept between steps.
    """

    model: eqx.AbstractVar[Any]
    """The model, from :func:`load`."""
    n_frames: eqx.AbstractVar[int]
    """Steps of simulation in a step of the environment."""

    @abstractmethod
    def start(self, key: Array) -> tuple[Array, Array]:
        """Returns positions and velocities at the start of an episode."""

    @abstractmethod
    def observe(self, state: State) -> Observation:
        """Returns the observation of a state."""

    @abstractmethod
    def judge(self, state: State, action: Array) -> tuple[Array, Array]:
        """Returns reward and ``terminated`` of the step that led to a state."""

    def reset(self, key: Array) -> tuple[State, PyTree]:
        state = State(*self.start(key), jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, PyTree, Array, Array, Array]:
        mjx = import_mjx()
        data = mjx.make_data(self.model).replace(qpos=state.qpos, qvel=state.qvel, ctrl=action)
        data = jax.lax.fori_loop(0, self.n_frames, lambda _, data: mjx.step(self.model, data), data)
        after = State(data.qpos, data.qvel, state.time + 1)
        reward, terminated = self.judge(after, action)
        return after, self.observe(after), reward, terminated, time_is_up(after.time, self.max_episode_steps)


class InvertedPendulum(MjxEnv):
    """A pole on a cart must be balanced, as in Gymnasium's ``InvertedPendulum-v5`` with another model.

    The reward is 1 per step, and the episode terminates when the pole leans by more than 0.2 rad.
    """

    model: Any
    n_frames: int = eqx.field(static=True)
    max_episode_steps: int | None = eqx.field(static=True)

    def __init__(self, n_frames: int = 2, max_episode_steps: int | None = 1000) -> None:
        self.model = load(INVERTED_PENDULUM)
        self.n_frames = n_frames
        self.max_episode_steps = max_episode_steps

    observation_space = spaces.Box(-np.inf, np.inf, (4,))
    action_space = spaces.Box(-3.0, 3.0, (1,))

    def start(self, key: Array) -> tuple[Array, Array]:
        qpos, qvel = jax.random.uniform(key, (2, 2), minval=-0.01, maxval=0.01)
        return qpos, qvel

    def observe(self, state: State) -> Array:
        return jnp.concatenate([state.qpos, state.qvel])

    def judge(self, state: State, action: Array) -> tuple[Array, Array]:
        fallen = jnp.abs(state.qpos[1]) > 0.2
        return jnp.ones(()), fallen


def load(xml: str) -> Any:
    """Returns the model in a MuJoCo XML text for MJX.

    Raises:
        MissingExtra: if ``mujoco`` or ``mujoco-mjx`` is not installed.
    """
    mjx = import_mjx()
    import mujoco

    return mjx.put_model(mujoco.MjModel.from_xml_string(xml))


def import_mjx() -> Any:
    """Returns the module ``mujoco.mjx``.

    Raises:
        MissingExtra: if it is not installed.
    """
    with requires("environments on MJX", "mujoco-mjx", "mjx"):
        from mujoco import mjx
    return mjx
