"""What the loops between environments on the host and a compiled algorithm share: the run and its bookkeeping.

:mod:`rejeu.loops.off_policy` and :mod:`rejeu.loops.on_policy` are generators over a :class:`Run`: they train, and whoever
iterates them decides what else happens.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from rejeu.buffers.prioritized import Draw
from rejeu.core import Clock, PyTree
from rejeu.envs import validation
from rejeu.envs.make import Step, VectorEnv
from rejeu.errors import BadEnvironmentError, NonFiniteError
from rejeu.loops.learner import Learner, PackedState
from rejeu.loops.nonfinite import NonFiniteMonitor
from rejeu.spaces import leaves

VDOT_SIZE = 2**13
"""Number of elements up to which an array is looked at by its square; beyond it BLAS would call up its threads."""

PARTS = ("env", "replay", "update")
"""What the loops measure the time of; see :attr:`Run.seconds`."""


class Episode(NamedTuple):
    """One finished episode."""

    step: int
    """Environment steps taken in all when it ended."""
    env: int
    """Which environment it ran in."""
    episode_return: float
    """Sum of its rewards."""
    length: int
    """Steps that it took."""
    success: float
    """1.0 or 0.0, NaN if the environment does not say."""
    seconds: float
    """Wall time since training began when it ended."""


class Progress(NamedTuple):
    """What one turn of the loop did."""

    step: int
    """Environment steps taken in all."""
    episodes: list[Episode]
    """Those that ended in this turn."""
    metrics: Mapping[str, Array] | None
    """Of the newest update, on the device: reading one waits for it. None before the first."""
    action: np.ndarray | None = None
    """The actions of this turn, in the environments' own range."""
    result: Step | None = None
    """What the environments answered. Where episodes ended, its observations may be those of the next ones already."""
    last_obs: PyTree = None
    """A copy of the observations before new episodes began, in turns that ended some; None in others."""
    rollout_ended: bool = False
    """Whether this turn was the last before an update, or would have been if learning had begun."""


@dataclass
class Run:
    """Everything that a loop carries from turn to turn, and that a checkpoint of a run must hold. Mutable."""

    env: Any
    """The environments, a :class:`VectorEnv`; None for an agent that only predicts."""
    replay: Any
    """The replay buffer or the rollout buffer; None likewise."""
    state: PackedState
    """The algorithm's state, packed (see :class:`Learner`)."""
    key: Array
    """Root of the randomness of exploration."""
    rng: np.random.Generator
    """Draws batches and the first random actions."""
    carry: PyTree
    """What exploration remembers, per environment."""
    learn_from: int
    """The step from which on gradients are taken."""
    success_threshold: float | None = None
    """Return from which on an episode counts as a success; see :meth:`VectorEnv.judge`."""
    seed: int | None = None
    """Handed to the environments at their first reset."""
    step: int = 0
    episode: int = 0
    n_updates: int = 0
    obs: PyTree = None
    """The present observations; None before the first reset."""
    action: np.ndarray | None = None
    """Chosen for ``obs``, not yet taken; in the algorithm's range."""
    playing: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    """How many more episodes each environment has to play before the next update, where rollouts are whole episodes."""
    ended: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """Where the last turn ended an episode, ``(n_envs,)``."""
    owed: int = 0
    """Environment steps (or episodes) since gradients were last taken, where they are not taken at every turn."""
    steps_since_update: int = 0
    episode_return: np.ndarray = field(default_factory=lambda: np.zeros(0))
    episode_length: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    running_return: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    """The discounted sum of each running episode's rewards, ``sum_k gamma^k r_{t-k}``, for scaling rewards."""
    metrics: Mapping[str, Array] | None = None
    td_errors: list[tuple[Draw, Array]] = field(default_factory=list)
    """Of the newest updates, each beside the draw that it learned from; they set the priorities of the replay buffer one
    turn later."""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys((*PARTS, "total"), 0.0))
    """Wall time by what it went into; ``update`` is the time that the loop waited for the device."""
    next_look: float = 0
    """Environment steps from which on observations are next compared with their declared bounds."""
    watch: NonFiniteMonitor = field(default_factory=NonFiniteMonitor)
    """Looks after the updates: whether what they leave is finite."""


