"""Checks of course 1: DQN and PPO from their parts."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.core import Transition
from rejeu.courses.checks.base import Wrong, call, close, compiles, diagnose, exercise, mistakes, numbers


@exercise
def replay_memory(student: Any) -> None:
    """Checks the class ``ReplayMemory(capacity, obs_size)`` with ``push``, ``sample`` and ``len``."""
    memory = call(student, 4, 2)
    for i in range(1, 4):
        call(memory.push, np.full(2, i), i, 10.0 * i, np.full(2, i + 0.5), 0.1 * i, may_return_none=True)
    _check_length(memory, 3)
    seen = _sampled(memory)
    mistakes(writes_nothing=seen == {0}, never_filled=0 in seen)
    for i in range(4, 7):
        call(memory.push, np.full(2, i), i, 10.0 * i, np.full(2, i + 0.5), 0.1 * i, may_return_none=True)
    _check_length(memory, 4)
    seen = _sampled(memory)
    mistakes(newest_missing={5, 6} - seen)
    if seen != {3, 4, 5, 6}:
        raise Wrong("other_transitions", seen=sorted(seen))


def _check_length(memory: Any, expected: int) -> None:
    length = call(len, memory, copies=False)
    if length != expected:
        raise Wrong("length", length=length, expected=expected)


def _sampled(memory: Any) -> set[int]:
    """Returns the numbers of the transitions that sampling finds.

    Raises:
        Wrong: if batches have wrong shapes, mix transitions or are all the same.
    """
    rng, found = np.random.default_rng(0), []
    for _ in range(60):
        batch = call(memory.sample, 2, rng, copies=False)
        mistakes(five_arrays=not isinstance(batch, tuple | list) or len(batch) != 5)
        shapes = ((2, 2), (2,), (2,), (2, 2), (2,))
        obs, action, reward, next_obs, discount = (numbers(x, s) for x, s in zip(batch, shapes, strict=True))
        rows = np.stack([obs[:, 0], action, reward / 10, next_obs[:, 0] - 0.5 * (obs[:, 0] > 0), discount * 10])
        mistakes(mixed=not close(rows, np.tile(rows[0], (5, 1))))
        found.append(np.round(rows[0]).astype(int))
    mistakes(always_the_same=found[0].any() and all((one == found[0]).all() for one in found))
    return set(np.concatenate(found).tolist())


@exercise
def discounts(student: Any) -> None:
    """Checks ``discounts(terminated, truncated, gamma)``."""
    terminated, truncated = np.array([False, True, False, True]), np.array([False, False, True, True])
    result = numbers(call(student, terminated, truncated, 0.9), (4,))
    diagnose(
        result,
        [0.9, 0.0, 0.9, 0.0],
        truncation_ends=[0.9, 0.0, 0.0, 0.0],
        termination_goes_on=[0.9, 0.9, 0.9, 0.9],
        reversed=[0.0, 0.9, 0.0, 0.9],
        exchanged=[0.9, 0.9, 0.0, 0.0],
        no_gamma=[1.0, 0.0, 1.0, 0.0],
    )


@exercise
def td_targets(student: Any) -> None:
    """Checks ``td_targets(reward, discount, next_q)``."""
    reward, discount = jnp.array([1.0, -1.0, 2.0]), jnp.array([0.9, 0.5, 0.0])
    next_q = jnp.array([[1.0, 3.0], [4.0, 2.0], [5.0, 6.0]])
    best = next_q.max(axis=1)
    diagnose(
        numbers(call(student, reward, discount, next_q), (3,)),
        reward + discount * best,
        no_discount=reward + best,
        worst_action=reward + discount * next_q.min(axis=1),
        mean_action=reward + discount * next_q.mean(axis=1),
        number_of_action=reward + discount * next_q.argmax(axis=1),
        whole_batch=reward + discount * next_q.max(),
        reward_discounted=discount * (reward + best),
        sign_of_future=reward - discount * best,
    )
    compiles(student, reward, discount, next_q)


@exercise
def td_errors(student: Any) -> None:
    """Checks ``td_errors(q, action, target)``."""
    q = jnp.array([[1.0, 3.0, 0.0], [4.0, 2.0, 7.0], [5.0, 6.0, 8.0]])
    action, target = jnp.array([0, 1, 2]), jnp.array([2.0, 5.0, 7.0])
    taken = jnp.array([1.0, 2.0, 8.0])
    diagnose(
        numbers(call(student, q, action, target), (3,)),
        target - taken,
        reversed=taken - target,
        best_action=target - q.max(axis=1),
        first_action=target - q[:, 0],
        squared=(target - taken) ** 2,
        absolute=jnp.abs(target - taken),
    )
    compiles(student, q, action, target)


@exercise
def td_loss(student: Any) -> None:
    """Checks ``td_loss(network, target_network, batch)``: its value, and its gradient with respect to the network."""
    network = jax.tree_util.Partial(_linear, jnp.array([[1.0, -1.0], [0.5, 2.0]]))
    target_network = jax.tree_util.Partial(_linear, jnp.array([[-1.0, 1.5], [2.0, 0.5]]))
    batch = Transition(
        obs=jnp.array([[1.0, 0.0], [0.5, -1.0], [2.0, 1.0]]),
        action=jnp.array([0, 1, 1]),
        reward=jnp.array([1.0, -1.0, 0.5]),
        next_obs=jnp.array([[0.0, 1.0], [1.0, 1.0], [-1.0, 0.5]]),
        discount=jnp.array([0.9, 0.9, 0.0]),
    )

    def error(network: Any, frozen: Any) -> Any:
        taken = jnp.take_along_axis(network(batch.obs), batch.action[:, None], axis=1)[:, 0]
        return batch.reward + batch.discount * frozen(batch.next_obs).max(axis=1) - taken

    result = numbers(call(student, network, target_network, batch), ())
    right = error(network, target_network)
    diagnose(
        result,
        jnp.mean(right**2),
        own_targets=jnp.mean(error(network, network) ** 2),
        exchanged=jnp.mean(error(target_network, network) ** 2),
        only_target=jnp.mean(error(target_network, target_network) ** 2),
        sum=jnp.sum(right**2),
        not_squared=jnp.mean(right),
    )
    gradient = call(jax.grad(student), network, target_network, batch).args[0]
    mistakes(no_gradient=close(gradient, jnp.zeros((2, 2))))


def _linear(weight: Any, obs: Any) -> Any:
    return obs @ weight


@exercise
def next_target(student: Any) -> None:
    """Checks ``next_target(target, weight, n_updates, interval)``."""
    target, weight = jnp.array([1.0, 2.0]), jnp.array([3.0, 5.0])
    counts = range(8, 17)
    result = np.stack([numbers(call(student, target, weight, jnp.int32(n), 8), (2,)) for n in counts])
    is_due = np.array([[n % 8 == 0] for n in counts])
    diagnose(
        result,
        np.where(is_due, weight, target),
        reversed=np.where(is_due, target, weight),
        never_frozen=np.tile(weight, (9, 1)),
        never_changes=np.tile(target, (9, 1)),
    )
    compiles(student, target, weight, jnp.int32(1), 8)


@exercise
def epsilon(student: Any) -> None:
    """Checks ``epsilon(progress, start, end)``."""
    progress, start, end = np.array([0.0, 0.25, 0.5, 1.0]), 0.8, 0.05
    result = np.stack([numbers(call(student, float(p), start, end), ()) for p in progress])
    diagnose(
        result,
        start * (end / start) ** progress,
        grows=end * (start / end) ** progress,
        linear=start + (end - start) * progress,
        misses_end=start * end**progress,
        constant=np.full(4, start),
    )
    compiles(student, 0.5, start, end)


@exercise
def choose(student: Any) -> None:
    """Checks ``choose(q, epsilon, key)``, by counting the actions of many environments."""
    n, share = 30_000, 0.3
    q = jnp.tile(jnp.array([1.0, 5.0, 2.0]), (n, 1))
    result = numbers(call(student, q, share, jax.random.PRNGKey(0)), (n,))
    if not np.isin(result, (0, 1, 2)).all():
        raise Wrong("value_as_action", value=result[~np.isin(result, (0, 1, 2))][0])
    shares = np.bincount(result.astype(int), minlength=3) / n
    random, greedy = share / 3, 1 - share
    seen = np.round(shares, 2)
    about = lambda *expected: np.allclose(shares, expected, atol=0.015)  # noqa: E731
    if about(random, greedy + random, random):
        return compiles(student, q, share, jax.random.PRNGKey(0))
    if about((1 - share) / 3, share + (1 - share) / 3, (1 - share) / 3):
        raise Wrong("exchanged", share=share, others=1 - share)
    mistakes(worst_action=about(greedy + random, random, random), one_draw=(shares > 0.999).any())
    raise Wrong("other_shares", share=share, seen=seen, expected=np.round([random, greedy + random, random], 2))


class _Corridor:
    """An environment of three steps in an episode; every other episode is truncated. It notes what it was asked."""

    def __init__(self) -> None:
        self.episode, self.time, self.n_steps = -1, 0, 0
        self.goes_on_after: set[str] = set()
        self.actions: list[Any] = []

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.episode, self.time = self.episode + 1, 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
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

    def push(self, *transition: Any) -> None:
        self.append(transition)

    def sample(self, batch_size: int, rng: Any) -> tuple[int, int]:
        return len(self), batch_size


@exercise
def loop(student: Any) -> None:
    """Checks ``loop(env, memory, act, learn, n_episodes, batch_size, gamma, rng)`` with an environment that takes notes."""
    env, memory = _Corridor(), _Notes()
    seen: list[tuple[np.ndarray, float]] = []
    batches: list[Any] = []

    def act(obs: np.ndarray, progress: float) -> int:
        seen.append((obs, progress))
        return 10 + len(seen)

    returns = call(student, env, memory, act, batches.append, 4, 5, 0.9, np.random.default_rng(0), copies=False)
    mistakes(no_step=not env.n_steps)
    if env.goes_on_after:
        raise Wrong("both_ends" if len(env.goes_on_after) == 2 else f"after_{env.goes_on_after.pop()}")
    if env.n_steps != 12:
        raise Wrong("too_few_steps", n=env.n_steps)
    mistakes(other_actions=env.actions != [*range(11, 23)])
    states = [np.array([episode, time], np.float32) for episode in range(4) for time in range(4)]
    before, after = (np.stack([s for i, s in enumerate(states) if i % 4 != left]) for left in (3, 0))
    mistakes(old_obs=not close([obs for obs, _ in seen], before), no_push=not memory)
    if len(memory) != 12 or any(len(transition) != 5 for transition in memory):
        raise Wrong("pushes", n=len(memory))
    obs, action, reward, next_obs, discount = (np.array([one[i] for one in memory], float) for i in range(5))
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
def success_rate(student: Any) -> None:
    """Checks ``success_rate(returns, threshold)``."""
    returns = np.array([-200.0, -150.0, -110.0, -200.0, -90.0, -200.0, -200.0, -120.0, -200.0, -130.0])
    diagnose(
        numbers(call(student, returns, -200.0), ()),
        0.5,
        number=5.0,
        threshold_counts=1.0,
        percent=50.0,
        reversed=0.0,
    )


@exercise
def log_prob(student: Any) -> None:
    """Checks ``log_prob(mean, log_std, action)``."""
    mean, log_std = jnp.array([[0.0, 1.0], [0.5, -1.0], [2.0, 0.0]]), jnp.array([[-0.5, 0.3]])
    action = jnp.array([[0.2, 0.4], [0.0, 0.0], [1.0, 1.5]])
    result = call(student, mean, log_std, action)
    z = (action - mean) / jnp.exp(log_std)
    terms = -0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    mistakes(per_component=np.shape(result) == (3, 2))
    diagnose(
        numbers(result, (3,)),
        terms.sum(axis=1),
        density=jnp.exp(terms.sum(axis=1)),
        reversed=-terms.sum(axis=1),
        mean=terms.mean(axis=1),
        no_std=(terms + log_std).sum(axis=1),
        no_constant=(terms + 0.5 * jnp.log(2 * jnp.pi)).sum(axis=1),
        no_half=(terms - 0.5 * z**2).sum(axis=1),
        divided_by_log_std=(-0.5 * ((action - mean) / log_std) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi)).sum(axis=1),
    )
    compiles(student, mean, log_std, action)


@exercise
def draw_action(student: Any) -> None:
    """Checks ``draw_action(mean, log_std, noise)``."""
    mean, log_std = jnp.array([[0.0, 1.0], [0.5, -1.0]]), jnp.array([[-0.5, 0.3]])
    noise = jnp.array([[1.0, -0.5], [0.2, 2.0]])
    diagnose(
        numbers(call(student, mean, log_std, noise), (2, 2)),
        mean + jnp.exp(log_std) * noise,
        log_std_as_std=mean + log_std * noise,
        no_std=mean + noise,
        no_noise=mean,
        no_mean=jnp.exp(log_std) * noise,
        minus=mean - jnp.exp(log_std) * noise,
        variance=mean + jnp.exp(2 * log_std) * noise,
    )
    compiles(student, mean, log_std, noise)


@exercise
def returns_to_go(student: Any) -> None:
    """Checks ``returns_to_go(rewards, gamma)``."""
    rewards, gamma = np.array([1.0, 2.0, -1.0, 4.0]), 0.5
    powers = gamma ** np.arange(4)
    diagnose(
        numbers(call(student, rewards, gamma), (4,)),
        [2.25, 2.5, 1.0, 4.0],
        no_gamma=[6.0, 5.0, 3.0, 4.0],
        past=[1.0, 2.5, 0.25, 4.125],
        discounted_from_start=np.cumsum((rewards * powers)[::-1])[::-1],
        in_reverse=[4.0, 1.0, 2.5, 2.25],
        without_own=[1.25, 0.5, 2.0, 0.0],
    )


@exercise
def normalized_advantages(student: Any) -> None:
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


@exercise
def advantage(student: Any) -> None:
    """Checks ``advantage(reward, value, next_value, discount, ended, following, gae_lambda)``."""
    reward, value = jnp.array([1.0, 2.0, -1.0]), jnp.array([0.5, 3.0, 1.0])
    next_value, discount = jnp.array([2.0, 1.0, 4.0]), jnp.array([0.9, 0.0, 0.9])
    ended, following, lam = jnp.array([False, True, True]), jnp.array([1.5, -2.0, 3.0]), 0.8
    going = jnp.where(ended, 0.0, discount * lam * following)
    delta = reward + discount * next_value - value
    diagnose(
        numbers(call(student, reward, value, next_value, discount, ended, following, lam), (3,)),
        delta + going,
        reversed=going - delta,
        into_next_episode=delta + discount * lam * following,
        truncation_ends=reward + jnp.where(ended, 0.0, discount * next_value) - value + going,
        next_not_discounted=reward + next_value - value + going,
        exchanged=reward + discount * value - next_value + going,
        following_not_discounted=delta + jnp.where(ended, 0.0, lam * following),
        no_lambda=delta + jnp.where(ended, 0.0, discount * following),
        only_td_error=delta,
    )
    compiles(student, reward, value, next_value, discount, ended, following, lam)


@exercise
def ratio(student: Any) -> None:
    """Checks ``ratio(new, old)`` of log-probabilities."""
    new, old = jnp.array([-1.0, -2.0, -0.5]), jnp.array([-1.5, -1.0, -0.25])
    diagnose(
        numbers(call(student, new, old), (3,)),
        jnp.exp(new - old),
        inverted=jnp.exp(old - new),
        logarithm=new - old,
        divided_logarithms=new / old,
    )
    compiles(student, new, old)


@exercise
def policy_loss(student: Any) -> None:
    """Checks ``policy_loss(ratio, advantage, clip)``."""
    r, a = jnp.array([0.5, 0.9, 1.6, 1.7, 0.4, 1.1]), jnp.array([2.0, 1.0, 3.0, -1.0, -2.0, -3.0])
    clipped = jnp.clip(r, 0.8, 1.2)
    right = jnp.minimum(r * a, clipped * a)
    diagnose(
        numbers(call(student, r, a, 0.2), ()),
        -right.mean(),
        reversed=right.mean(),
        larger_term=-jnp.maximum(r * a, clipped * a).mean(),
        not_clipped=-(r * a).mean(),
        only_clipped=-(clipped * a).mean(),
        advantage_clipped=-jnp.minimum(r * a, r * jnp.clip(a, 0.8, 1.2)).mean(),
        around_zero=-jnp.minimum(r * a, jnp.clip(r, -0.2, 0.2) * a).mean(),
        only_above=-jnp.minimum(r * a, jnp.minimum(r, 1.2) * a).mean(),
        only_below=-jnp.minimum(r * a, jnp.maximum(r, 0.8) * a).mean(),
        sum=-right.sum(),
    )
    compiles(student, r, a, 0.2)


@exercise
def value_loss(student: Any) -> None:
    """Checks ``value_loss(value, target)``, with values ``(n, 1)`` and targets ``(n,)``."""
    value, target = jnp.array([[1.0], [2.0], [4.0]]), jnp.array([2.0, 0.0, 5.0])
    error = value[:, 0] - target
    diagnose(
        numbers(call(student, value, target), ()),
        jnp.mean(error**2),
        broadcast=jnp.mean((value - target[None]) ** 2),
        reversed=-jnp.mean(error**2),
        not_squared=jnp.mean(error),
        sum=jnp.sum(error**2),
    )
    compiles(student, value, target)
