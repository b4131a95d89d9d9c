"""Action noise: its processes, the repulsive boundary, and how actions saturate without it.

Actions are in [-1, 1], the scale in which algorithms act, unless bounds are given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rejeu.exploration.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise, barrier, barrier_slope
from rejeu.reporting.plots import style
from rejeu.validation import number, whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.reporting.figures import Picture

BEYOND = 1.2
"""How far beyond the bounds the boundary is drawn, in half widths of the range."""
COUNTED = 100
"""Processes over which saturation is counted."""


def noise(
    noises: ActionNoise | Sequence[ActionNoise],
    path: str | Path | None = None,
    *,
    n_steps: int = 1_000,
    n_processes: int = 5,
    action: ArrayLike = 0.0,
    seed: int = 0,
    title: str = "",
) -> Picture:
    """Draws what noise adds to an action that stays the same, step by step.

    Args:
        noises: the noise, or several, a panel each, with the same random numbers and one scale.
        path: of a file to write, whose suffix says the format (``.png``, ``.svg``, ``.pdf``); None for none.
        n_steps: length of the processes in steps.
        n_processes: how many are drawn; of noise in several dimensions each process is one curve a dimension.
        action: the policy's, in [-1, 1], a number or ``(action_dim,)``; of meaning with a repulsive boundary only.
        seed: of the random numbers.
        title: over the picture; empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        TypeError: for what is no noise on actions.
    """
    given = [noises] if isinstance(noises, ActionNoise) else list(noises)
    n_steps, n_processes = whole("n_steps", n_steps, least=1), whole("n_processes", n_processes, least=1)
    courses = [_actions(one, n_steps, n_processes, action, seed) - np.asarray(action) for one in given]
    figure = style.blank("drawing noise", height=1.2 + 2.4 * len(given))
    panels = figure.subplots(len(given), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, one, course in zip(panels, given, courses, strict=True):
        curves = course.reshape(n_steps, -1)
        for i in range(curves.shape[1]):
            shade = _shade(i, curves.shape[1])
            panel.plot(np.arange(1, n_steps + 1), curves[:, i], color=style.LINE_COLOR, alpha=shade, linewidth=0.8)
        panel.set_ylabel("noise")
        panel.annotate(_described(one), (0.0, 1.02), xycoords="axes fraction", color=style.INK, fontsize=8.5)
        style.dress(panel)
    panels[-1].set_xlabel("step")
    panels[-1].set_xlim(0, n_steps)
    panels[-1].xaxis.set_major_formatter(style.thousands)
    if title:
        figure.suptitle(title, x=0.02, ha="left", color=style.INK, fontsize=12, fontweight="bold")
    return style.write(figure, path)


def repulsive_boundary(
    repulsive: float = 1e-4,
    path: str | Path | None = None,
    *,
    low: float = -1.0,
    high: float = 1.0,
    title: str = "",
) -> Picture:
    """Draws the repulsive barrier of :class:`OrnsteinUhlenbeckActionNoise` and its derivative, the push of one step.

    With the half width ``h = (high - low) / 2`` and ``u = (action - middle) / h`` these are ``repulsive h^2 B(u)`` and
    ``repulsive h B'(u)``, where ``B(u) = (pi u / 2)^6``: the second is how far an action is pushed back, in its own units.

    Args:
        repulsive: the strength, as the noise takes it.
        path: of a file to write, whose suffix says the format (``.png``, ``.svg``, ``.pdf``); None for none.
        low: lower bound of the action in the environment's units.
        high: upper bound.
        title: over the picture; empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: for a negative strength, or if ``low`` is not below ``high``.
    """
    repulsive = number("repulsive", repulsive, least=0)
    low = number("low", low)
    half = (number("high", high, above=low) - low) / 2
    u = np.linspace(-BEYOND, BEYOND, 481)
    action = low + half * (u + 1)
    push = (repulsive * barrier_slope(u)).clip(-abs(u), abs(u))
    figure = style.blank("drawing the repulsive boundary", height=5.6)
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, name in (
        (panels[0], half**2 * repulsive * barrier(u), "barrier"),
        (panels[1], half * push, "its derivative: push of one step"),
    ):
        panel.plot(action, values, **style.LINE)
        panel.set_ylabel(name)
        style.dress(panel)
        for bound in (low, high):
            panel.axvline(bound, color=style.INK, linewidth=1.2)
    panels[1].set_xlabel("action plus noise, between its bounds")
    style.head(panels[0], title)
    return style.write(figure, path)


def saturation(
    noise: OrnsteinUhlenbeckActionNoise,
    path: str | Path | None = None,
    *,
    action: float = 0.6,
    n_steps: int = 700,
    n_processes: int = 5,
    seed: int = 0,
    title: str = "",
) -> Picture:
    """Draws the actions taken with a noise, without its repulsive boundary above and with it below.

    Both have the same random numbers. Where an action is at its bound, it is drawn in red: there the policy and the noise no
    longer make a difference. The share of such steps stands above each panel, and the policy's own action is dashed.

    Args:
        noise: with a repulsive boundary; its first dimension is drawn.
        path: of a file to write, whose suffix says the format (``.png``, ``.svg``, ``.pdf``); None for none.
        action: the policy's, the same at every step, in [-1, 1].
        n_steps: how many.
        n_processes: how many are drawn; the share is that of 100.
        seed: of the random numbers.
        title: over the picture; empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: if the noise has no repulsive boundary.
    """
    if not isinstance(noise, OrnsteinUhlenbeckActionNoise) or not max(noise.repulsive) > 0:
        raise ValueError(f"{noise!r} has no repulsive boundary; give OrnsteinUhlenbeckActionNoise(..., repulsive=1e-4)")
    n_steps, n_processes = whole("n_steps", n_steps, least=1), whole("n_processes", n_processes, least=1)
    action = number("action", action, least=-1, most=1)
    figure = style.blank("drawing saturation", height=5.6)
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for panel, one in zip(panels, (replace(noise, repulsive=(0.0,)), noise), strict=True):
        taken = _actions(one, n_steps, max(n_processes, COUNTED), action, seed)[:, :, 0].clip(-1.0, 1.0)
        _taken(panel, taken[:, :n_processes], action)
        share = (abs(taken[:, :COUNTED]) == 1.0).mean()
        text = f"repulsive {one.repulsive[0]:g}: {share:.1%} of the actions of {COUNTED} processes at a bound"
        panel.annotate(text, (0.0, 1.02), xycoords="axes fraction", color=style.INK, fontsize=8.5)
    panels[-1].set_xlabel("step")
    panels[-1].set_xlim(0, n_steps)
    panels[-1].xaxis.set_major_formatter(style.thousands)
    if title:
        figure.suptitle(title, x=0.02, ha="left", color=style.INK, fontsize=12, fontweight="bold")
    return style.write(figure, path)


def _taken(panel: Axes, taken: np.ndarray, action: float) -> None:
    """Draws actions ``(n_steps, n_processes)``, in red where they are at a bound, and the policy's own."""
    steps = np.arange(1, len(taken) + 1)
    panel.axhline(action, color=style.MUTED, linewidth=1.0, linestyle=(0, (4, 3)))
    for i, course in enumerate(taken.T):
        shade = _shade(i, taken.shape[1])
        panel.plot(steps, course, color=style.LINE_COLOR, alpha=shade, linewidth=0.9)
        panel.plot(steps, np.where(abs(course) == 1.0, course, np.nan), color=style.BAD_COLOR, linewidth=3.0)
    panel.set_ylim(-1.08, 1.08)
    panel.set_ylabel("action taken")
    style.dress(panel)


