"""Densities against float64 SciPy and against numerical integration."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from rejeu.core.distributions import (
    FORBIDDEN,
    Bernoulli,
    Categorical,
    MultiCategorical,
    Normal,
    TanhNormal,
    log_tanh_slope,
)

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def logistic_form(u: np.ndarray) -> np.ndarray:
    """log(1 - tanh(u)^2) = log(4 e^{2u} / (1 + e^{2u})^2) = log 4 - 2 |u| - 2 log1p(e^{-2 |u|}), in float64."""
    u = np.abs(np.asarray(u, np.float64))
    return np.log(4.0) - 2.0 * u - 2.0 * np.log1p(np.exp(-2.0 * u))


def test_normal_log_prob_equals_scipy():
    rng = np.random.default_rng(0)
    mean, log_std, value = rng.normal(size=(3, 7, 4))
    expected = stats.norm.logpdf(value, mean, np.exp(log_std)).sum(axis=1)
    given = Normal(jnp.float32(mean), jnp.float32(log_std)).log_prob(jnp.float32(value))
    np.testing.assert_allclose(given, expected, rtol=2e-5)


def test_normal_entropy_equals_scipy():
    log_std = np.array([[-1.0, 0.5, 2.0]])
    expected = stats.norm.entropy(0.0, np.exp(log_std)).sum(axis=1)
    np.testing.assert_allclose(Normal(jnp.zeros((1, 3)), jnp.float32(log_std)).entropy(), expected, rtol=1e-6)


def test_tanh_mode_is_the_squashed_mean():
    mean = np.array([[0.3, -4.0]])
    np.testing.assert_allclose(TanhNormal(jnp.float32(mean), jnp.zeros((1, 2))).mode(), np.tanh(mean), rtol=1e-6)


@pytest.mark.parametrize("scale", [0.1, 1.0, 5.0, 20.0, 80.0])
def test_log_slope_of_tanh_is_exact_also_where_it_saturates(scale):
    u = scale * np.linspace(-1.0, 1.0, 41, dtype=np.float32)
    np.testing.assert_allclose(log_tanh_slope(jnp.array(u)), logistic_form(u), rtol=2e-6, atol=2e-7 * max(scale, 1.0))


@pytest.mark.parametrize("mean", [0.0, -1.5, 9.0, -20.0])
def test_tanh_normal_log_prob_equals_float64(mean):
    """The sample's own noise is recovered from the key; 9 and -20 lie where float32 tanh is exactly 1 or -1."""
    key = jax.random.PRNGKey(3)
    means = np.full((6, 2), mean)
    log_std = np.linspace(-3.0, 1.0, 12).reshape(6, 2)
    action, log_prob = TanhNormal(jnp.float32(means), jnp.float32(log_std)).sample_and_log_prob(key)
    noise = np.asarray(jax.random.normal(key, (6, 2), jnp.float32), np.float64)
    u = means + np.exp(log_std) * noise
    expected = (stats.norm.logpdf(noise) - log_std - logistic_form(u)).sum(axis=1)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(action, np.tanh(u), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("u", [20.0, -20.0, 0.0])
def test_log_prob_gradient_is_finite_and_right_where_tanh_saturates(u):
    """d/du log(1 - tanh(u)^2) = -2 tanh(u)."""
    gradient = jax.grad(lambda x: log_tanh_slope(x))(jnp.float32(u))
    assert float(gradient) == pytest.approx(-2.0 * np.tanh(u), abs=1e-6)


@pytest.mark.parametrize("mean", [20.0, -20.0])
def test_gradient_of_a_saturated_sample_is_finite(mean):
    """With std 1 the log-density's derivative by the mean is 2 tanh(u): the Gaussian part does not depend on it."""

    def log_prob(m):
        return jnp.sum(TanhNormal(m, jnp.zeros((1, 1))).sample_and_log_prob(jax.random.PRNGKey(0))[1])

    gradient = jax.grad(log_prob)(jnp.array([[mean]]))
    np.testing.assert_allclose(gradient, [[2.0 * np.sign(mean)]], atol=1e-6)


def test_samples_stay_within_the_bounds_for_extreme_parameters():
    sample = TanhNormal(jnp.array([[50.0, -50.0]]), jnp.array([[2.0, 2.0]])).sample(jax.random.PRNGKey(0))
    assert (np.abs(sample) <= 1.0).all()


@pytest.mark.parametrize("std", [1e-3, 0.4, 7.0])
def test_normal_samples_are_normally_distributed(std):
    n = 20_000
    normal = Normal(jnp.full((n, 1), 1.5, jnp.float32), jnp.full((1, 1), np.log(std), jnp.float32))
    sample = np.asarray(normal.sample(jax.random.PRNGKey(1)), np.float64)[:, 0]
    assert stats.kstest(sample, stats.norm(1.5, std).cdf).pvalue > 0.01


# The density of a squashed action, given the action.

INSIDE = np.tanh(np.linspace(-3.0, 3.0, 13))


def tanh_log_density(action, mean, std):
    """By the change of variables in float64: the density of atanh(a), times d atanh(a) / da = 1 / (1 - a^2)."""
    action = np.float64(action)
    return stats.norm.logpdf(np.arctanh(action), mean, std) - np.log1p(-(action**2))


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (1.0, -0.5), (-2.0, 1.0), (4.0, -2.0)])
def test_the_log_prob_of_a_squashed_action_equals_float64(mean, log_std):
    action = np.stack([INSIDE, INSIDE[::-1]], axis=1).astype(np.float32)
    given = TanhNormal(jnp.full((13, 2), mean), jnp.array([[log_std, 0.3]])).log_prob(jnp.array(action))
    expected = tanh_log_density(action, mean, np.exp([log_std, 0.3])).sum(axis=1)
    np.testing.assert_allclose(given, expected, rtol=1e-4, atol=1e-4)


