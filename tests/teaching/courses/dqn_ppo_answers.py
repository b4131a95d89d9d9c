"""Right and wrong answers of course 1, and what the checks say about the wrong ones."""

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.teaching.courses.checks import dqn_ppo
from tests.teaching.courses.solutions import solution

right = solution(1, dqn_ppo)


class ReplayMemory:
    def __init__(self, capacity, obs_size):
        self.capacity, self.n_pushed = capacity, 0
        self.obs, self.next_obs = np.zeros((capacity, obs_size)), np.zeros((capacity, obs_size))
        self.action, self.reward, self.discount = np.zeros(capacity, int), np.zeros(capacity), np.zeros(capacity)

    def __len__(self):
        return min(self.n_pushed, self.capacity)

    def place(self):
        return self.n_pushed % self.capacity

    def push(self, obs, action, reward, next_obs, discount):
        i = self.place()
        self.obs[i], self.action[i], self.reward[i] = obs, action, reward
        self.next_obs[i], self.discount[i] = next_obs, discount
        self.n_pushed += 1

    def rows(self, batch_size, rng):
        return rng.integers(len(self), size=batch_size)

    def sample(self, batch_size, rng):
        i = self.rows(batch_size, rng)
        return self.obs[i], self.action[i], self.reward[i], self.next_obs[i], self.discount[i]


class Growing(ReplayMemory):
    def place(self):
        return self.n_pushed


class KeepsOldest(ReplayMemory):
    def place(self):
        return min(self.n_pushed, self.capacity - 1)


class WritesNothing(ReplayMemory):
    def push(self, *transition):
        self.n_pushed += 1


class WithoutReplacement(ReplayMemory):
    def rows(self, batch_size, rng):
        return rng.choice(len(self), batch_size, replace=False)


class OverwritesOthers(ReplayMemory):
    def place(self):
        return self.n_pushed if self.n_pushed < self.capacity else (self.n_pushed + 1) % self.capacity


class Ignores(ReplayMemory):
    def push(self, *transition):
        if self.n_pushed < self.capacity:
            super().push(*transition)


class CountsAll(ReplayMemory):
    def __len__(self):
        return self.n_pushed

    def rows(self, batch_size, rng):
        return rng.integers(min(self.n_pushed, self.capacity), size=batch_size)


class FromAnywhere(ReplayMemory):
    def rows(self, batch_size, rng):
        return rng.integers(self.capacity, size=batch_size)


class Mixed(ReplayMemory):
    def sample(self, batch_size, rng):
        names = ("obs", "action", "reward", "next_obs", "discount")
        return tuple(getattr(self, name)[self.rows(batch_size, rng)] for name in names)


class Latest(ReplayMemory):
    def rows(self, batch_size, rng):
        return np.arange(batch_size) % len(self)


class OwnNumbers(ReplayMemory):
    def rows(self, batch_size, rng):
        return np.random.default_rng().integers(len(self), size=batch_size)


class Silent(ReplayMemory):
    def sample(self, batch_size, rng): ...


def loop(env, memory, act, learn, n_episodes, batch_size, gamma, rng, **mistake):
    """The loop of the course, with mistakes by name."""
    wrong = {
        "ends": "both",
        "obs": "new",
        "first": batch_size,
        "order": 1,
        "discount": "both",
        "total": "sum",
    } | mistake
    returns = []
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=episode)
        total = 0.0
        for _ in range(100):
            action = act(obs, episode / n_episodes)
            next_obs, reward, terminated, truncated, _ = env.step(0 if wrong["order"] == 0 else action)
            d = {"both": 1 - terminated, "truncated": 1 - (terminated or truncated), "none": 1}[wrong["discount"]]
            if wrong["order"] is not None:
                memory.push(next_obs if wrong["order"] == 2 else obs, action, reward, next_obs, gamma * d)
            if len(memory) >= wrong["first"]:
                learn(memory.sample(batch_size, rng))
            total = {"sum": total + reward, "last": reward, "zero": 0.0}[wrong["total"]]
            obs = next_obs if wrong["obs"] == "new" else obs
            if {"both": terminated or truncated, "one": terminated, "other": truncated}.get(wrong["ends"], False):
                break
            if wrong["ends"] == "first":
                break
        returns.append(total)
    return np.array(returns)


def with_mistake(**mistake):
    return lambda *given: loop(*given, **mistake)


RIGHT = [ReplayMemory, *vars(right).values()]


def one_draw(q, epsilon, key):
    whether, which = jax.random.split(key)
    random = jax.random.randint(which, (), 0, q.shape[1])
    return jnp.where(jax.random.uniform(whether) < epsilon, random, q.argmax(axis=1))


