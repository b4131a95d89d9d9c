"""Interrupts a run and resumes it. The result is bit for bit the same as without the interruption."""

from pathlib import Path

import numpy as np

import rejeu
from rejeu.agents import Agent
from rejeu.callbacks import Checkpoint
from rejeu.training.run import Progress

STEPS, INTERRUPTED_AT = 2_000, 50


def interrupt(agent: Agent, progress: Progress) -> bool:
    """Stops training early, like a crash or Ctrl-C."""
    return progress.step < INTERRUPTED_AT


def make_agent() -> rejeu.SAC:
    """Returns an untrained agent."""
    return rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=20, policy_kwargs={"net_arch": [64, 64]}, seed=0)


uninterrupted = make_agent().learn(STEPS)

folder = Path("checkpoints")
make_agent().learn(STEPS, callback=[interrupt, Checkpoint(folder, every=40)])
resumed = rejeu.SAC.resume(folder)  # in a new process, or after a restart of the machine
resumed.learn()  # takes the remaining steps

same = all(
    np.array_equal(value, resumed.get_parameters()[name]) for name, value in uninterrupted.get_parameters().items()
)
print(f"resumed and uninterrupted runs of {resumed.num_timesteps} steps have equal weights: {same}")