def test_squashed_samples_follow_their_density():
    n, mean, std = 20_000, 0.7, 0.9
    squashed = TanhNormal(jnp.full((n, 1), mean), jnp.full((1, 1), np.log(std), jnp.float32))
    sample = np.asarray(squashed.sample(jax.random.PRNGKey(2)), np.float64)[:, 0]
    cdf = lambda action: stats.norm.cdf(np.arctanh(np.clip(action, -1 + 1e-9, 1 - 1e-9)), mean, std)  # noqa: E731
    assert stats.kstest(sample, cdf).pvalue > 0.01


@pytest.mark.parametrize("action", [1.0, -1.0, 0.999999, -0.999999])
def test_the_log_prob_at_the_edge_is_that_near_it_with_finite_gradients(action):
    """At the edge itself the density has no value; 1 - 1e-6 in float32 is what is taken in its place."""
    near = np.sign(action) * np.float64(np.float32(1.0 - 1e-6))
    log_prob = lambda mean: TanhNormal(mean, jnp.zeros((1, 1))).log_prob(jnp.array([[action]]))[0]  # noqa: E731
    value, gradient = jax.value_and_grad(log_prob)(jnp.array([[0.5]]))
    assert float(value) == pytest.approx(tanh_log_density(near, 0.5, 1.0), rel=1e-4)
    assert float(gradient[0, 0]) == pytest.approx(np.arctanh(near) - 0.5, rel=1e-4)  # (u - mean) / std^2


# One choice.

LOGITS = np.random.default_rng(0).normal(scale=2.0, size=(6, 5))
PROBABILITIES = np.exp(LOGITS) / np.exp(LOGITS).sum(axis=1, keepdims=True)


def test_a_choice_may_have_several_leading_axes_or_none():
    choice = np.arange(6, dtype=np.int32).reshape(2, 3) % 5
    expected = np.log(PROBABILITIES[np.arange(6), choice.ravel()]).reshape(2, 3)
    deep = Categorical(jnp.float32(LOGITS.reshape(2, 3, 5)))
    np.testing.assert_allclose(deep.log_prob(jnp.array(choice)), expected, rtol=1e-5)
    assert deep.entropy().shape == deep.mode().shape == deep.sample(jax.random.PRNGKey(0)).shape == (2, 3)
    flat = Categorical(jnp.float32(LOGITS[4])).log_prob(jnp.int32(4))
    assert float(flat) == pytest.approx(expected[1, 1], rel=1e-5)


def test_the_mode_of_a_choice_is_the_likeliest_and_the_first_of_equals():
    np.testing.assert_array_equal(Categorical(jnp.float32(LOGITS)).mode(), PROBABILITIES.argmax(axis=1))
    assert int(Categorical(jnp.array([[0.0, 2.0, 2.0]])).mode()[0]) == 1


