"""How training actions are chosen: the algorithm's own exploration, optionally with noise.

The state of noise is a small pytree per environment, the *carry*. It is kept beside the algorithm's state, reset at the
start of an episode, and saved with the run.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import Algorithm, Clock, Explorer, PyTree, renew
from rejeu.exploration import parameter_space
from rejeu.exploration.noise import Noise, NoiseProcess
from rejeu.exploration.parameter_space import ParameterNoise


class Noisy(NamedTuple):
    """The carry of exploration by noise with a policy that has a memory."""

    memory: PyTree
    noise: PyTree


def memory_in(carry: PyTree) -> PyTree:
    """Returns the memory of a policy that has one in the carry of its exploration."""
    return carry.memory if isinstance(carry, Noisy) else carry


def make(algorithm: Algorithm, noise: Noise | None) -> Explorer:
    """Returns how ``algorithm`` explores with ``noise`` (None: without noise).

    An algorithm with an explorer of its own handles noise itself, unless that is its memory.
    """
    if algorithm.explorer is not None and algorithm.recall is None:
        return algorithm.explorer
    if noise is None:
        return plain(algorithm)
    if isinstance(noise, ParameterNoise):
        return with_parameter_noise(algorithm, noise)
    return with_action_noise(algorithm, noise)


def plain(algorithm: Algorithm) -> Explorer:
    """Returns the algorithm's own exploration without noise; the carry is its memory, or empty."""
    if algorithm.recall is not None and algorithm.explorer is not None:
        return algorithm.explorer

    def act(carry: PyTree, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, PyTree]:
        return algorithm.explore(actor, obs, key, clock), carry

    return Explorer(lambda actor, n_envs: (), act)


def with_action_noise(algorithm: Algorithm, noise: NoiseProcess) -> Explorer:
    """Returns exploration by ``noise`` on actions in [-1, 1]; the carry is the noise's state, with memory :class:`Noisy`."""
    explorer, has_memory = plain(algorithm), algorithm.recall is not None

    def init(actor: PyTree, n_envs: int) -> PyTree:
        state = jax.tree.map(jnp.asarray, noise.init(n_envs))
        return Noisy(explorer.init(actor, n_envs), state) if has_memory else state

    def act(carry: PyTree, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, PyTree]:
        action_key, noise_key = jax.random.split(key)
        memory, state = carry if has_memory else ((), carry)
        state = renew(ended, noise.init(ended.shape[0]), state)
        action, memory = explorer.act(memory, actor, obs, ended, action_key, clock)
        state, action = noise.perturb(state, action, noise_key)
        return jnp.clip(action, -1.0, 1.0), Noisy(memory, state) if has_memory else state

    return Explorer(init, act)


def with_parameter_noise(algorithm: Algorithm, noise: ParameterNoise) -> Explorer:
    """Returns the algorithm's own exploration by actors with perturbed parameters, one per environment."""

    def act(carry: PyTree, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, PyTree]:
        return parameter_space.act(noise, algorithm, carry, actor, obs, ended, key, clock)

    return Explorer(lambda actor, n_envs: parameter_space.initial(noise, actor, n_envs), act)
