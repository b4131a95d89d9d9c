"""A line of output for every episode with a higher return than all before it."""

from __future__ import annotations

from rejeu.callbacks.base import TrainedAgent
from rejeu.loops.run import Progress


def print_records(agent: TrainedAgent, progress: Progress) -> None:
    """Prints a line for every record, an episode with a higher return than all before it in the agent's history.

    It is a callback for ``learn``. ``agent.history.records()`` returns the same episodes.

    >>> import rejeu
    >>> agent = rejeu.DQN("MlpPolicy", "MountainCar-v0", learning_starts=10_000, seed=0)
    >>> agent = agent.learn(400, print_records)
    ↗ return -200.00 at step 200
    """
    if not progress.episodes:
        return
    for record in agent.history.records():
        if record.step == progress.step:
            print(f"↗ return {record.episode_return:,.2f} at step {record.step:,}", flush=True)