def chi_square(counts, probabilities):
    """How likely counts at least so far from what was expected are, if they follow the probabilities."""
    expected = np.float64(probabilities).ravel() / np.sum(probabilities) * counts.sum()
    return stats.chisquare(counts.ravel(), expected).pvalue


def test_sampled_choices_have_their_probabilities():
    n = 50_000
    sample = Categorical(jnp.broadcast_to(jnp.float32(LOGITS[0]), (n, 5))).sample(jax.random.PRNGKey(3))
    assert sample.dtype == jnp.int32
    assert chi_square(np.bincount(sample, minlength=5), PROBABILITIES[0]) > 0.01


# Several choices.

SIZES = (3, 2, 3)
PARTS = [np.random.default_rng(i).normal(scale=1.5, size=(6, size)) for i, size in enumerate(SIZES)]
COMBINATIONS = np.array(list(itertools.product(*map(range, SIZES))), np.int32)


def joint_probabilities():
    """Of every combination of the independent choices, ``(6, 18)``."""
    one, two, three = (special.softmax(part, axis=1) for part in PARTS)
    return np.einsum("bi,bj,bk->bijk", one, two, three).reshape(6, -1)


def several(rows=slice(None)):
    return MultiCategorical(tuple(Categorical(jnp.float32(part[rows])) for part in PARTS))


def test_log_probs_of_several_choices_are_those_of_the_joint_distribution():
    given = np.array([several().log_prob(jnp.tile(one, (6, 1))) for one in COMBINATIONS]).T
    np.testing.assert_allclose(given, np.log(joint_probabilities()), rtol=1e-5)


def test_entropy_and_mode_of_several_choices_are_those_of_the_joint_distribution():
    np.testing.assert_allclose(several().entropy(), stats.entropy(joint_probabilities(), axis=1), rtol=1e-5)
    np.testing.assert_array_equal(several().mode(), COMBINATIONS[joint_probabilities().argmax(axis=1)])


def test_several_sampled_choices_have_their_joint_probabilities():
    """A key that two choices of one size share would make them go together."""
    n = 50_000
    parts = tuple(Categorical(jnp.broadcast_to(jnp.float32(part[0]), (n, part.shape[1]))) for part in PARTS)
    sample = np.asarray(MultiCategorical(parts).sample(jax.random.PRNGKey(4)))
    assert (sample.shape, sample.dtype) == ((n, 3), np.int32)
    counts = np.bincount(np.ravel_multi_index(tuple(sample.T), SIZES), minlength=len(COMBINATIONS))
    assert chi_square(counts, joint_probabilities()[0]) > 0.01


# Bits.

BITS = np.array(list(itertools.product((0, 1), repeat=3)), np.int32)
ODDS = np.random.default_rng(5).normal(scale=2.0, size=(6, 3))


def probabilities_of_bits():
    """Of every row of ``BITS``, ``(6, 8)``."""
    one = special.expit(ODDS)[:, None]
    return np.prod(np.where(BITS[None] == 1, one, 1.0 - one), axis=2)


def test_log_probs_of_bits_are_those_of_the_joint_distribution():
    bernoulli = Bernoulli(jnp.float32(ODDS))
    given = np.array([bernoulli.log_prob(jnp.tile(bits, (6, 1))) for bits in BITS]).T
    np.testing.assert_allclose(given, np.log(probabilities_of_bits()), rtol=1e-5)
    expected = stats.bernoulli.logpmf(BITS[5], special.expit(ODDS)).sum(axis=1)
    np.testing.assert_allclose(bernoulli.log_prob(jnp.tile(BITS[5], (6, 1))), expected, rtol=1e-5)


def test_entropy_and_mode_of_bits_are_those_of_the_joint_distribution():
    bernoulli = Bernoulli(jnp.float32(ODDS))
    np.testing.assert_allclose(bernoulli.entropy(), stats.entropy(probabilities_of_bits(), axis=1), rtol=1e-5)
    np.testing.assert_array_equal(bernoulli.mode(), BITS[probabilities_of_bits().argmax(axis=1)])


def test_sampled_bits_have_their_joint_probabilities():
    n = 50_000
    sample = Bernoulli(jnp.broadcast_to(jnp.float32(ODDS[0]), (n, 3))).sample(jax.random.PRNGKey(6))
    assert (sample.shape, sample.dtype) == ((n, 3), jnp.int32)
    counts = np.bincount(np.asarray(sample) @ [4, 2, 1], minlength=8)
    assert chi_square(counts, probabilities_of_bits()[0]) > 0.01


