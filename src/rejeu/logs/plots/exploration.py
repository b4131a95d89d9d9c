"""Figures of action noise: sample paths, the repulsive boundary, and the saturation of actions.

Actions are in [-1, 1], unless bounds are given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rejeu.core.validation import number, whole
from rejeu.exploration.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise, barrier, barrier_slope
from rejeu.logs.plots import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.logs.plots.picture import Picture

BEYOND = 1.2
"""Distance from the center up to which the boundary is drawn, in half widths of the range."""
N_MEASURED = 100
"""Number of sample paths over which saturation is measured."""


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
    """Draws sample paths of noise on a constant action.

    Args:
        noises: one noise, or several, which have one panel each and the same random numbers.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        n_steps: length of the sample paths.
        n_processes: number of sample paths, which have one curve for each dimension.
        action: the policy's action in [-1, 1], a number or ``(action_dim,)``. It matters only with a repulsive boundary.
        seed: random seed.
        title: title of the figure, empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        TypeError: for other objects than action noise.
    """
    processes = [noises] if isinstance(noises, ActionNoise) else list(noises)
    n_steps, n_processes = whole("n_steps", n_steps, least=1), whole("n_processes", n_processes, least=1)
    paths = [_actions(process, n_steps, n_processes, action, seed) - np.asarray(action) for process in processes]
    figure = drawing.make_figure("drawing noise", height=1.2 + 2.4 * len(processes))
    panels = figure.subplots(len(processes), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, process, values in zip(panels, processes, paths, strict=True):
        _sample_paths(panel, values.reshape(n_steps, -1), "noise", _describe(process))
    return _finished(figure, n_steps, title, path)


def repulsive_boundary(
    repulsive: float = 1e-4,
    path: str | Path | None = None,
    *,
    low: float = -1.0,
    high: float = 1.0,
    title: str = "",
) -> Picture:
    """Draws the repulsive boundary of :class:`OrnsteinUhlenbeckActionNoise` and its derivative, the push of one step.

    With the half width ``h = (high - low) / 2`` and ``u = (action - middle) / h`` these are ``repulsive h^2 B(u)`` and
    ``repulsive h B'(u)``, where ``B(u) = (pi u / 2)^6``: the second is the distance by which an action is pushed back.

    Args:
        repulsive: strength, as for the noise.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        low: lower bound of the action.
        high: upper bound.
        title: title of the figure, empty for none.

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
    figure = drawing.make_figure("drawing the repulsive boundary", height=5.6)
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, name in (
        (panels[0], half**2 * repulsive * barrier(u), "barrier"),
        (panels[1], half * push, "its derivative: push of one step"),
    ):
        panel.plot(action, values, **drawing.LINE)
        panel.set_ylabel(name)
        panel.xaxis.set_major_formatter(drawing.thousands)
        panel.yaxis.set_major_formatter(drawing.thousands)
        drawing.format_axes(panel)
        for bound in (low, high):
            panel.axvline(bound, color=drawing.INK, linewidth=1.2)
    panels[1].set_xlabel("action plus noise, between its bounds")
    drawing.add_title_and_legend(panels[0], title)
    return drawing.save(figure, path)


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
    """Draws actions with a noise, above without its repulsive boundary and below with it.

    Both have the same random numbers. Actions at a bound are red, and their share is shown above each panel. The policy's
    action is dashed.

    Args:
        noise: noise with a repulsive boundary, whose first dimension is drawn.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        action: the policy's constant action in [-1, 1].
        n_steps: length of the sample paths.
        n_processes: number of sample paths that are drawn; the share is measured over 100.
        seed: random seed.
        title: title of the figure, empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: if the noise has no repulsive boundary.
    """
    if not isinstance(noise, OrnsteinUhlenbeckActionNoise) or not max(noise.repulsive) > 0:
        raise ValueError(f"{noise!r} has no repulsive boundary; use OrnsteinUhlenbeckActionNoise(..., repulsive=1e-4)")
    n_steps, n_processes = whole("n_steps", n_steps, least=1), whole("n_processes", n_processes, least=1)
    action = number("action", action, least=-1, most=1)
    figure = drawing.make_figure("drawing saturation", height=5.6)
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for panel, process in zip(panels, (replace(noise, repulsive=(0.0,)), noise), strict=True):
        actions = _actions(process, n_steps, max(n_processes, N_MEASURED), action, seed)[:, :, 0].clip(-1.0, 1.0)
        share = (abs(actions[:, :N_MEASURED]) == 1.0).mean()
        text = f"repulsive {process.repulsive[0]:g}: {share:.1%} of the actions of {N_MEASURED} sample paths at a bound"
        panel.axhline(action, color=drawing.MUTED, linewidth=1.0, linestyle=(0, (4, 3)))
        _sample_paths(panel, actions[:, :n_processes], "action taken", text)
        at_bound = np.where(abs(actions[:, :n_processes]) == 1.0, actions[:, :n_processes], np.nan)
        panel.plot(np.arange(1, n_steps + 1), at_bound, color=drawing.BAD_COLOR, linewidth=3.0)
        panel.set_ylim(-1.08, 1.08)
    return _finished(figure, n_steps, title, path)