def time_shares(seconds: Mapping[str, float]) -> dict[str, float]:
    """Returns what share of ``seconds["total"]`` went into ``env``, ``replay``, ``update`` and, the rest, everything else.

    The rest is the loop's own bookkeeping and whatever ran between its turns: callbacks, evaluations, files. The shares sum
    to 1; before any time has passed all of it is rest.

    >>> time_shares({"env": 1.0, "replay": 1.0, "update": 5.0, "total": 8.0})
    {'env': 0.125, 'replay': 0.125, 'update': 0.625, 'rest': 0.125}
    """
    total = max(seconds["total"], 1e-9)
    shares = {part: seconds[part] / total for part in PARTS}
    return shares | {"rest": 1.0 - sum(shares.values())}


def restart(run: Run) -> None:
    """Resets every environment; their running episodes are given up."""
    n_envs = run.env.n_envs
    run.obs = run.env.reset(run.seed if run.seed is None or run.env.seeds is None else run.env.seeds)
    check_obs(run, run.obs, run.step, "reset returned")
    run.seed = None
    run.ended = np.ones(n_envs, bool)
    run.episode_return = np.zeros(n_envs)
    run.episode_length = np.zeros(n_envs, np.int64)
    run.running_return = np.zeros(n_envs, np.float32)
    run.action = None


def choose(run: Run, learner: Learner, clock: Clock) -> Array:
    """Returns the exploring policy's actions for the present observations, and moves what it remembers on.

    They may still be under way on the device; ``run.obs`` must not change until they were read.
    """
    action, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
    return action


def clock_of(run: Run, progress: float) -> Clock:
    """Returns where the run stands, as arrays, so that no compiled function depends on the values."""
    return Clock(np.uint32(run.step), np.uint32(run.episode), np.float32(progress))


def counted(run: Run, stepped: int, last: int | None) -> int | None:
    """Returns how many of the ``stepped`` environments' next steps still count, None if all of them do.

    A run takes exactly as many steps as it was asked for: where the number of environments does not divide what remains
    until the step ``last`` (None: no end), the first so many count.
    """
    return None if last is None or last - run.step >= stepped else last - run.step


def book(run: Run, step: Step, counts: np.ndarray | None, stepped: np.ndarray | None = None) -> list[Episode]:
    """Adds a step to the running episodes and returns those that ended.

    Args:
        run: mutated.
        step: what the environments said.
        counts: of which environments the step is kept, ``bool (n_envs,)``, None for all. The episodes of those that were
            stepped and do not count are given up.
        stepped: which environments were stepped, likewise.
    """
    run.ended = step.terminated | step.truncated
    if counts is None:
        run.episode_return += step.reward
        run.episode_length += 1
    else:
        run.ended |= ~counts if stepped is None else stepped & ~counts
        run.episode_return[counts] += step.reward[counts]
        run.episode_length[counts] += 1
    if not np.count_nonzero(run.ended):  # ten times as fast as any()
        return []
    episodes = []
    for env in np.flatnonzero(run.ended).tolist():
        if counts is None or counts[env]:
            run.episode += 1
            value = step.return_of(env, run.episode_return[env])
            success = run.env.judge(step, env, value, run.success_threshold)
            episodes.append(Episode(run.step, env, value, int(run.episode_length[env]), success, run.seconds["total"]))
        run.episode_return[env] = 0.0
        run.episode_length[env] = 0
    return episodes


def last_of(run: Run, step: Step) -> PyTree:
    """Returns a copy of the observations of a step that ended episodes, which new ones may overwrite; else None."""
    return jax.tree.map(np.copy, step.obs) if np.count_nonzero(run.ended) else None


def reset_done(run: Run, done: np.ndarray) -> PyTree:
    """Begins new episodes where ``done`` and returns the observations of all environments.

    Raises:
        BadEnvironmentError: if one of them is not finite.
    """
    obs = run.env.reset_done(done)
    check_obs(run, obs, run.step, "reset returned")
    return obs


def is_finite(array: np.ndarray) -> bool:
    """Returns whether all numbers are finite. The square of a small array is much the fastest look at it."""
    if array.dtype.kind != "f":
        return True
    if array.size <= VDOT_SIZE and math.isfinite(np.vdot(array, array)):
        return True
    return bool(np.isfinite(array).all())


