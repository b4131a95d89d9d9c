"""Checks of the loops: of what environments return, and of the state before training."""

from __future__ import annotations

import math
import warnings

import jax
import numpy as np

from rejeu.algorithms.config import AlgorithmConfig
from rejeu.core.algorithm import Masked, PyTree
from rejeu.core.errors import BadEnvironmentError, NonFiniteError
from rejeu.core.spaces import is_finite, leaves
from rejeu.envs import validation
from rejeu.envs.base import Step
from rejeu.training.learner import Learner
from rejeu.training.run import Run, restart, timed


@timed("env")
def checked_step(run: Run, action: np.ndarray, config: AlgorithmConfig, active: np.ndarray | None = None) -> Step:
    """Steps the environments, or those that are ``active``, and checks what they return, bounds from time to time.

    Raises:
        BadEnvironmentError, NonFiniteError, NonFiniteUpdate: as :func:`check_finite`.
    """
    step = run.env.step(action, active)
    check_finite(run, step, run.step)
    if config.action_repeat > 1:
        step = held(run, action, config, active, step)
    if run.step >= run.next_look:
        check_bounds(run, step.obs)
    return step


def held(run: Run, action: np.ndarray, config: AlgorithmConfig, active: np.ndarray | None, step: Step) -> Step:
    """Holds an action after its first ``step``, until ``action_repeat`` are taken or an episode ends in any environment.

    Returns the last step. Its reward is the sum over all; with hindsight its own, as those of relabeled goals are.
    """
    for _ in range(config.action_repeat - 1):
        if (step.terminated | step.truncated).any():
            break
        reward = step.reward.copy()
        step = run.env.step(action, active)
        check_finite(run, step, run.step)
        if getattr(config, "hindsight", None) is None:
            step = step._replace(reward=reward + step.reward)
    return step


def check_finite(run: Run, step: Step, n_steps: int) -> None:
    """Checks the rewards and observations of a step after ``n_steps`` steps.

    Raises:
        BadEnvironmentError: if a reward or an observation is NaN or infinite: nothing can be learned from it.
        NonFiniteError: if the agent's own action was not finite, so that the environment is not to blame.
        NonFiniteUpdate: if that action came from weights that an update left not finite.
    """
    if not is_finite(step.reward):
        raise _reward_error(run, step.reward, n_steps)
    check_obs(run, step.obs, n_steps, "returned")


def checked_restart(run: Run) -> PyTree:
    """Starts an episode in every environment, which ends the running ones, and returns the observations, checked."""
    check_obs(run, restart(run), run.step, "reset returned")
    return run.obs


@timed("env")
def checked_reset(run: Run, done: np.ndarray) -> PyTree:
    """Starts new episodes in the environments where ``done`` and returns the observations of all.

    Raises:
        BadEnvironmentError: if one of them is not finite.
    """
    obs = run.env.reset_done(done)
    check_obs(run, obs, run.step, "reset returned")
    return obs


def check_obs(run: Run, obs: PyTree, n_steps: int, verb: str) -> None:
    """Raises ``BadEnvironmentError`` if an observation ``(n_envs, ...)`` is NaN or infinite; see :func:`check_finite`."""
    for i, array in enumerate(jax.tree.leaves(obs)):
        if not is_finite(array):
            raise _observation_error(run, i, array, n_steps, verb)


def check_bounds(run: Run, obs: PyTree) -> None:
    """Warns once in a run if an observation ``(n_envs, ...)`` lies far outside of the declared bounds.

    The interval between two checks doubles each time, because a check takes longer than a step of some environments.
    """
    run.next_look = 2 * run.step + 1
    fault = validation.far_outside(run.env.observation_space, obs.obs if isinstance(obs, Masked) else obs)
    if fault is not None:
        run.next_look = math.inf
        warnings.warn(
            f"{run.env.env_id} returned {fault}, after {run.step} steps. Networks learn badly from large numbers: scale the "
            "observations, or set normalize=True if it is not, and declare the bounds that they really have",
            UserWarning,
            stacklevel=2,
        )


def _reward_error(run: Run, reward: np.ndarray, n_steps: int) -> Exception:
    _check_action(run, n_steps)
    index = int(np.flatnonzero(~np.isfinite(reward))[0])
    return BadEnvironmentError(
        f"{run.env.env_id} returned the reward {reward[index]} in environment {index} after {n_steps} steps; rewards must be "
        "finite numbers: fix the environment, or wrap it with gymnasium.wrappers.TransformReward"
    )


def _observation_error(run: Run, leaf: int, array: np.ndarray, n_steps: int, verb: str) -> Exception:
    _check_action(run, n_steps)
    where = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
    path, at = leaves(run.env.observation_space)[leaf].path, ", ".join(map(str, where[1:]))
    return BadEnvironmentError(
        f"{run.env.env_id}: {verb} an observation with {array[where]}{f' at [{at}]' if at else ''}"
        f"{f' of {path!r}' if path else ''} in environment {where[0]} after {n_steps} steps; observations must be finite "
        "numbers: fix the environment, or wrap it with gymnasium.wrappers.TransformObservation and np.nan_to_num"
    )


def _check_action(run: Run, n_steps: int) -> None:
    if run.action is not None and not is_finite(run.action):
        run.monitor.check(run.state)
        index = int(np.argwhere(~np.isfinite(run.action))[0][0])
        raise NonFiniteError(
            f"the policy chose the action {run.action[index]} in environment {index} after {n_steps} steps, and "
            f"{run.env.env_id} answered with numbers that are not finite. The weights are finite, what they compute is not: "
            "they or the observations are too large; lower learning_rate, or set normalize=True",
            names=("action",),
            step=n_steps,
            n_updates=run.n_updates,
        )


def check_state(run: Run, learner: Learner) -> None:
    """Raises ``NonFiniteError`` if the state is not finite when training begins; waits for the device."""
    if bad := learner.bad_leaves(run.state):
        raise _state_error(run, bad)


def _state_error(run: Run, bad: list[str]) -> Exception:
    more = f" and {len(bad) - 1} more of its arrays are" if len(bad) > 1 else " is"
    return NonFiniteError(
        f"{bad[0]} of the agent's state{more} not finite before learning begins (step {run.step}, update "
        f"{run.n_updates}): load another model, or give it finite numbers with set_parameters",
        names=[text.split(" ")[0] for text in bad],
        step=run.step,
        n_updates=run.n_updates,
    )