def swapped(q, epsilon, key):
    return right.choose(q, 1 - epsilon, key)


def loss_of(target=0, network=0, stop=False, reduce=jnp.mean, power=2):
    """Returns td_loss with the networks of targets and predictions chosen by their position."""

    def loss(*given):
        networks, batch = given[:2], given[2]
        values = networks[target](batch.next_obs)
        y = right.td_targets(batch.reward, batch.discount, jax.lax.stop_gradient(values) if stop else values)
        return reduce(right.td_errors(networks[network](batch.obs), batch.action, y) ** power)

    return loss


def no_gradient(*given):
    return jax.lax.stop_gradient(right.td_loss(*given))


def forwards(rewards, gamma):
    result, before = [], 0.0
    for reward in rewards:
        before = reward + gamma * before
        result.append(before)
    return np.array(result)


def changes_its_input(rewards, gamma):
    for t in reversed(range(len(rewards) - 1)):
        rewards[t] += gamma * rewards[t + 1]
    return rewards


def clipped(r, clip):
    return jnp.clip(r, 1 - clip, 1 + clip)


def z_of(mean, log_std, action):
    return (action - mean) / jnp.exp(log_std)


LOG_2PI = np.log(2 * np.pi)


WRONG = [
    ("replay_memory", Growing, "IndexError"),
    ("replay_memory", KeepsOldest, "the newest transitions are missing"),
    ("replay_memory", OverwritesOthers, "sample returns the transitions [1, 4, 5, 6]"),
    ("replay_memory", Ignores, "the newest transitions are missing"),
    ("replay_memory", WritesNothing, "Does push write"),
    ("replay_memory", CountsAll, "len is 6, but 4"),
    ("replay_memory", FromAnywhere, "a row that was never filled"),
    ("replay_memory", Mixed, "belong to different transitions"),
    ("replay_memory", OwnNumbers, "Batches of two equal generators differ. Draw the rows with rng"),
    ("replay_memory", Latest, "60 batches were all the same"),
    ("replay_memory", Silent, "returns None"),
    ("discounts", lambda te, tr, g: g * (1.0 - (te | tr)), "truncated episode is treated as a terminated one"),
    ("discounts", lambda te, tr, g: g * np.ones(4), "a terminated step still has a future"),
    ("discounts", lambda te, tr, g: g * te, "wrong way around"),
    ("discounts", lambda te, tr, g: g * (1.0 - tr), "truncation ends the future"),
    ("discounts", lambda te, tr, g: 1.0 - te, "where is gamma"),
    ("discounts", lambda te, tr, g: g * (1.0 - te[0]), "the shape is ()"),
    ("td_targets", lambda r, d, q: r + q.max(axis=1), "the discount is missing"),
    ("td_targets", lambda r, d, q: r + d * q.min(axis=1), "worst action"),
    ("td_targets", lambda r, d, q: r + d * q.mean(axis=1), "random policy"),
    ("td_targets", lambda r, d, q: r + d * q.argmax(axis=1), "argmax gives the number"),
    ("td_targets", lambda r, d, q: r + d * q.max(), "over the whole batch"),
    ("td_targets", lambda r, d, q: d * (r + q.max(axis=1)), "the reward is discounted as well"),
    ("td_targets", lambda r, d, q: r - d * q.max(axis=1), "sign of the future"),
    ("td_targets", lambda r, d, q: r + d * q.max(axis=1, keepdims=True), "the shape is (3, 3), expected (3,)"),
    ("td_targets", lambda r, d, q: r + 0.99 * d * q.max(axis=1), "by hand one finds"),
    ("td_errors", lambda q, a, y: right.td_errors(q, a, y) * -1, "the sign is reversed"),
    ("td_errors", lambda q, a, y: y - q.max(axis=1), "compare with the best action"),
    ("td_errors", lambda q, a, y: y - q[:, 0], "first action's value"),
    ("td_errors", lambda q, a, y: y - q[:, a], "the shape is (3, 3)"),
    ("td_errors", lambda q, a, y: right.td_errors(q, a, y) ** 2, "squared already"),
    ("td_errors", lambda q, a, y: abs(right.td_errors(q, a, y)), "absolute value"),
    ("td_loss", loss_of(target=0), "the network that is being trained"),
    ("td_loss", loss_of(target=0, stop=True), "the network that is being trained"),
    ("td_loss", loss_of(target=0, network=1), "the two networks are exchanged"),
    ("td_loss", loss_of(target=1, network=1), "only the target network is used"),
    ("td_loss", loss_of(target=1, reduce=jnp.sum), "this is the sum"),
    ("td_loss", loss_of(target=1, power=1), "without a square"),
    ("td_loss", loss_of(target=1, reduce=lambda x: x), "one number, such as a mean"),
    ("td_loss", no_gradient, "no gradient reaches the network"),
    ("next_target", lambda t, w, n, i: jnp.where(n % i == 0, t, w), "wrong way around"),
    ("next_target", lambda t, w, n, i: w, "it is never frozen"),
    ("next_target", lambda t, w, n, i: t, "the target never changes"),
    ("next_target", lambda t, w, n, i: w if n == i else t, "by hand one finds"),
    ("next_target", lambda t, w, n, i: t if n % i else w, "jnp.where instead of if"),
    ("ratio", lambda new, old: np.exp(new - old), "Use jnp instead of np"),
    ("epsilon", lambda p, a, b: b * (a / b) ** p, "it grows"),
    ("epsilon", lambda p, a, b: a + (b - a) * p, "decreases linearly"),
    ("epsilon", lambda p, a, b: a * b**p, "does not end at end"),
    ("epsilon", lambda p, a, b: a, "does not depend on progress"),
    ("choose", swapped, "70% of the actions are random"),
    ("choose", lambda q, e, k: right.choose(-q, e, k), "the worst one"),
    ("choose", one_draw, "all environments take the same action"),
    ("choose", lambda q, e, k: right.choose(q, e / 2, k), "the shares of the actions are"),
    ("choose", lambda q, e, k: q.max(axis=1), "must be 0, 1 or 2, not 5"),
    ("loop", lambda *given: np.zeros(4), "never makes a step"),
    ("loop", with_mistake(ends="none"), "break when it terminated or was truncated"),
    ("loop", with_mistake(ends="one"), "an episode that was truncated"),
    ("loop", with_mistake(ends="other"), "an episode that terminated"),
    ("loop", with_mistake(ends="first"), "yours are 4"),
    ("loop", with_mistake(order=0), "did not get the actions"),
    ("loop", with_mistake(obs="old"), "newest observation"),
    ("loop", with_mistake(order=None, first=0), "memory stays empty"),
    ("loop", with_mistake(order=2), "obs becomes next_obs before it is pushed"),
    ("loop", with_mistake(discount="truncated"), "after a truncated episode is 0"),
    ("loop", with_mistake(discount="none"), "a step that terminated is not 0"),
    ("loop", with_mistake(first=99), "learn is never called"),
    ("loop", with_mistake(first=1), "drawn from 1 transitions"),
    ("loop", with_mistake(first=7), "called 6 times"),
    ("loop", with_mistake(total="last"), "the last reward alone"),
    ("loop", with_mistake(total="zero"), "the returns are 0"),
    ("draw_action", lambda m, s, n: m + s * n, "multiplied by log_std"),
    ("draw_action", lambda m, s, n: m + n, "standard deviation is missing"),
    ("draw_action", lambda m, s, n: m, "never explores"),
    ("draw_action", lambda m, s, n: jnp.exp(s) * n, "mean is missing"),
    ("draw_action", lambda m, s, n: m + jnp.exp(s) ** 2 * n, "by the variance"),
    ("draw_action", lambda m, s, n: m - jnp.exp(s) * n, "is subtracted"),
    ("normalized_advantages", lambda r, v: r - v, "returns minus values"),
    ("normalized_advantages", lambda r, v: r - v - (r - v).mean(), "standard deviation is not 1"),
    ("normalized_advantages", lambda r, v: (r - v) / (r - v).std(), "the mean is not 0"),
    ("normalized_advantages", lambda r, v: right.normalized_advantages(v, r), "the sign is reversed"),
    ("normalized_advantages", lambda r, v: right.normalized_advantages(r, 0), "values of the critic are missing"),
    ("normalized_advantages", lambda r, v: (r - v - (r - v).mean()) / (r - v).var(), "by the variance"),
    ("normalized_advantages", lambda r, v: (r - v - (r - v).mean()) / (r - v).std(), "you divide by 0"),
    ("success_rate", lambda r, t: np.sum(r > t), "number of successes"),
    ("success_rate", lambda r, t: np.mean(r >= t), "every episode counts"),
    ("success_rate", lambda r, t: 100 * np.mean(r > t), "in percent"),
    ("success_rate", lambda r, t: np.mean(r < t), "which episodes are above"),
    ("log_prob", lambda m, s, a: -0.5 * z_of(m, s, a) ** 2 - s - 0.5 * LOG_2PI, "one number for each component"),
    ("log_prob", lambda m, s, a: jnp.exp(right.log_prob(m, s, a)), "this is the density"),
    ("log_prob", lambda m, s, a: -right.log_prob(m, s, a), "the sign is reversed"),
    ("log_prob", lambda m, s, a: right.log_prob(m, s, a) / 2, "mean over the components"),
    ("log_prob", lambda m, s, a: right.log_prob(m, s, a) + s.sum(), "the term of the standard deviation"),
    ("log_prob", lambda m, s, a: right.log_prob(m, s, a) + LOG_2PI, "constant with 2 pi"),
    ("log_prob", lambda m, s, a: right.log_prob(m, s, a) - (z_of(m, s, a) ** 2).sum(1) / 2, "factor 1/2"),
    ("log_prob", lambda m, s, a: (-0.5 * ((a - m) / s) ** 2 - s - 0.5 * LOG_2PI).sum(1), "you divide by log_std"),
    ("returns_to_go", lambda r, g: right.returns_to_go(r, 1.0), "gamma has no effect"),
    ("returns_to_go", forwards, "you add the past"),
    ("returns_to_go", lambda r, g: np.cumsum((r * g ** np.arange(4))[::-1])[::-1], "from the beginning"),
    ("returns_to_go", lambda r, g: right.returns_to_go(r, g)[::-1], "in reverse order"),
    ("returns_to_go", lambda r, g: right.returns_to_go(r, g) - r, "the reward of the step itself"),
    ("returns_to_go", changes_its_input, "changes the arrays"),
    ("advantage", lambda r, v, n, d, e, f, g: right.advantage(-r, -v, -n, d, e, f, g), "sign of the TD error"),
    ("advantage", lambda r, v, n, d, e, f, g: right.advantage(r, v, n, d, False, f, g), "next episode's first step"),
    (
        "advantage",
        lambda r, v, n, d, e, f, g: right.advantage(r, v, jnp.where(e, 0, n), d, e, f, g),
        "truncated has no future any more",
    ),
    ("advantage", lambda r, v, n, d, e, f, g: right.advantage(r, v, n, d, e, f, g) + (1 - d) * n, "is not discounted"),
    ("advantage", lambda r, v, n, d, e, f, g: right.advantage(r, n, v, d, e, f, g), "exchanged"),
    (
        "advantage",
        lambda r, v, n, d, e, f, g: r + d * n - v + jnp.where(e, 0, g * f),
        "the advantage of the next step is not discounted",
    ),
    ("advantage", lambda r, v, n, d, e, f, g: right.advantage(r, v, n, d, e, f, 1.0), "where is lambda"),
    ("advantage", lambda r, v, n, d, e, f, g: r + d * n - v, "the TD error alone"),
    ("ratio", lambda new, old: jnp.exp(old - new), "the ratio is inverted"),
    ("ratio", lambda new, old: new - old, "the logarithm of the ratio"),
    ("ratio", lambda new, old: new / old, "you divide the logarithms"),
    ("policy_loss", lambda r, a, c: -right.policy_loss(r, a, c), "the sign is reversed"),
    ("policy_loss", lambda r, a, c: -jnp.mean(jnp.maximum(r * a, clipped(r, c) * a)), "the larger of the two"),
    ("policy_loss", lambda r, a, c: -jnp.mean(r * a), "nothing is clipped"),
    ("policy_loss", lambda r, a, c: -jnp.mean(clipped(r, c) * a), "only the clipped term"),
    ("policy_loss", lambda r, a, c: -jnp.mean(jnp.minimum(r * a, r * clipped(a, c))), "the advantage is clipped"),
    ("policy_loss", lambda r, a, c: -jnp.mean(jnp.minimum(r * a, jnp.clip(r, -c, c) * a)), "around 0"),
    ("policy_loss", lambda r, a, c: -jnp.mean(jnp.minimum(r * a, jnp.minimum(r, 1 + c) * a)), "from above only"),
    ("policy_loss", lambda r, a, c: -jnp.mean(jnp.minimum(r * a, jnp.maximum(r, 1 - c) * a)), "from below only"),
    ("policy_loss", lambda r, a, c: 6 * right.policy_loss(r, a, c), "the sum, not the mean"),
    ("value_loss", lambda v, y: jnp.mean((v - y) ** 2), "have the shape (n, n)"),
    ("value_loss", lambda v, y: -right.value_loss(v, y), "the sign is reversed"),
    ("value_loss", lambda v, y: jnp.mean(v[:, 0] - y), "without a square"),
    ("value_loss", lambda v, y: 3 * right.value_loss(v, y), "the sum, not the mean"),
    ("value_loss", lambda v, y: jnp.log(-right.value_loss(v, y)), "not finite"),
]