def check_finite(run: Run, step: Step, taken: int) -> None:
    """Raises ``BadEnvironmentError`` if a reward or an observation is NaN or infinite: nothing can be learnt from it.

    Raises:
        NonFiniteError: if the agent's own action was not finite, so that the environment is not to blame.
    """
    if not is_finite(step.reward):
        which = int(np.flatnonzero(~np.isfinite(step.reward))[0])
        _check_action(run, taken)
        raise BadEnvironmentError(
            f"{run.env.env_id} returned the reward {step.reward[which]} in environment {which} after {taken} steps; rewards "
            "must be finite numbers: mend the environment, or wrap it with gymnasium.wrappers.TransformReward"
        )
    check_obs(run, step.obs, taken, "returned")


def check_obs(run: Run, obs: PyTree, taken: int, what: str) -> None:
    """Raises ``BadEnvironmentError`` if an observation ``(n_envs, ...)`` is NaN or infinite; see :func:`check_finite`."""
    for i, array in enumerate(jax.tree.leaves(obs)):
        if not is_finite(array):
            _check_action(run, taken)
            where = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
            path = leaves(run.env.observation_space)[i].path
            at = ", ".join(map(str, where[1:]))
            raise BadEnvironmentError(
                f"{run.env.env_id}: {what} an observation with {array[where]}{f' at [{at}]' if at else ''}"
                f"{f' of {path!r}' if path else ''} in environment {where[0]} after {taken} steps; observations must be "
                "finite numbers: mend the environment, or wrap it with gymnasium.wrappers.TransformObservation and "
                "np.nan_to_num"
            )


def look_at_bounds(run: Run, obs: PyTree) -> None:
    """Warns if an observation ``(n_envs, ...)`` lies far outside of the declared bounds, once in a run.

    To be called from the step ``run.next_look`` on, which is twice as far away every time: looking takes longer than a
    step of some environments.
    """
    run.next_look = 2 * run.step + 1
    fault = validation.far_outside(run.env.observation_space, obs)
    if fault is not None:
        run.next_look = math.inf
        warnings.warn(
            f"{run.env.env_id} returned {fault}, after {run.step} steps. Networks learn badly from large numbers: scale the "
            "observations, or set normalize=True if it is not, and declare the bounds that they really have",
            UserWarning,
            stacklevel=2,
        )


def _check_action(run: Run, taken: int) -> None:
    if run.action is not None and not is_finite(run.action):
        which = int(np.argwhere(~np.isfinite(run.action))[0][0])
        raise NonFiniteError(
            f"the policy chose the action {run.action[which]} in environment {which} after {taken} steps, and "
            f"{run.env.env_id} answered with numbers that are not finite. The weights are finite, what they compute is not: "
            "they or the observations are too large; lower learning_rate, or set normalize=True",
            names=("action",),
            step=taken,
            n_updates=run.n_updates,
        )


def check_state(run: Run, learner: Learner) -> None:
    """Raises ``NonFiniteError`` if the state is not finite before anything is learnt; waits for it."""
    if bad := learner.bad_leaves(run.state):
        more = f" and {len(bad) - 1} more of its arrays are" if len(bad) > 1 else " is"
        raise NonFiniteError(
            f"{bad[0]} of the agent's state{more} not finite before learning begins (step {run.step}, update "
            f"{run.n_updates}); it came so from set_parameters or from a file: give it finite numbers, or load another model",
            names=[text.split(" ")[0] for text in bad],
            step=run.step,
            n_updates=run.n_updates,
        )


def initial_run(
    env: VectorEnv | None, buffer: Any, learner: Learner, learn_from: int, seed: int, state: PackedState | None = None
) -> Run:
    """Returns the beginning of a run; ``seed`` determines everything that is drawn in it.

    Without environment and buffer it serves an agent that only predicts. ``state`` is what has been learnt already.
    """
    learner_key, explore_key = jax.random.split(jax.random.PRNGKey(seed))
    return Run(
        env=env,
        replay=buffer,
        state=learner.init(learner_key) if state is None else state,
        key=explore_key,
        rng=np.random.default_rng(seed),
        carry=learner.initial_carry(1 if env is None else env.n_envs),
        learn_from=learn_from,
        seed=seed,
    )
