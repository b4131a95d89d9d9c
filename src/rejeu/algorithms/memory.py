"""Acting with networks that have a memory: what an algorithm without one becomes with them (:func:`acting_from_memory`)."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import Algorithm, Clock, Explorer, Masked, PyTree, Remembered, unmasked
from rejeu.networks import Recurrent


def acting_from_memory(algorithm: Algorithm, networks: Callable[[PyTree], tuple[Recurrent, ...]]) -> Algorithm:
    """Returns an algorithm that acts with the memory of its networks.

    The memory is one array ``(n_envs, n_numbers)``, of all networks with memory in the order of their slots, so that critics
    too start a sequence from what they remembered.

    Args:
        algorithm: how it acts and learns with the observations of :class:`rejeu.core.algorithm.Remembered`, and
            :class:`rejeu.core.algorithm.Sequences`.
        networks: returns the networks with memory of a state, the one that acts first.
    """

    def init(actor: tuple[Recurrent, ...], n_envs: int) -> Array:
        return jnp.zeros((n_envs, sum(network.n_numbers for network in actor)), jnp.float32)

    def remember(memory: Array, actor: tuple[Recurrent, ...], obs: PyTree, ended: Array) -> tuple[PyTree, Array]:
        """Returns the memory in place of observations, with their mask if they have one, and as the array to carry on."""
        obs, mask = unmasked(obs)
        memory = jnp.where(ended[:, None], 0.0, memory)
        memory = jnp.concatenate([network.after(memory, obs) for network in actor], axis=1)
        return Remembered(memory) if mask is None else Masked(Remembered(memory), mask), memory

    def act(
        memory: Array, actor: tuple[Recurrent, ...], obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, Array]:
        remembered, memory = remember(memory, actor, obs, ended)
        return algorithm.explore(actor[0], remembered, key, clock), memory

    def recall(memory: Array, actor: tuple[Recurrent, ...], obs: PyTree, ended: Array) -> tuple[Array, Array]:
        remembered, memory = remember(memory, actor, obs, ended)
        return algorithm.exploit(actor[0], remembered), memory

    return algorithm._replace(
        actor=networks,
        explore=lambda actor, obs, key, clock: algorithm.explore(actor[0], obs, key, clock),
        exploit=lambda actor, obs: algorithm.exploit(actor[0], obs),
        explorer=Explorer(init, act),
        recall=recall,
        action_values=None,
    )