def _sample_paths(panel: Axes, curves: np.ndarray, name: str, text: str) -> None:
    """Draws curves ``(n_steps, n_curves)``, which their opacity distinguishes, with a text above them."""
    for i, curve in enumerate(curves.T):
        shade = 1.0 - 0.7 * i / curves.shape[1]
        panel.plot(np.arange(1, len(curve) + 1), curve, color=drawing.LINE_COLOR, alpha=shade, linewidth=0.8)
    panel.set_ylabel(name)
    panel.annotate(text, (0.0, 1.02), xycoords="axes fraction", color=drawing.INK, fontsize=8.5)
    drawing.format_axes(panel)


def _finished(figure: Picture, n_steps: int, title: str, path: str | Path | None) -> Picture:
    """Gives a figure of panels its axis of steps and its title, and writes it to ``path``, if there is one."""
    drawing.steps_axis(figure.axes[-1], n_steps)
    if title:
        figure.suptitle(title, x=0.02, ha="left", color=drawing.INK, fontsize=12, fontweight="bold")
    return drawing.save(figure, path)


def _actions(noise: ActionNoise, n_steps: int, n_processes: int, action: ArrayLike, seed: int) -> np.ndarray:
    """Returns a constant action with noise, before clipping, ``float32 (n_steps, n_processes, action_dim)``."""
    if not isinstance(noise, ActionNoise):
        raise TypeError(f"{noise!r} is not action noise; use NormalActionNoise or OrnsteinUhlenbeckActionNoise")
    rng = np.random.default_rng(seed)
    fixed = np.broadcast_to(np.asarray(action, np.float32), (n_processes, len(noise.mean)))
    state, actions = noise.init(n_processes), np.empty((n_steps, *fixed.shape), np.float32)
    for t in range(n_steps):
        state, actions[t] = noise.advance(state, fixed, rng.standard_normal(fixed.shape, np.float32))
    return actions


def _describe(noise: ActionNoise) -> str:
    """Describes a noise on one line, by the settings of its first dimension."""
    if isinstance(noise, NormalActionNoise):
        return f"Gaussian, sigma {noise.sigma[0]:g}"
    assert isinstance(noise, OrnsteinUhlenbeckActionNoise)
    text = f"Ornstein-Uhlenbeck, sigma {noise.sigma[0]:g}, theta {noise.theta:g}, dt {noise.dt:g}"
    text += f", drift {noise.drift[0]:g}" if noise.drift[0] else ""
    return text + (f", repulsive {noise.repulsive[0]:g}" if noise.repulsive[0] else "")