def _shade(curve: int, n: int) -> float:
    """Returns the opacity of one of ``n`` curves, so that they can be told apart."""
    return 1.0 - 0.7 * curve / n


def _actions(noise: ActionNoise, n_steps: int, n_processes: int, action: ArrayLike, seed: int) -> np.ndarray:
    """Returns a constant action with noise, not yet clipped, ``float32 (n_steps, n_processes, action_dim)``."""
    if not isinstance(noise, ActionNoise):
        raise TypeError(f"{noise!r} is no noise on actions; NormalActionNoise and OrnsteinUhlenbeckActionNoise are")
    rng = np.random.default_rng(seed)
    fixed = np.broadcast_to(np.asarray(action, np.float32), (n_processes, len(noise.mean)))
    state, taken = noise.init(n_processes), np.empty((n_steps, *fixed.shape), np.float32)
    for t in range(n_steps):
        state, taken[t] = noise.advance(state, fixed, rng.standard_normal(fixed.shape, np.float32))
    return taken


def _described(noise: ActionNoise) -> str:
    """Returns the settings that shape a noise, those of its first dimension, on one line."""
    if isinstance(noise, NormalActionNoise):
        return f"Gaussian, sigma {noise.sigma[0]:g}"
    assert isinstance(noise, OrnsteinUhlenbeckActionNoise)
    said = f"Ornstein-Uhlenbeck, sigma {noise.sigma[0]:g}, theta {noise.theta:g}, dt {noise.dt:g}"
    said += f", drift {noise.drift[0]:g}" if noise.drift[0] else ""
    return said + (f", repulsive {noise.repulsive[0]:g}" if noise.repulsive[0] else "")
