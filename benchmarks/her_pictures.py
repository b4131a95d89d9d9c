"""Plots the pictures of the page on goals and HER.

python benchmarks/her_pictures.py record    # trains DQN on BitFlipping; writes benchmarks/results/bit_flipping.json
python benchmarks/her_pictures.py           # writes docs/images/her-*.png
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import rejeu  # noqa: E402
from rejeu.reporting.plots import drawing as style  # noqa: E402
from tests.bit_flipping import BitFlipping  # noqa: E402
from trials.provenance import provenance, write  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results" / "bit_flipping.json"
PICTURES = ROOT / "docs" / "images"
BITS, SEEDS, STEPS = (4, 6, 8, 10, 12, 14), (0, 1, 2), 10_000
SETTINGS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "learning_starts": 100,
    "batch_size": 128,
    "train_freq": 1,
    "gamma": 0.98,
    "target_update_interval": 200,
    "exploration_fraction": 0.5,
    "policy_kwargs": {"net_arch": [128]},
}


def success_rate(n_bits: int, seed: int, with_her: bool) -> float:
    """Trains DQN and returns the success rate of its greedy policy over 200 episodes."""
    buffer = rejeu.HerReplayBuffer if with_her else None
    agent = rejeu.DQN("MultiInputPolicy", BitFlipping(n_bits), replay_buffer_class=buffer, seed=seed, **SETTINGS)
    agent.learn(STEPS)
    return agent.evaluate(200, env=BitFlipping(n_bits), seed=1_000_000 + seed).success_rate


def record() -> None:
    rates: dict[str, dict[int, list[float]]] = {}
    for name, with_her in (("DQN with HER", True), ("DQN", False)):
        rates[name] = {n: [success_rate(n, seed, with_her) for seed in SEEDS] for n in BITS}
        print(name, rates[name], flush=True)
    versions = {package: importlib.metadata.version(package) for package in ("jax", "gymnasium")}
    data = {**provenance(), "versions": versions, "hyperparameters": SETTINGS}
    data |= {"steps": STEPS, "seeds": SEEDS, "success_rate": rates}
    write(RESULTS, data)


def plot_bit_flipping() -> None:
    """Plots the success rates against the number of bits."""
    data = json.loads(RESULTS.read_text(encoding="utf-8"))
    figure = style.make_figure("the picture", height=3.4)
    panel = figure.subplots()
    style.format_axes(panel)
    for (name, rates), color in zip(data["success_rate"].items(), (style.LINE_COLOR, style.ACCENT_COLOR), strict=True):
        bits = [int(n) for n in rates]
        panel.plot(bits, [100 * np.mean(r) for r in rates.values()], "o-", color=color, label=name, linewidth=1.8)
        for n, values in zip(bits, rates.values(), strict=True):
            panel.plot([n] * len(values), [100 * v for v in values], ".", color=color, alpha=0.5)
    panel.set(xlabel="bits", ylabel="success rate, %", ylim=(-4, 104), xticks=bits)
    style.add_title_and_legend(
        panel, f"BitFlipping after {data['steps']:,} steps: means and values of {len(data['seeds'])} seeds"
    )
    style.save(figure, PICTURES / "her-bit-flipping.png")


def plot_relabeling() -> None:
    """Draws an episode that misses its goal, and the same episode with a goal that it reached."""
    t = np.linspace(0, 1, 9)
    path = np.stack([t * 7, 2.2 * np.sin(2.6 * t) + 0.5 * t], axis=1)
    wanted = np.array([6.0, 5.0])
    figure = style.make_figure("the picture", width=9, height=3.6)
    for panel, relabeled in zip(figure.subplots(1, 2, sharey=True), (False, True), strict=True):
        goal = path[6] if relabeled else wanted
        n = 7 if relabeled else len(path)
        color = style.GOOD_COLOR if relabeled else style.BAD_COLOR
        if relabeled:
            panel.plot(*path[6:].T, "o--", color=style.GRID, markersize=7)
            panel.plot(*wanted, "*", color=style.GRID, markersize=20)
        panel.plot(*path[:n].T, "o-", color=style.LINE_COLOR, markersize=7, zorder=2)
        panel.plot(*goal, "*", color=color, markersize=20, zorder=3)
        panel.annotate(
            "goal" if not relabeled else "new goal:\nreached at $t+4$",
            goal,
            (goal[0] - 0.35, goal[1] + (0.5 if relabeled else -0.1)),
            ha="right",
            color=color,
        )
        rewards = ["-1"] * (n - 2) + ["0" if relabeled else "-1"]
        for i, reward in enumerate(rewards):
            middle = path[i : i + 2].mean(axis=0)
            good = reward == "0"
            panel.annotate(
                reward,
                (middle[0] + 0.1, middle[1] - 0.75),
                ha="center",
                color=style.GOOD_COLOR if good else style.MUTED,
                fontsize=9,
                weight="bold" if good else "normal",
            )
        panel.annotate("$s_t$", path[2], path[2] + [-0.3, 0.35], ha="center", color=style.INK)
        panel.set(xlim=(-0.6, 8), ylim=(-1.3, 6), xticks=[], yticks=[], aspect="equal")
        panel.spines[:].set_color(style.GRID)
        title = "In hindsight: the same steps, another goal" if relabeled else "What happened: the goal is missed"
        panel.set_title(title, fontsize=11, color=style.INK, loc="left")
    style.save(figure, PICTURES / "her-relabeling.png")


def plot_strategies() -> None:
    """Draws which achieved goals each strategy may choose for one step."""
    rows = {"future": (1, 5, 11), "final": (1, 11, 11), "episode": (1, 1, 11), "random": (0, 1, 11)}
    figure = style.make_figure("the picture", width=9, height=3.4)
    panel = figure.subplots()
    for y, (name, (own_only, first, last)) in enumerate(rows.items()):
        for episode in range(3):
            start = 13.5 * episode
            for time in range(12):
                chosen = first <= time <= last and (episode == 1 or not own_only)
                is_step = episode == 1 and time == 4
                face = style.GOOD_COLOR if chosen else "white"
                edge = style.GOOD_COLOR if chosen else style.MUTED
                if is_step:
                    face, edge = (style.GOOD_COLOR if chosen else style.LINE_COLOR), style.LINE_COLOR
                panel.plot(
                    start + time,
                    -y,
                    "s" if is_step else "o",
                    color=face,
                    markeredgecolor=edge,
                    markeredgewidth=2 if is_step else 1,
                    markersize=9,
                )
        panel.annotate(f'"{name}"', (-1.2, -y), ha="right", va="center", family="monospace", color=style.INK)
    for episode, text in enumerate(("another episode", "the episode of the step", "another episode")):
        panel.annotate(text, (13.5 * episode + 5.5, 0.65), ha="center", color=style.MUTED)
    panel.annotate(
        "the step to relabel",
        (13.5 + 4, -3.35),
        (13.5 + 4, -4.2),
        ha="center",
        color=style.LINE_COLOR,
        arrowprops={"arrowstyle": "-", "color": style.LINE_COLOR},
    )
    panel.set(xlim=(-6.5, 40), ylim=(-4.5, 1.1))
    panel.axis("off")
    style.save(figure, PICTURES / "her-strategies.png")


if __name__ == "__main__":
    if sys.argv[1:] == ["record"]:
        record()
    else:
        plot_relabeling()
        plot_strategies()
        plot_bit_flipping()
