"""Prints the mean return every 2,000 steps and stops training once it reaches -300.

A callback is any function of the agent and the progress of training. Training stops where it returns False.
"""

import numpy as np

import rejeu
from rejeu.agents import Agent
from rejeu.training.run import Progress


def watch_returns(agent: Agent, progress: Progress) -> bool:
    """Returns whether to continue training."""
    returns = [episode.episode_return for episode in agent.history.last(10)]
    if returns and progress.step % 2_000 == 0:
        print(f"step {progress.step}: mean return {np.mean(returns):.0f} over {len(returns)} episodes")
    return not (len(returns) == 10 and np.mean(returns) > -300)


agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_rate=1e-3, seed=0)
agent.learn(20_000, callback=watch_returns)
print(f"stopped after {agent.num_timesteps} steps")
