"""Records the learning curves of the pages on algorithms, and plots them.

    python benchmarks/curves.py record SAC     # trains three seeds; writes benchmarks/results/curves/SAC.json
    python benchmarks/curves.py plot           # writes docs/images/curves: a picture for each, goals, equal-time

A curve is the mean return of the latest 20 training episodes, exploration included, at 100 equally spaced steps. The dashed
line is the published return of ``benchmarks/results/published.json``.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import rejeu
from rejeu.agents import presets
from rejeu.algorithms import config as configs
from rejeu.core import validation
from rejeu.envs.make import make_vector
from rejeu.logs.plots import drawing as style

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import learning
from scripts import figures
from trials.provenance import provenance

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PICTURES = ROOT / "benchmarks" / "results", ROOT / "docs" / "images" / "curves"
SEEDS = (0, 1, 2)
WINDOW, POINTS = 20, 100
ENVIRONMENTS = {
    **dict.fromkeys(("SAC", "DDPG", "TD3", "TQC", "CrossQ", "PPO"), "Pendulum-v1"),
    **dict.fromkeys(("DQN", "QRDQN", "A2C", "PQN"), "CartPole-v1"),
    "RecurrentPPO": "rejeu/CartPoleNoVelocity-v0",
}

GOAL_SETTINGS = {
    "FetchPush-v4": {
        "FetchPush-v4-SAC": "mixed goals, the preset",
        "choice/FetchPush-later-states": "later states",
        "choice/FetchPush-demonstrations-later-states": "later states, demonstrations",
        "choice/FetchPush-demonstrations-mix": "mixed goals, demonstrations",
    },
    "FetchPickAndPlace-v4": {
        "FetchPickAndPlace-v4-SAC": "mixed goals, the preset",
        "choice/FetchPickAndPlace-later-states": "later states",
        "choice/FetchPickAndPlace-demonstrations-later-states": "later states, demonstrations",
        "demonstrations/FetchPickAndPlace": "mixed goals, demonstrations",
    },
    "FetchSlide-v4 of EnvPool": {
        "choice/FetchSlide-envpool": "mixed goals",
        "choice/FetchSlide-future": "later states",
    },
}
"""Settings whose success rates are drawn together: files of ``results/learning/goals``, and their labels."""


def curve(steps: np.ndarray, returns: np.ndarray, grid: np.ndarray) -> list[float | None]:
    """Returns the mean of the latest episodes at each step of the grid, None before the first episode has ended."""
    finished = np.searchsorted(steps, grid, side="right")
    return [round(float(np.mean(returns[max(n - WINDOW, 0) : n])), 2) if n else None for n in finished]


def record(name: str) -> None:
    """Trains an algorithm on all seeds and writes its curves."""
    env_id = ENVIRONMENTS[name]
    preset = presets.find(env_id, name) or learning.zoo(env_id, name)
    assert preset is not None, f"there are no settings of {name} for {env_id}"
    grid = np.linspace(0, preset.total_steps, POINTS + 1)[1:].astype(int)
    curves = []
    for seed in SEEDS:
        env = make_vector(env_id, preset.n_envs, preset.backend, seed)
        agent = rejeu.AGENTS[name]("MlpPolicy", env, seed=seed, **preset.hyperparameters).learn(preset.total_steps)
        assert not agent.interrupted
        curves.append(curve(agent.history["step"], agent.history["return"], grid))
        print(name, seed, curves[-1][-1], flush=True)
    versions = {package: importlib.metadata.version(package) for package in ("jax", "gymnasium", "envpool")}
    data: dict[str, Any] = {**provenance(), "command": f"python benchmarks/curves.py record {name}"}
    data |= {"env": env_id, "algorithm": name}
    config = validation.build(rejeu.AGENTS[name].algorithm.Config, preset.hyperparameters)
    data |= {"versions": versions, "hyperparameters": configs.to_json(config), "seeds": SEEDS}
    data |= {"steps": grid.tolist(), "returns": curves}
    path = RESULTS / "curves" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(data) + "\n", encoding="utf-8")


def plot(path: Path, published: list[dict[str, Any]]) -> None:
    """Plots the curves of one file: every seed, their mean, and the published return."""
    data = json.loads(path.read_text(encoding="utf-8"))
    returns = np.array(data["returns"], float)  # None becomes NaN
    figure = style.make_figure("the learning curve", height=3.4)
    panel = figure.subplots()
    style.format_axes(panel)
    for values in returns:
        panel.plot(data["steps"], values, color=style.DOT_COLOR, linewidth=0.8, alpha=0.7)
    panel.plot(data["steps"], returns.mean(axis=0), label=f"mean of {len(returns)} seeds", **style.LINE)
    for entry in published:
        if (entry["algorithm"], entry["env"], entry["steps"]) == (data["algorithm"], data["env"], data["steps"][-1]):
            label = f"published: {entry['by']}, {entry['return']:.0f}"
            panel.axhline(entry["return"], color=style.ACCENT_COLOR, linewidth=1.4, linestyle="--", label=label)
    panel.set(xlabel="environment steps", ylabel=f"return, last {WINDOW} episodes")
    panel.xaxis.set_major_formatter("{x:,.0f}")
    style.add_title_and_legend(panel, f"{data['algorithm']} on {data['env'].removeprefix('rejeu/')}")
    style.save(figure, PICTURES / f"{data['algorithm']}.png")


def plot_goals(panel: Any, title: str, labels: dict[Path, str]) -> None:
    """Plots the success rates of files of ``learning.py`` against steps: the mean of the seeds and their range."""
    style.format_axes(panel)
    runs_by_label = {label: runs for path, label in labels.items() if (runs := curved(path))}
    for i, (label, runs) in enumerate(runs_by_label.items()):
        color, _ = style.GROUP_COLORS[i % len(style.GROUP_COLORS)]
        line = "-" if i < len(style.GROUP_COLORS) else "--"
        steps = [step for step, _ in runs[0]["success_curve"]]
        rates = np.array([[rate for _, rate in run["success_curve"]] for run in runs])
        panel.plot(steps, rates.mean(axis=0), line, color=color, label=f"{label} ({len(runs)})", marker=".")
        panel.fill_between(steps, rates.min(axis=0), rates.max(axis=0), color=color, alpha=0.15, linewidth=0)
    panel.set(xlabel="environment steps", ylabel="success rate", ylim=(0, 1.02))
    panel.xaxis.set_major_formatter("{x:,.0f}")
    style.add_title_and_legend(panel, title)


def plot_equal_time(panel: Any, env_id: str, options: str = "") -> None:
    """Plots the returns of the runs of equal time against minutes: a line for each seed, whose end is the last evaluation."""
    style.format_axes(panel)
    runs_by_method = figures.equal_time_runs(env_id, options)
    for name, (color, _) in zip(figures.EQUAL_TIME, style.GROUP_COLORS, strict=False):
        for run in runs_by_method.get(name, []) if "GPU" not in name else []:
            points = [*run.get("curve", []), (run["steps"], run["mean_return"])]
            minutes = [step / run["steps"] * run["seconds"] / 60 for step, _ in points]
            panel.plot(minutes, [value for _, value in points], color=color, label=name, marker=".")
    panel.set(xlabel="minutes", ylabel="return", xlim=(0, 21))
    panel.yaxis.set_major_formatter("{x:,.0f}")
    panel.set_title(env_id + options.replace("-", " "), loc="left", color=style.INK, fontsize=12, fontweight="bold")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "plot"))
    parser.add_argument("algorithm", nargs="?", choices=tuple(ENVIRONMENTS))
    arguments = parser.parse_args()
    if arguments.action == "record":
        for name in [arguments.algorithm] if arguments.algorithm else ENVIRONMENTS:
            record(name)
        return
    published = json.loads((RESULTS / "published.json").read_text(encoding="utf-8"))
    for path in sorted((RESULTS / "curves").glob("*.json")):
        plot(path, published)
    figure = style.make_figure("success in goal environments", height=12.0)
    panels = figure.subplots(1 + len(GOAL_SETTINGS), 1)
    folder = RESULTS / "learning" / "goals"
    presets_of = {path: path.stem.removesuffix("-SAC") for path in sorted(folder.glob("*.json"))}
    plot_goals(panels[0], "Presets (number of curves)", presets_of)
    for panel, (env_id, settings) in zip(panels[1:], GOAL_SETTINGS.items(), strict=True):
        plot_goals(panel, env_id, {folder / f"{name}.json": label for name, label in settings.items()})
    style.save(figure, PICTURES / "goals.png")
    figure = style.make_figure("returns after equal time", height=7.2)
    shown = [("HalfCheetah-v5",), ("Hopper-v5",), ("Walker2d-v5",), ("Ant-v5", "-without-contact-forces")]
    for panel, task in zip(figure.subplots(2, 2).flat, shown, strict=True):
        plot_equal_time(panel, *task)
    lines = {name: line for panel in figure.axes for line, name in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend([*lines.values()], [*lines], loc="outside lower left", ncols=len(lines), frameon=False)
    style.save(figure, PICTURES / "equal-time.png")


def curved(path: Path) -> list[dict[str, Any]]:
    """Returns the runs of a file of ``learning.py`` that have success rates on the way."""
    return [run for run in json.loads(path.read_text(encoding="utf-8"))["runs"] if "success_curve" in run]


if __name__ == "__main__":
    main()
