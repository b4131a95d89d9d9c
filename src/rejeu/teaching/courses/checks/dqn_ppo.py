"""Checks of course 1: DQN and PPO from their parts."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.core.algorithm import Transition
from rejeu.core.types import Action, AnyArray, Info, Observation
from rejeu.teaching.courses.checks import (
    Student,
    Wrong,
    call,
    close,
    compiles,
    diagnose,
    exercise,
    mistakes,
    numbers,
    tabulated,
)


def _linear(weight: AnyArray, obs: Observation) -> AnyArray:
    return obs @ weight


_NETWORKS = {
    "network": jax.tree_util.Partial(_linear, jnp.array([[1.0, -1.0], [0.5, 2.0]])),
    "target_network": jax.tree_util.Partial(_linear, jnp.array([[-1.0, 1.5], [2.0, 0.5]])),
}
_BATCH = Transition(
    obs=jnp.array([[1.0, 0.0], [0.5, -1.0], [2.0, 1.0]]),
    action=jnp.array([0, 1, 1]),
    reward=jnp.array([1.0, -1.0, 0.5]),
    next_obs=jnp.array([[0.0, 1.0], [1.0, 1.0], [-1.0, 0.5]]),
    discount=jnp.array([0.9, 0.9, 0.0]),
)
globals().update(tabulated(__name__, **_NETWORKS, batch=_BATCH))


@exercise
def replay_memory(student: Student) -> None:
    """Checks the class ``ReplayMemory(capacity, obs_size)`` with ``push``, ``sample`` and ``len``."""
    memory = call(student, 4, 2)
    for i in range(1, 4):
        call(memory.push, np.full(2, i), i, 10.0 * i, np.full(2, i + 0.5), 0.1 * i, may_return_none=True)
    _check_length(memory, 3)
    stored = _sampled(memory)
    mistakes(writes_nothing=stored == {0}, never_filled=0 in stored)
    for i in range(4, 7):
        call(memory.push, np.full(2, i), i, 10.0 * i, np.full(2, i + 0.5), 0.1 * i, may_return_none=True)
    _check_length(memory, 4)
    stored = _sampled(memory)
    mistakes(newest_missing={5, 6} - stored)
    if stored != {3, 4, 5, 6}:
        raise Wrong("other_transitions", seen=sorted(stored))


def _check_length(memory: object, expected: int) -> None:
    length = call(len, memory, copies=False)
    if length != expected:
        raise Wrong("length", length=length, expected=expected)


def _sampled(memory: Any) -> set[int]:
    """Returns the numbers of the transitions that sampling finds.

    Raises:
        Wrong: if batches have wrong shapes, mix transitions or are all the same.
    """
    rng, sampled = np.random.default_rng(0), []
    for _ in range(60):
        batch = call(memory.sample, 2, rng, copies=False)
        mistakes(five_arrays=not isinstance(batch, tuple | list) or len(batch) != 5)
        shapes = ((2, 2), (2,), (2,), (2, 2), (2,))
        obs, action, reward, next_obs, discount = (numbers(x, s) for x, s in zip(batch, shapes, strict=True))
        rows = np.stack([obs[:, 0], action, reward / 10, next_obs[:, 0] - 0.5 * (obs[:, 0] > 0), discount * 10])
        mistakes(mixed=not close(rows, np.tile(rows[0], (5, 1))))
        sampled.append(np.round(rows[0]).astype(int))
    again = [call(memory.sample, 2, np.random.default_rng(1), copies=False)[0] for _ in range(8)]
    mistakes(ignores_rng=len(np.unique(numbers(np.stack(again), (8, 2, 2)), axis=0)) > 1)
    mistakes(always_the_same=sampled[0].any() and all((row == sampled[0]).all() for row in sampled))
    return set(np.concatenate(sampled).tolist())


@exercise
def choose(student: Student) -> None:
    """Checks ``choose(q, epsilon, key)``, by counting the actions of many environments."""
    n, share = 30_000, 0.3
    q = jnp.tile(jnp.array([1.0, 5.0, 2.0]), (n, 1))
    result = numbers(call(student, q, share, jax.random.PRNGKey(0)), (n,))
    if not np.isin(result, (0, 1, 2)).all():
        raise Wrong("value_as_action", value=result[~np.isin(result, (0, 1, 2))][0])
    shares = np.bincount(result.astype(int), minlength=3) / n
    random, greedy = share / 3, 1 - share
    rounded = np.round(shares, 2)
    are_close = lambda *expected: np.allclose(shares, expected, atol=0.015)  # noqa: E731
    if are_close(random, greedy + random, random):
        return compiles(student, q, share, jax.random.PRNGKey(0))
    if are_close((1 - share) / 3, share + (1 - share) / 3, (1 - share) / 3):
        raise Wrong("exchanged", share=share, others=1 - share)
    mistakes(worst_action=are_close(greedy + random, random, random), one_draw=(shares > 0.999).any())
    raise Wrong("other_shares", share=share, seen=rounded, expected=np.round([random, greedy + random, random], 2))


class _Corridor:
    """An environment of three steps in an episode; every other episode is truncated. It notes what it was asked."""

    def __init__(self) -> None:
        self.episode, self.time, self.n_steps = -1, 0, 0
        self.goes_on_after: set[str] = set()
        self.actions: list[Action] = []

    def reset(self, seed: int | None = None, options: object = None) -> tuple[np.ndarray, Info]:
        self.episode, self.time = self.episode + 1, 0
        return self._observe(), {}

    def step(self, action: Action) -> tuple[np.ndarray, float, bool, bool, Info]:
        ends = ("terminated", "truncated")
        if self.time >= 3:
            self.goes_on_after.add(ends[self.episode % 2])
        self.time, self.n_steps = self.time + 1, self.n_steps + 1
        self.actions.append(action)
        is_end = self.time >= 3
        terminated, truncated = (is_end and self.episode % 2 == i for i in range(2))
        return self._observe(), float(self.time), terminated, truncated, {}

    def _observe(self) -> np.ndarray:
        return np.array([self.episode, self.time], np.float32)


class _Notes(list):
    """A memory that keeps everything in order."""

    def push(self, *transition: object) -> None:
        self.append(transition)

    def sample(self, batch_size: int, rng: object) -> tuple[int, int]:
        return len(self), batch_size


@exercise
def loop(student: Student) -> None:
    """Checks ``loop(env, memory, act, learn, n_episodes, batch_size, gamma, rng)`` with an environment that takes notes."""
    env, memory = _Corridor(), _Notes()
    calls: list[tuple[np.ndarray, float]] = []
    batches: list[Any] = []

    def act(obs: np.ndarray, progress: float) -> int:
        calls.append((obs, progress))
        return 10 + len(calls)

    returns = call(student, env, memory, act, batches.append, 4, 5, 0.9, np.random.default_rng(0), copies=False)
    mistakes(no_step=not env.n_steps)
    if env.goes_on_after:
        raise Wrong("both_ends" if len(env.goes_on_after) == 2 else f"after_{env.goes_on_after.pop()}")
    if env.n_steps != 12:
        raise Wrong("too_few_steps", n=env.n_steps)
    mistakes(other_actions=env.actions != [*range(11, 23)])
    states = [np.array([episode, time], np.float32) for episode in range(4) for time in range(4)]
    before, after = (np.stack([s for i, s in enumerate(states) if i % 4 != omitted]) for omitted in (3, 0))
    mistakes(old_obs=not close([obs for obs, _ in calls], before), no_push=not memory)
    if len(memory) != 12 or any(len(transition) != 5 for transition in memory):
        raise Wrong("pushes", n=len(memory))
    obs, action, reward, next_obs, discount = (np.array([step[i] for step in memory], float) for i in range(5))
    mistakes(obs_too_early=close(obs, after) and close(next_obs, after))
    if not (
        close(obs, before) and close(next_obs, after) and close(action, env.actions) and close(reward, after[:, 1])
    ):
        raise Wrong("other_transitions")
    diagnose(
        discount,
        np.where((after[:, 1] == 3) & (after[:, 0] % 2 == 0), 0.0, 0.9),
        discount_of_truncated=np.where(after[:, 1] == 3, 0.0, 0.9),
        discount_of_terminated=np.full(12, 0.9),
    )
    mistakes(never_learns=not batches)
    if batches[0] != (5, 5) and batches[0][0] < 5:
        raise Wrong("learns_too_early", n=batches[0][0])
    if [n for n, _ in batches] != [*range(5, 13)]:
        raise Wrong("learns_at_other_steps", n=len(batches))
    diagnose(numbers(returns, (4,)), np.full(4, 6.0), last_reward=np.full(4, 3.0), zero=np.zeros(4))


@exercise
def normalized_advantages(student: Student) -> None:
    """Checks ``normalized_advantages(returns, values)``."""
    returns, values = jnp.array([5.0, -1.0, 2.0, 4.0]), jnp.array([1.0, 1.0, 0.0, 6.0])
    gain = returns - values
    right = (gain - gain.mean()) / (gain.std() + 1e-8)
    diagnose(
        numbers(call(student, returns, values), (4,)),
        right,
        not_scaled=gain,
        only_shifted=gain - gain.mean(),
        only_scaled=gain / (gain.std() + 1e-8),
        reversed=-right,
        no_values=(returns - returns.mean()) / (returns.std() + 1e-8),
        variance=(gain - gain.mean()) / (gain.var() + 1e-8),
    )
    mistakes(zero_deviation=not np.isfinite(np.asarray(call(student, values, values))).all())
    compiles(student, returns, values)
