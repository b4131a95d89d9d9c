"""Deep Q-learning on MountainCar-v0 with the hyper-parameters of a well-known exercise, several seeds.

450 episodes, hidden layers 128-128, batches of 128 from the last 10,000 steps, Adam at 3e-4, gamma 0.99, one gradient step
a step of the environment, the target copied every 10 of them, squared loss, gradients clipped by value at 100, and epsilon
falling from 0.9 to 0.01 by the same factor every episode. As in the exercise, the 200-step limit counts as a terminal
state; ``--bootstrap`` lets values go on through it, rejeu's usual way. In the runs that we made so, none ever found the
flag: all values fell to -1 / (1 - gamma) = -100 before the car had been anywhere.

Prints, a line for each seed, the share of training episodes that reached the flag, that of the last 100, the return of the
greedy policy over 50 episodes, and the wall time of training, compilation included::

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
    """Returns what one run of training and 50 greedy episodes gave."""
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
