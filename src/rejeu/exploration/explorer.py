"""How training actions are chosen: the algorithm's own exploration, optionally with noise.

The state of noise is a small pytree per environment, the *carry*. It is kept beside the algorithm's state, reset at the
start of an episode, and saved with the run.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import Algorithm, Clock, Explorer, PyTree
from rejeu.exploration import parameter_space
from rejeu.exploration.noise import Noise, NoiseProcess
from rejeu.exploration.parameter_space import ParameterNoise


def make(algorithm: Algorithm, noise: Noise | None) -> Explorer:
    """Returns how ``algorithm`` explores with ``noise`` (None: without noise).

    An algorithm with an explorer of its own handles noise itself.
    """
    if algorithm.explorer is not None:
        return algorithm.explorer
    if noise is None:
        return plain(algorithm)
    if isinstance(noise, ParameterNoise):
        return with_parameter_noise(algorithm, noise)
    return with_action_noise(algorithm, noise)


def plain(algorithm: Algorithm) -> Explorer:
    """Returns the algorithm's own exploration; the carry is empty."""

    def act(carry: PyTree, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, PyTree]:
        return algorithm.explore(actor, obs, key, clock), carry

    return Explorer(lambda actor, n_envs: (), act)


def with_action_noise(algorithm: Algorithm, noise: NoiseProcess) -> Explorer:
    """Returns exploration by ``noise`` on actions in [-1, 1]; the carry is the noise's state."""

    def act(carry: PyTree, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, PyTree]:
        action_key, noise_key = jax.random.split(key)
        carry = renew(ended, noise.init(ended.shape[0]), carry)
        carry, action = noise.perturb(carry, algorithm.explore(actor, obs, action_key, clock), noise_key)
        return jnp.clip(action, -1.0, 1.0), carry

    return Explorer(lambda actor, n_envs: jax.tree.map(jnp.asarray, noise.init(n_envs)), act)


def with_parameter_noise(algorithm: Algorithm, noise: ParameterNoise) -> Explorer:
    """Returns the algorithm's own exploration by actors with perturbed parameters, one per environment."""

    def act(carry: PyTree, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, PyTree]:
        return parameter_space.act(noise, algorithm, carry, actor, obs, ended, key, clock)

    return Explorer(lambda actor, n_envs: parameter_space.initial(noise, actor, n_envs), act)


def renew(ended: Array, fresh: PyTree, carry: PyTree) -> PyTree:
    """Returns ``carry`` with the environments where ``ended`` taken from ``fresh``."""
    return jax.tree.map(lambda f, c: jnp.where(ended.reshape(-1, *[1] * (c.ndim - 1)), f, c), fresh, carry)
