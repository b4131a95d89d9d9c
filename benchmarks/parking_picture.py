"""Plots the README's figure from a run folder: the learning curve and four frames of the best model's episode.

rejeu train parking-v0 --seed 0 --out RUN
python benchmarks/parking_picture.py RUN docs/images/parking-run.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib.figure import Figure

import rejeu
from rejeu.envs.masks import for_agent
from rejeu.envs.registry import make_env
from rejeu.envs.rendering import rgb_frame

MOMENTS = 4


def episode(agent: rejeu.agents.Agent, env_id: str, seed: int) -> list[np.ndarray]:
    """Returns the frames of an episode: one before the first step and one after each step.

    Raises:
        RuntimeError: if the episode is not a success.
    """
    env = for_agent(agent, make_env(env_id, render_mode="rgb_array"))
    obs, _ = env.reset(seed=seed)
    frames, done, info = [rgb_frame(env)], False, {}
    while not done:
        action, _ = agent.predict(obs, deterministic=True)
        obs, _, terminated, truncated, info = env.step(action)
        frames.append(rgb_frame(env))
        done = terminated or truncated
    env.close()
    if not info.get("is_success"):
        raise RuntimeError(f"the episode of seed {seed} is no success; choose another with --episode-seed")
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--episode-seed", type=int, default=0)
    given = parser.parse_args()
    curve = matplotlib.image.imread(given.run / "curve.png")
    frames = episode(rejeu.load(given.run / "best"), "parking-v0", given.episode_seed)
    height, width = frames[0].shape[:2]
    share = curve.shape[1] / curve.shape[0] / (width / height / MOMENTS)  # width of the curve relative to the frames
    figure = Figure(figsize=(8 * (1 + 1 / share), 8 * curve.shape[0] / curve.shape[1]), dpi=120, facecolor="white")
    grid = figure.add_gridspec(
        MOMENTS, 2, width_ratios=[share, 1], left=0, right=1, top=1, bottom=0, wspace=0.01, hspace=0.04
    )
    moments = np.linspace(0, len(frames) - 1, MOMENTS).round().astype(int)
    for place, picture in [(grid[:, 0], curve), *((grid[i, 1], frames[at]) for i, at in enumerate(moments))]:
        axes = figure.add_subplot(place)
        axes.imshow(picture, interpolation="antialiased")
        axes.axis("off")
    figure.savefig(given.out)


if __name__ == "__main__":
    main()
