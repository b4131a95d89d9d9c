"""The checks of course 1 accept right answers, and name the mistake in typical wrong ones, in both languages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.courses import checks
from rejeu.courses.checks import dqn_ppo as check


@pytest.fixture(autouse=True)
def notebook():
    """Sets what a notebook has: a language, and JAX's own rule for broadcasting."""
    checks.speak("en")
    with jax.numpy_rank_promotion("allow"):
        yield


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


class Silent(ReplayMemory):
    def sample(self, batch_size, rng): ...


def discounts(terminated, truncated, gamma):
    return gamma * (1.0 - terminated)


def td_targets(reward, discount, next_q):
    return reward + discount * next_q.max(axis=1)


def td_errors(q, action, target):
    return target - jnp.take_along_axis(q, action[:, None], axis=1)[:, 0]


def td_loss(network, target_network, batch):
    target = td_targets(batch.reward, batch.discount, target_network(batch.next_obs))
    return jnp.mean(td_errors(network(batch.obs), batch.action, target) ** 2)


def next_target(target, weight, n_updates, interval):
    return jnp.where(n_updates % interval == 0, weight, target)


def epsilon(progress, start, end):
    return start * (end / start) ** progress


def choose(q, epsilon, key):
    whether, which = jax.random.split(key)
    random = jax.random.randint(which, (len(q),), 0, q.shape[1])
    return jnp.where(jax.random.uniform(whether, (len(q),)) < epsilon, random, q.argmax(axis=1))


def success_rate(returns, threshold):
    return np.mean(returns > threshold)


def log_prob(mean, log_std, action):
    z = (action - mean) / jnp.exp(log_std)
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi), axis=1)


def returns_to_go(rewards, gamma):
    result, following = np.zeros(len(rewards)), 0.0
    for t in reversed(range(len(rewards))):
        result[t] = following = rewards[t] + gamma * following
    return result


def advantage(reward, value, next_value, discount, ended, following, gae_lambda):
    return reward + discount * next_value - value + jnp.where(ended, 0.0, discount * gae_lambda * following)


def ratio(new, old):
    return jnp.exp(new - old)


def policy_loss(ratio, advantage, clip):
    return -jnp.mean(jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage))


def value_loss(value, target):
    return jnp.mean((value[:, 0] - target) ** 2)


RIGHT = [
    ReplayMemory, discounts, td_targets, td_errors, td_loss, next_target, epsilon, choose, success_rate, log_prob,
    returns_to_go, advantage, ratio, policy_loss, value_loss,
]  # fmt: skip


def test_a_memory_may_sample_without_replacement():
    assert check.replay_memory(WithoutReplacement)


def check_of(answer):
    return check.replay_memory if answer is ReplayMemory else getattr(check, answer.__name__)


@pytest.mark.parametrize("answer", RIGHT, ids=lambda answer: answer.__name__)
def test_a_right_answer_passes(answer, capsys):
    assert check_of(answer)(answer)
    assert capsys.readouterr().out.startswith("OK - ")


@pytest.mark.parametrize("answer", RIGHT, ids=lambda answer: answer.__name__)
@pytest.mark.parametrize("language", ["en", "fr"])
def test_unfilled_exercises_and_errors_give_one_line(answer, language, capsys):
    checks.speak(language)

    def unfilled(*_):
        return None

    def broken(*_):
        return undefined_name + 1  # noqa: F821

    for wrong in (unfilled, broken, ..., 3):
        assert not check_of(answer)(wrong)
        out = capsys.readouterr().out
        assert len(out.splitlines()) == 1
        assert out.startswith({"en": "Not yet - ", "fr": "Pas encore - "}[language])
    check_of(answer)(broken)
    out = capsys.readouterr().out
    assert "NameError: name 'undefined_name' is not defined" in out
    assert "return undefined_name + 1" in out


