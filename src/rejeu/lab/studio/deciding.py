"""Bars of an agent's actions at a step: values or probabilities, or the mean and spread of each number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.agents import Agent
from rejeu.core.language import said
from rejeu.core.types import Action, Observation, PyTree
from rejeu.teaching.play.keys import keys_for, known_keys

MOST_SAMPLES, LEAST_SAMPLES, MOST_NUMBERS = 256, 16, 2**18
"""Actions that are drawn where an agent has probabilities, so that their shares are within a few percent; and how many numbers
their observations may have, so that a policy that sees pictures still acts in time."""
MOST_BARS = 10


class Bar(NamedTuple):
    """A line below the picture. Places are shares of its width."""

    name: str
    text: str
    """The number in words."""
    start: float
    end: float
    mark: float | None = None
    """Place of the action that is taken, if it is a number."""
    is_chosen: bool = False
    """Whether it is the action that is taken, of Discrete ones."""


def bars_of(agent: Agent, env: gym.Env, step: tuple[Observation, PyTree, Action], extents: list[float]) -> list[Bar]:
    """Returns the bars of a step, empty for actions that are neither Discrete nor Box.

    Args:
        agent: that acts.
        env: in which it acts.
        step: the observation, the memory of the policy before it, and the action that it takes.
        extents: of the values of actions at the steps before; that of this step is added.
    """
    obs, memory, action = step
    space = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        names, index = action_names(env, space), int(action) - int(space.start)
        if agent.learner.algorithm.action_values is not None:
            values = agent.q_values(obs, None, "mean")
            extents.append(float(np.ptp(values)))
            return value_bars(values, names, index, max(extents))
        drawn = samples(agent, obs, memory) - int(space.start)
        shares = np.bincount(drawn.astype(int), minlength=len(names)) / len(drawn)
        return highest_bars(shares, [f"{100 * share:.0f} %" for share in shares], names, index)
    if isinstance(space, gym.spaces.Box):
        drawn = samples(agent, obs, memory)
        drawn = drawn.reshape(len(drawn), -1)[:, :MOST_BARS]
        ends = (space.low.reshape(-1)[:MOST_BARS], space.high.reshape(-1)[:MOST_BARS])
        return spread_bars(drawn, np.reshape(action, -1)[:MOST_BARS], *ends, number_names(env, space))
    return []


def samples(agent: Agent, obs: Observation, memory: PyTree) -> np.ndarray:
    """Returns actions that the policy draws at an observation, ``(n, ...)``; of a large one fewer."""
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(obs))
    n = min(max(MOST_NUMBERS // size, LEAST_SAMPLES), MOST_SAMPLES)
    copies = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], n, 0), obs)
    carried = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), n, 0), memory)
    return np.asarray(agent.predict(copies, carried, deterministic=False)[0])


def action_names(env: gym.Env, space: gym.spaces.Discrete) -> list[str]:
    """Returns names of the actions: those of the keys of the game, or their numbers."""
    start, env_id = int(space.start), "" if env.spec is None else env.spec.id
    names = {binding.action: said(binding.label) for binding in keys_for(env_id, space).bindings}
    return [names.get(start + i, said("action {}", start + i)) for i in range(int(space.n))]


def number_names(env: gym.Env, space: gym.spaces.Box) -> list[str]:
    """Returns names of the numbers of Box actions: those of the keys of the game that change them, or their positions."""
    names = [said("number {}", i + 1) for i in range(space.low.size)]
    entry = known_keys("" if env.spec is None else env.spec.id, space) or {}
    for i in range(len(names)):
        alone = [(action[i], label) for action, label in entry.values() if label and [*np.flatnonzero(action)] == [i]]
        if alone:
            names[i] = " / ".join(dict.fromkeys(said(label) for _, label in (min(alone), max(alone))))
    return names


def value_bars(values: np.ndarray, names: Sequence[str], index: int, extent: float) -> list[Bar]:
    """Returns the bars of the values of actions ``(n,)``.

    That of the highest value is full, and of the others lacks their difference from it as a share of ``extent``.

    >>> [(bar.name, bar.text, bar.end) for bar in value_bars(np.array([1.0, 3.0, 2.0]), "abc", 1, extent=4.0)]
    [('a', '1', 0.5), ('b', '3', 1.0), ('c', '2', 0.75)]
    """
    ends = 1.0 - (values.max() - values) / (extent or 1.0)
    return highest_bars(ends, [f"{value:.4g}" for value in values], names, index)


def highest_bars(ends: np.ndarray, texts: Sequence[str], names: Sequence[str], index: int) -> list[Bar]:
    """Returns the bars of actions, of many those with the highest ends; ``index`` is that of the action that is taken."""
    at = np.sort(np.argsort(-ends, kind="stable")[:MOST_BARS]).tolist()
    return [Bar(names[i], texts[i], 0.0, float(ends[i]), is_chosen=i == index) for i in at]


def spread_bars(
    drawn: np.ndarray, action: np.ndarray, low: np.ndarray, high: np.ndarray, names: Sequence[str]
) -> list[Bar]:
    """Returns a bar of mean and standard deviation for each number of Box actions ``(n, k)``, between its bounds."""
    low = np.where(np.isfinite(low), low, np.minimum(drawn.min(0), action) - 1.0)
    high = np.where(np.isfinite(high), high, np.maximum(drawn.max(0), action) + 1.0)
    mean, spread = drawn.mean(0), drawn.std(0)
    places = [np.clip((value - low) / (high - low), 0, 1).tolist() for value in (mean - spread, mean + spread, action)]
    return [
        Bar(names[i], f"{mean[i]:.2f} ± {spread[i]:.2f}", start, end, mark)
        for i, (start, end, mark) in enumerate(zip(*places, strict=True))
    ]