# Forbidden choices, and logits far from 0.

ALLOWED = np.array([True, False, True, True, False])


def test_forbidden_choices_leave_a_softmax_over_the_allowed_ones():
    categorical = Categorical(jnp.where(ALLOWED, jnp.float32(LOGITS), jnp.float32(FORBIDDEN)))
    expected = special.softmax(LOGITS[:, ALLOWED], axis=1)
    for i, choice in enumerate(np.flatnonzero(ALLOWED)):
        given = categorical.log_prob(jnp.full(6, choice, jnp.int32))
        np.testing.assert_allclose(given, np.log(expected[:, i]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(categorical.entropy(), stats.entropy(expected, axis=1), rtol=1e-5)
    assert ALLOWED[categorical.mode()].all()
    forbidden = categorical.log_prob(jnp.full(6, 1, jnp.int32))
    assert np.isfinite(forbidden).all()
    assert (np.exp(forbidden) == 0.0).all()


def test_gradients_past_a_mask_are_those_over_the_allowed_choices():
    """d log p_a / d z = [a] - p and d H / d z = -p (log p + H) for the allowed logits z, and 0 for the others."""
    masked = lambda logits: Categorical(jnp.where(ALLOWED, logits, jnp.float32(FORBIDDEN)))  # noqa: E731
    logits = jnp.float32(LOGITS[2])
    p = special.softmax(LOGITS[2, ALLOWED])
    by_log_prob = jax.grad(lambda z: masked(z).log_prob(jnp.int32(2)))(logits)
    np.testing.assert_allclose(by_log_prob[ALLOWED], [0.0, 1.0, 0.0] - p, atol=1e-6)
    by_entropy = jax.grad(lambda z: masked(z).entropy())(logits)
    np.testing.assert_allclose(by_entropy[ALLOWED], -p * (np.log(p) + stats.entropy(p)), atol=1e-6)
    assert (by_log_prob[~ALLOWED] == 0.0).all()
    assert (by_entropy[~ALLOWED] == 0.0).all()


def test_the_only_allowed_choice_is_certain_with_finite_gradients():
    only = np.array([False, False, True])
    masked = lambda logits: Categorical(jnp.where(only, logits, jnp.float32(FORBIDDEN)))  # noqa: E731
    logits = jnp.array([3.0, -1.0, 0.5])
    assert float(masked(logits).log_prob(jnp.int32(2))) == float(masked(logits).entropy()) == 0.0
    assert int(masked(logits).mode()) == int(masked(logits).sample(jax.random.PRNGKey(0))) == 2
    for of in (lambda z: masked(z).entropy(), lambda z: masked(z).log_prob(jnp.int32(2))):
        np.testing.assert_array_equal(jax.grad(of)(logits), np.zeros(3))


def test_a_forbidden_bit_is_never_1_and_leaves_the_others_as_they_are():
    n, allowed = 20_000, np.array([True, False, True])
    masked = lambda odds: Bernoulli(jnp.where(allowed, odds, jnp.float32(FORBIDDEN)))  # noqa: E731
    sample = np.asarray(masked(jnp.broadcast_to(jnp.float32(ODDS[0]), (n, 3))).sample(jax.random.PRNGKey(8)))
    one, p = special.expit(ODDS[0]), special.expit(ODDS[0][allowed])
    assert (sample[:, 1] == 0).all()
    assert stats.binomtest(int(sample[:, 2].sum()), n, one[2]).pvalue > 0.01
    logits = jnp.float32(ODDS[0])
    expected = stats.bernoulli.logpmf([1, 0], p).sum()
    assert float(masked(logits).log_prob(jnp.array([1, 0, 0]))) == pytest.approx(expected, rel=1e-5)
    assert float(masked(logits).entropy()) == pytest.approx(stats.bernoulli.entropy(p).sum(), rel=1e-5)
    assert np.isfinite(masked(logits).log_prob(jnp.array([1, 1, 0])))
    by_entropy = jax.grad(lambda z: masked(z).entropy())(logits)
    by_log_prob = jax.grad(lambda z: masked(z).log_prob(jnp.array([1, 0, 0])))(logits)
    np.testing.assert_allclose(by_entropy[allowed], -ODDS[0][allowed] * p * (1.0 - p), atol=1e-6)  # dH/dz = -z p (1-p)
    np.testing.assert_allclose(by_log_prob[allowed], [1.0, 0.0] - p, atol=1e-6)
    assert by_entropy[1] == by_log_prob[1] == 0.0


def test_a_forbidden_possibility_of_one_choice_leaves_the_other_choices_alone():
    mask = np.array([False, True, True])
    parts = (Categorical(jnp.where(mask, jnp.float32(PARTS[0]), jnp.float32(FORBIDDEN))), *several().parts[1:])
    masked = MultiCategorical(parts)
    first = special.softmax(PARTS[0][:, mask], axis=1)
    rest = [special.softmax(part, axis=1) for part in PARTS[1:]]
    expected = sum(stats.entropy(p, axis=1) for p in (first, *rest))
    np.testing.assert_allclose(masked.entropy(), expected, rtol=1e-5)
    given = masked.log_prob(jnp.tile(np.array([2, 1, 2], np.int32), (6, 1)))
    np.testing.assert_allclose(given, np.log(first[:, 1] * rest[0][:, 1] * rest[1][:, 2]), rtol=1e-5)


@pytest.mark.parametrize("scale", [1e4, 1e8])
def test_logits_far_from_0_give_what_the_limit_gives(scale):
    """The likeliest choice is certain, and a logit that lies d below it has the log-probability -d."""
    categorical = Categorical(jnp.array([[scale, -scale, 0.0]], jnp.float32))
    given = [float(categorical.log_prob(jnp.array([choice]))[0]) for choice in range(3)]
    assert given == pytest.approx([0.0, -2.0 * scale, -scale])
    assert float(categorical.entropy()[0]) == 0.0
    bernoulli = Bernoulli(jnp.array([[scale, -scale]], jnp.float32))
    of_bits = [float(bernoulli.log_prob(jnp.array([bits]))[0]) for bits in ([1, 0], [0, 0], [0, 1])]
    assert of_bits == pytest.approx([0.0, -scale, -2.0 * scale])
    assert float(bernoulli.entropy()[0]) == 0.0
    np.testing.assert_array_equal(bernoulli.sample(jax.random.PRNGKey(0)), [[1, 0]])
    for kind, value in ((Categorical, jnp.array([1])), (Bernoulli, jnp.array([[0, 1, 1]]))):
        logits = jnp.array([[scale, -scale, 0.0]], jnp.float32)
        assert np.isfinite(jax.grad(lambda z, kind=kind: jnp.sum(kind(z).entropy()))(logits)).all()
        gradient = jax.grad(lambda z, kind=kind, value=value: jnp.sum(kind(z).log_prob(value)))(logits)
        assert np.isfinite(gradient).all()
        assert np.abs(gradient).max() == 1.0


KL_PAIRS = {
    "normal": lambda rng: [Normal(*jnp.float32(rng.normal(size=(2, 3)) * 0.5)) for _ in range(2)],
    "squashed": lambda rng: [TanhNormal(*jnp.float32(rng.normal(size=(2, 3)) * 0.5)) for _ in range(2)],
    "choice": lambda rng: [Categorical(jnp.float32(rng.normal(size=4))) for _ in range(2)],
    "choices": lambda rng: [
        MultiCategorical(tuple(Categorical(jnp.float32(rng.normal(size=n))) for n in (2, 3))) for _ in range(2)
    ],
    "bits": lambda rng: [Bernoulli(jnp.float32(rng.normal(size=3))) for _ in range(2)],
}


@pytest.mark.parametrize("name", KL_PAIRS)
def test_the_kl_divergence_is_the_mean_log_ratio_of_samples(name):
    one, two = KL_PAIRS[name](np.random.default_rng(0))
    keys = jax.random.split(jax.random.key(0), 100_000)
    drawn = jax.vmap(one.sample)(keys)
    ratio = np.asarray(jax.vmap(lambda x: one.log_prob(x) - two.log_prob(x))(drawn), np.float64)
    deviation = ratio.std() / np.sqrt(len(ratio))
    assert float(one.kl_divergence(two)) == pytest.approx(ratio.mean(), abs=4 * deviation)
    assert float(one.kl_divergence(one)) == pytest.approx(0.0, abs=1e-6)
