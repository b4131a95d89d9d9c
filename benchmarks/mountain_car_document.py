"""Deep Q-learning on MountainCar-v0 with the hyperparameters of a well-known exercise, on several seeds.

Training takes 450 episodes, with hidden layers 128-128 and batches of 128 from the last 10,000 steps. The optimizer is
Adam at 3e-4, gamma is 0.99, and there is one gradient step per environment step. The target is copied every 10 gradient
steps. The loss is squared and gradients are clipped by value at 100. Epsilon decays from 0.9 to 0.01 by a constant
factor per episode. As in the exercise, the 200-step limit counts as a terminal state; ``--bootstrap`` bootstraps
through it, as rejeu does by default. Without bootstrapping, none of our runs reached the flag: all values converged to
-1 / (1 - gamma) = -100 before the car had explored.

Prints one line per seed: the fraction of training episodes that reached the flag, the same for the last 100 episodes,
the
return of the greedy policy over 50 episodes, and the wall time of training, including compilation::

    python benchmarks/mountain_car_document.py --seeds 0 1 2
"""

from __future__ import annotations

import argparse
import time

import gymnasium as gym

import rejeu

EPISODES = 450
TIME_LIMIT = 200
HYPERPARAMETERS = {
    "learning_rate": 3e-4,
    "buffer_size": 10_000,
    "batch_size": 128,
    "learning_starts": 128,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "target_update_interval": 10,
    "exploration_initial_eps": 0.9,
    "exploration_final_eps": 0.01,
    "exploration_fraction": 1.0,
    "exploration_schedule": "exponential",
    "loss": "squared",
    "max_grad_norm": None,
    "clip_grad_value": 100.0,
    "policy_kwargs": {"net_arch": [128, 128]},
}


def run(seed: int, bootstrap: bool) -> dict[str, float]:
    """Returns the results of one training run and 50 greedy episodes."""
    env = gym.make("MountainCar-v0")
    agent = rejeu.DQN("MlpPolicy", env if bootstrap else rejeu.TimeLimitTerminates(env), seed=seed, **HYPERPARAMETERS)
    began = time.perf_counter()
    agent.learn(episodes=EPISODES)
    seconds = time.perf_counter() - began
    reached = agent.history["return"] > -TIME_LIMIT
    greedy = agent.evaluate(50, env=gym.make("MountainCar-v0"), seed=seed + 1)
    return {
        "steps": agent.num_timesteps,
        "seconds": seconds,
        "success": reached.mean(),
        "success_last_100": reached[-100:].mean(),
        "greedy_return": greedy.mean_return,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--bootstrap", action="store_true", help="do not take the time limit for a terminal state")
    given = parser.parse_args()
    print("seed   steps  seconds  success  of the last 100  greedy return")
    for seed in given.seeds:
        r = run(seed, given.bootstrap)
        print(
            f"{seed:4d}  {r['steps']:6.0f}  {r['seconds']:7.1f}  {r['success']:7.1%}  {r['success_last_100']:15.1%}  "
            f"{r['greedy_return']:13.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
