"""Between :class:`~rejeu.loops.run.Run` on the host and the arguments of a program on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu import spaces
from rejeu.core import PyTree
from rejeu.envs.base import success_by
from rejeu.envs.functional.vector import JaxVector
from rejeu.envs.masks import functional_vector
from rejeu.loops.device.turns import Log, Players
from rejeu.loops.run import Episode, Run


def vector_of(run: Run) -> JaxVector:
    """Returns the environments in JAX of a run."""
    vector = functional_vector(run.env)
    assert vector is not None
    return vector


def players_of(run: Run) -> Players:
    """Returns the environments of a run and their episodes, with an empty log of no size."""
    nothing = jnp.zeros((0, run.env.n_envs), jnp.float32)
    return Players(
        env=vector_of(run).state,
        obs=jax.tree.map(jnp.array, run.obs),
        ended=jnp.array(run.ended),
        value=jnp.array(run.episode_return, jnp.float32),
        length=jnp.array(run.episode_length, jnp.int32),
        running_return=jnp.array(run.running_return, jnp.float32),
        episode=jnp.uint32(run.episode),
        bad=jnp.bool(False),
        log=Log(nothing, nothing, nothing),
    )


def put_players(run: Run, players: Any) -> None:
    """Puts the environments and their episodes into a run, as the host's loops leave them.

    Args:
        run: mutated.
        players: :class:`Players` with arrays on the host, apart from the state of the environments.
    """
    vector_of(run).state = players.env
    run.obs = players.obs
    run.ended = players.ended
    run.episode_return = players.value.astype(np.float64)
    run.episode_length = players.length.astype(np.int64)
    run.running_return = players.running_return
    run.episode = int(players.episode)


def episodes_of(run: Run, log: Log, first_step: int, last_step: int) -> list[Episode]:
    """Returns the episodes that ended in a chunk, in the order in which they ended.

    Args:
        run: whose environments and success threshold count.
        log: on the host.
        first_step: total environment steps before the chunk.
        last_step: total environment steps after it.
    """
    threshold = run.env.reward_threshold if run.success_threshold is None else run.success_threshold
    episodes = []
    for turn, env in zip(*(found.tolist() for found in np.nonzero(log.length)), strict=True):
        value = float(log.value[turn, env])
        success = success_by(float(log.success[turn, env]), value, threshold)
        step = min(first_step + (turn + 1) * run.env.n_envs, last_step)
        episodes.append(Episode(step, env, value, int(log.length[turn, env]), success, run.seconds["total"]))
    return episodes


def host_obs(run: Run, obs: PyTree) -> PyTree:
    """Returns observations of the device as the environments of a run return them."""
    return spaces.cast(run.env.observation_space, spaces.leaves(run.env.observation_space), obs)


def stacked(trees: Sequence[PyTree]) -> PyTree:
    """Returns trees of equal structure as one on the device, whose leaves have a leading axis."""

    def joined(*leaves: Any) -> jax.Array:
        on_host = all(isinstance(leaf, np.ndarray) for leaf in leaves)
        return jnp.array(np.stack(leaves)) if on_host else jnp.stack(leaves)

    return jax.tree.map(joined, *trees)


def unstacked(tree: PyTree, n: int) -> list[PyTree]:
    """Returns the ``n`` trees of which :func:`stacked` made one; a single one has no leading axis."""
    return [tree] if n == 1 else [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(n)]


def rounded_up(n: int, most: int) -> int:
    """Returns one of few sizes that is at least ``n``, and at most ``most``, since each is compiled.

    >>> rounded_up(5, 10_000), rounded_up(70, 10_000), rounded_up(70, 100)
    (64, 512, 100)
    """
    size = 64
    while size < n:
        size *= 8
    return min(size, most)


def copies(tree: PyTree) -> PyTree:
    """Returns copies of arrays on the host."""
    return jax.tree.map(np.array, jax.device_get(tree))
