"""Full replay buffers of rejeu and Stable-Baselines3, filled directly instead of by an agent, which would take hours.

They contain episodes of 100 steps with the spaces of highway-env's parking-v0 or of Pendulum-v1. Every byte is written,
so that the operating system allocates all memory pages.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

EPISODE = 100
ACTION = {"parking": 2, "pendulum": 1}


def observation_space(task: str) -> spaces.Space:
    """Returns observations of ``"pendulum"`` or of ``"parking"`` (three vectors of six float64, as in highway-env)."""
    if task == "pendulum":
        return spaces.Box(-8.0, 8.0, (3,), np.float32)
    box = spaces.Box(-np.inf, np.inf, (6,), np.float64)
    return spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})


def action_space(task: str) -> spaces.Box:
    """Returns actions of ``"pendulum"`` or ``"parking"``."""
    return spaces.Box(-1.0, 1.0, (ACTION[task],), np.float32)


def necessary_bytes(task: str) -> int:
    """Returns the minimum size of a transition in bytes: one observation, the action, the reward and a done flag.

    Numbers have four bytes and the flag has one: ``4 * (observation + action + 1) + 1``. The next observation is stored
    with the next transition.
    """
    observation = {"parking": 18, "pendulum": 3}[task]
    return 4 * (observation + ACTION[task] + 1) + 1


def rejeu_ring(task: str, rows: int) -> Any:
    """Returns a full replay buffer of rejeu with this many rows. Every 101st row is the last observation of an episode.

    The buffer of parking includes the data for the hindsight strategy ``future``.
    """
    from rejeu.core import spaces as rejeu_spaces
    from rejeu.replay.hindsight import HindsightConfig, counters
    from rejeu.replay.ring import LAST, STEP, Ring

    space = observation_space(task)
    hindsight_counters = counters(HindsightConfig() if task == "parking" else None)
    ring = Ring(
        rows,
        1,
        rejeu_spaces.leaves(space),
        rejeu_spaces.structure(space),
        (ACTION[task],),
        np.float32,
        counters=hindsight_counters,
    )
    period = EPISODE + 1
    used = ring.rows // period * period
    at = np.arange(used) % period
    rng = np.random.default_rng(0)
    for store in ring.obs:
        store[:] = rng.standard_normal(store.shape, np.float32)
    ring.action[:] = rng.uniform(-1, 1, ring.action.shape)
    ring.reward[:] = -rng.random(ring.rows, np.float32)
    ring.kind[:used] = np.where(at == EPISODE, LAST, STEP)
    if ring.until_end is not None:
        ring.until_end[:used] = EPISODE - at
    ring.head[:] = used - 1
    ring.start[:] = used - period
    ring.n_steps[:] = used // period * EPISODE
    return ring


def fill_sb3(buffer: Any) -> Any:
    """Fills a replay buffer of Stable-Baselines3 (hindsight included) with complete episodes and returns it."""
    rng = np.random.default_rng(0)
    size = buffer.buffer_size

    def fill(store: np.ndarray) -> None:
        store[:] = rng.standard_normal(store.shape, np.float32)

    for name in ("observations", "next_observations"):
        stores = getattr(buffer, name, None)
        for store in stores.values() if isinstance(stores, dict) else [] if stores is None else [stores]:
            fill(store)
    fill(buffer.actions)
    fill(buffer.rewards)
    buffer.dones[:] = (np.arange(size) % EPISODE == EPISODE - 1)[:, None]
    buffer.timeouts[:] = buffer.dones
    if hasattr(buffer, "ep_start"):
        whole = size // EPISODE * EPISODE
        buffer.ep_start[:whole] = (np.arange(whole) // EPISODE * EPISODE)[:, None]
        buffer.ep_length[:whole] = EPISODE
    buffer.full, buffer.pos = True, 0
    return buffer


def nbytes(buffer: Any) -> int:
    """Returns the size in bytes of all arrays that an object holds directly or in dictionaries."""
    total = 0
    for value in vars(buffer).values():
        for array in value.values() if isinstance(value, dict) else [value]:
            total += array.nbytes if isinstance(array, np.ndarray) else 0
    return total