def one_draw(q, epsilon, key):
    whether, which = jax.random.split(key)
    random = jax.random.randint(which, (), 0, q.shape[1])
    return jnp.where(jax.random.uniform(whether) < epsilon, random, q.argmax(axis=1))


def swapped(q, epsilon, key):
    return choose(q, 1 - epsilon, key)


def loss_of(target=0, network=0, stop=False, reduce=jnp.mean, power=2):
    """Returns td_loss with the networks of targets and predictions chosen by their position."""

    def loss(*given):
        networks, batch = given[:2], given[2]
        values = networks[target](batch.next_obs)
        y = td_targets(batch.reward, batch.discount, jax.lax.stop_gradient(values) if stop else values)
        return reduce(td_errors(networks[network](batch.obs), batch.action, y) ** power)

    return loss


def no_gradient(*given):
    return jax.lax.stop_gradient(td_loss(*given))


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
    (check.replay_memory, Growing, "IndexError"),
    (check.replay_memory, KeepsOldest, "the newest transitions are missing"),
    (check.replay_memory, OverwritesOthers, "sample returns the transitions [1, 4, 5, 6]"),
    (check.replay_memory, Ignores, "the newest transitions are missing"),
    (check.replay_memory, WritesNothing, "Does push write"),
    (check.replay_memory, CountsAll, "len is 6, but 4"),
    (check.replay_memory, FromAnywhere, "a row that was never filled"),
    (check.replay_memory, Mixed, "belong to different transitions"),
    (check.replay_memory, Latest, "60 batches were all the same"),
    (check.replay_memory, Silent, "returns None"),
    (check.discounts, lambda te, tr, g: g * (1.0 - (te | tr)), "truncated episode is treated as a terminated one"),
    (check.discounts, lambda te, tr, g: g * np.ones(4), "a terminated step still has a future"),
    (check.discounts, lambda te, tr, g: g * te, "wrong way around"),
    (check.discounts, lambda te, tr, g: g * (1.0 - tr), "truncation ends the future"),
    (check.discounts, lambda te, tr, g: 1.0 - te, "where is gamma"),
    (check.discounts, lambda te, tr, g: g * (1.0 - te[0]), "the shape is ()"),
    (check.td_targets, lambda r, d, q: r + q.max(axis=1), "the discount is missing"),
    (check.td_targets, lambda r, d, q: r + d * q.min(axis=1), "worst action"),
    (check.td_targets, lambda r, d, q: r + d * q.mean(axis=1), "random policy"),
    (check.td_targets, lambda r, d, q: r + d * q.argmax(axis=1), "argmax gives the number"),
    (check.td_targets, lambda r, d, q: r + d * q.max(), "over the whole batch"),
    (check.td_targets, lambda r, d, q: d * (r + q.max(axis=1)), "the reward is discounted as well"),
    (check.td_targets, lambda r, d, q: r - d * q.max(axis=1), "sign of the future"),
    (check.td_targets, lambda r, d, q: r + d * q.max(axis=1, keepdims=True), "the shape is (3, 3), expected (3,)"),
    (check.td_targets, lambda r, d, q: r + 0.99 * d * q.max(axis=1), "by hand one finds"),
    (check.td_errors, lambda q, a, y: td_errors(q, a, y) * -1, "the sign is reversed"),
    (check.td_errors, lambda q, a, y: y - q.max(axis=1), "compare with the best action"),
    (check.td_errors, lambda q, a, y: y - q[:, 0], "first action's value"),
    (check.td_errors, lambda q, a, y: y - q[:, a], "the shape is (3, 3)"),
    (check.td_errors, lambda q, a, y: td_errors(q, a, y) ** 2, "squared already"),
    (check.td_errors, lambda q, a, y: abs(td_errors(q, a, y)), "absolute value"),
    (check.td_loss, loss_of(target=0), "the network that is being trained"),
    (check.td_loss, loss_of(target=0, stop=True), "the network that is being trained"),
    (check.td_loss, loss_of(target=0, network=1), "the two networks are exchanged"),
    (check.td_loss, loss_of(target=1, network=1), "only the target network is used"),
    (check.td_loss, loss_of(target=1, reduce=jnp.sum), "this is the sum"),
    (check.td_loss, loss_of(target=1, power=1), "without a square"),
    (check.td_loss, loss_of(target=1, reduce=lambda x: x), "one number, such as a mean"),
    (check.td_loss, no_gradient, "no gradient reaches the network"),
    (check.next_target, lambda t, w, n, i: jnp.where(n % i == 0, t, w), "wrong way around"),
    (check.next_target, lambda t, w, n, i: w, "it is never frozen"),
    (check.next_target, lambda t, w, n, i: t, "the target never changes"),
    (check.next_target, lambda t, w, n, i: w if n == i else t, "by hand one finds"),
    (check.next_target, lambda t, w, n, i: t if n % i else w, "jnp.where instead of if"),
    (check.ratio, lambda new, old: np.exp(new - old), "Use jnp instead of np"),
    (check.epsilon, lambda p, a, b: b * (a / b) ** p, "it grows"),
    (check.epsilon, lambda p, a, b: a + (b - a) * p, "decreases linearly"),
    (check.epsilon, lambda p, a, b: a * b**p, "does not end at end"),
    (check.epsilon, lambda p, a, b: a, "does not depend on progress"),
    (check.choose, swapped, "70% of the actions are random"),
    (check.choose, lambda q, e, k: choose(-q, e, k), "the worst one"),
    (check.choose, one_draw, "all environments take the same action"),
    (check.choose, lambda q, e, k: choose(q, e / 2, k), "the shares of the actions are"),
    (check.choose, lambda q, e, k: q.max(axis=1), "must be 0, 1 or 2, not 5"),
    (check.success_rate, lambda r, t: np.sum(r > t), "number of successes"),
    (check.success_rate, lambda r, t: np.mean(r >= t), "every episode counts"),
    (check.success_rate, lambda r, t: 100 * np.mean(r > t), "in percent"),
    (check.success_rate, lambda r, t: np.mean(r < t), "which episodes are above"),
    (check.log_prob, lambda m, s, a: -0.5 * z_of(m, s, a) ** 2 - s - 0.5 * LOG_2PI, "one number for each component"),
    (check.log_prob, lambda m, s, a: jnp.exp(log_prob(m, s, a)), "this is the density"),
    (check.log_prob, lambda m, s, a: -log_prob(m, s, a), "the sign is reversed"),
    (check.log_prob, lambda m, s, a: log_prob(m, s, a) / 2, "mean over the components"),
    (check.log_prob, lambda m, s, a: log_prob(m, s, a) + s.sum(), "the term of the standard deviation"),
    (check.log_prob, lambda m, s, a: log_prob(m, s, a) + LOG_2PI, "constant with 2 pi"),
    (check.log_prob, lambda m, s, a: log_prob(m, s, a) - (z_of(m, s, a) ** 2).sum(1) / 2, "factor 1/2"),
    (
        check.log_prob,
        lambda m, s, a: (-0.5 * ((a - m) / s) ** 2 - s - 0.5 * LOG_2PI).sum(1),
        "you divide by log_std",
    ),
    (check.returns_to_go, lambda r, g: returns_to_go(r, 1.0), "gamma has no effect"),
    (check.returns_to_go, forwards, "you add the past"),
    (check.returns_to_go, lambda r, g: np.cumsum((r * g ** np.arange(4))[::-1])[::-1], "from the beginning"),
    (check.returns_to_go, lambda r, g: returns_to_go(r, g)[::-1], "in reverse order"),
    (check.returns_to_go, lambda r, g: returns_to_go(r, g) - r, "the reward of the step itself"),
    (check.returns_to_go, changes_its_input, "changes the arrays"),
    (check.advantage, lambda r, v, n, d, e, f, g: advantage(-r, -v, -n, d, e, f, g), "sign of the TD error"),
    (check.advantage, lambda r, v, n, d, e, f, g: advantage(r, v, n, d, False, f, g), "next episode's first step"),
    (
        check.advantage,
        lambda r, v, n, d, e, f, g: advantage(r, v, jnp.where(e, 0, n), d, e, f, g),
        "truncated has no future any more",
    ),
    (check.advantage, lambda r, v, n, d, e, f, g: advantage(r, v, n, d, e, f, g) + (1 - d) * n, "is not discounted"),
    (check.advantage, lambda r, v, n, d, e, f, g: advantage(r, n, v, d, e, f, g), "exchanged"),
    (
        check.advantage,
        lambda r, v, n, d, e, f, g: r + d * n - v + jnp.where(e, 0, g * f),
        "the advantage of the next step is not discounted",
    ),
    (check.advantage, lambda r, v, n, d, e, f, g: advantage(r, v, n, d, e, f, 1.0), "where is lambda"),
    (check.advantage, lambda r, v, n, d, e, f, g: r + d * n - v, "the TD error alone"),
    (check.ratio, lambda new, old: jnp.exp(old - new), "the ratio is inverted"),
    (check.ratio, lambda new, old: new - old, "the logarithm of the ratio"),
    (check.ratio, lambda new, old: new / old, "you divide the logarithms"),
    (check.policy_loss, lambda r, a, c: -policy_loss(r, a, c), "the sign is reversed"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(jnp.maximum(r * a, clipped(r, c) * a)), "the larger of the two"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(r * a), "nothing is clipped"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(clipped(r, c) * a), "only the clipped term"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(jnp.minimum(r * a, r * clipped(a, c))), "the advantage is clipped"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(jnp.minimum(r * a, jnp.clip(r, -c, c) * a)), "around 0"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(jnp.minimum(r * a, jnp.minimum(r, 1 + c) * a)), "from above only"),
    (check.policy_loss, lambda r, a, c: -jnp.mean(jnp.minimum(r * a, jnp.maximum(r, 1 - c) * a)), "from below only"),
    (check.policy_loss, lambda r, a, c: 6 * policy_loss(r, a, c), "the sum, not the mean"),
    (check.value_loss, lambda v, y: jnp.mean((v - y) ** 2), "have the shape (n, n)"),
    (check.value_loss, lambda v, y: -value_loss(v, y), "the sign is reversed"),
    (check.value_loss, lambda v, y: jnp.mean(v[:, 0] - y), "without a square"),
    (check.value_loss, lambda v, y: 3 * value_loss(v, y), "the sum, not the mean"),
    (check.value_loss, lambda v, y: jnp.log(-value_loss(v, y)), "not finite"),
]


@pytest.mark.parametrize(("test", "wrong", "message"), WRONG, ids=[f"{c.__name__}-{m}" for c, _, m in WRONG])
def test_a_typical_mistake_is_named(test, wrong, message, capsys):
    assert not test(wrong)
    english = capsys.readouterr().out
    assert message in english
    checks.speak("fr")
    assert not test(wrong)
    french = capsys.readouterr().out
    assert french.startswith("Pas encore - ")
    assert len(english.splitlines()) == len(french.splitlines()) == 1


def test_a_training_that_lacks_an_answer_stops_with_one_line():
    check.ratio(lambda new, old: new - old)
    check.epsilon(epsilon)
    checks.require("epsilon")
    with pytest.raises(Exception, match="needs your ratio, choose") as raised:
        checks.require("epsilon", "ratio", "choose")
    assert raised.value._render_traceback_() == [str(raised.value)]


def test_a_wrong_answer_after_a_right_one_counts():
    check.ratio(ratio)
    check.ratio(None)
    with pytest.raises(Exception, match="needs your ratio"):
        checks.require("ratio")
