"""What the hooks are told of the environments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.loops.run import Progress

if TYPE_CHECKING:
    from rejeu.agents import Agent


def infos_of(agent: Agent, progress: Progress) -> list[dict[str, Any]]:
    """Returns one info for each environment, with what Stable-Baselines3's vector environments and Monitor put there."""
    result, env = progress.result, agent.env
    assert result is not None
    assert env is not None
    said = result.info if isinstance(result.info, list) else [{} for _ in range(env.n_envs)]
    infos = [
        {**info, "TimeLimit.truncated": bool(result.truncated[i] and not result.terminated[i])}
        for i, info in enumerate(said)
    ]
    for i in np.flatnonzero(result.terminated | result.truncated).tolist():
        if progress.last_obs is not None:
            infos[i].setdefault("terminal_observation", _row(progress.last_obs, i))
        if not np.isnan(success := env.success(result, i)):
            infos[i].setdefault("is_success", bool(success))
    for episode in progress.episodes:
        counted = {"r": episode.episode_return, "l": episode.length, "t": episode.seconds}
        infos[episode.env].setdefault("episode", counted)
    return infos


def _row(batch: Any, i: int) -> Any:
    if isinstance(batch, dict):
        return {key: _row(part, i) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_row(part, i) for part in batch)
    return batch[i]
