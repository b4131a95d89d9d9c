"""Normalized layers and projected weights against float64 NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.networks.batch_renorm import BatchRenorm, in_training
from rejeu.networks.layers import RMSNorm
from rejeu.networks.projected import InvertedResidual, NormalizedMLP, UnitLinear, head, projected

N_INPUTS, BATCH = 3, 7


def numpy_norm(norm, x, train):
    mean, variance = (x.mean(axis=0), x.var(axis=0)) if train else (np.float64(norm.mean), np.float64(norm.variance))
    return np.float64(norm.scale) * (x - mean) / np.sqrt(variance + norm.epsilon) + np.float64(norm.offset)


def linear(layer, x):
    return x @ np.float64(layer.weight)


def relu(x):
    return np.maximum(x, 0.0)


def numpy_torso(torso, x, train):
    """The hidden layers of XQC (BN, then linear, BN, relu) or of FlashSAC (BN, linear, blocks, RMS norm)."""
    x = np.float64(x)
    if isinstance(torso, NormalizedMLP):
        x = numpy_norm(torso.norms[0], x, train)
        for layer, norm in zip(torso.layers, torso.norms[1:], strict=True):
            x = relu(numpy_norm(norm, linear(layer, x), train))
        return x
    x = linear(torso.embedding, numpy_norm(torso.norm, x, train))
    for block in torso.blocks:
        inner = relu(numpy_norm(block.inner, linear(block.expand, x), train))
        x = x + relu(numpy_norm(block.outer, linear(block.contract, inner), train))
    return x / np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-6) * np.float64(torso.last.scale)


def norms_of(torso):
    found = jax.tree.leaves(torso, is_leaf=lambda node: isinstance(node, BatchRenorm))
    return [node for node in found if isinstance(node, BatchRenorm)]


def torso_of(kind, seed=0):
    return kind(jax.random.PRNGKey(seed), N_INPUTS, (4, 4), "relu")


def moved(tree, seed):
    """The same with every learned number moved, as by an optimizer."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: x + jnp.asarray(rng.normal(size=x.shape), jnp.float32), tree)


def batch(seed):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(BATCH, N_INPUTS)) * [1, 5, 0.1] + 2, jnp.float32)


@pytest.mark.parametrize("kind", [NormalizedMLP, InvertedResidual])
def test_training_and_use_equal_numpy_and_training_moves_the_statistics_by_a_hundredth(kind):
    torso = torso_of(kind)
    scaled = [eqx.tree_at(lambda n: (n.scale, n.offset), n, (n.scale * 1.5, n.offset - 0.2)) for n in norms_of(torso)]
    places = jax.tree.structure(torso, is_leaf=lambda node: isinstance(node, BatchRenorm))
    leaves = iter(scaled)
    given = jax.tree.leaves(torso, is_leaf=lambda node: isinstance(node, BatchRenorm))
    torso = jax.tree.unflatten(places, [next(leaves) if isinstance(node, BatchRenorm) else node for node in given])
    for seed in range(3):
        x = batch(seed)
        y, after = in_training(torso, lambda torso: torso(x))  # noqa: B023
        np.testing.assert_allclose(y, numpy_torso(torso, x, train=True), atol=2e-4)
        first = norms_of(torso)[0], norms_of(after)[0]
        np.testing.assert_allclose(first[1].mean, 0.99 * first[0].mean + 0.01 * np.mean(x, axis=0), atol=1e-6)
        assert [float(norm.n_batches) for norm in norms_of(after)] == [seed + 1.0] * len(scaled)
        torso = after
    np.testing.assert_allclose(torso(batch(9)), numpy_torso(torso, batch(9), train=False), atol=2e-4)
    assert torso.n_outputs == torso(batch(9)).shape[1] == 4


@pytest.mark.parametrize(("kind", "gains"), [(NormalizedMLP, False), (InvertedResidual, True)])
def test_projection_scales_units_to_norm_1_and_gains_of_flashsac_to_the_root_of_their_number(kind, gains):
    network = (torso_of(kind), head(jax.random.PRNGKey(1), 4, 6))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), moved(network, 1), moved(network, 2))
    after = projected(stacked)
    is_layer = lambda node: isinstance(node, UnitLinear | RMSNorm | BatchRenorm)  # noqa: E731
    pairs = zip(jax.tree.leaves(stacked, is_leaf=is_layer), jax.tree.leaves(after, is_leaf=is_layer), strict=True)
    for old, new in pairs:
        if isinstance(old, UnitLinear):
            norms = np.linalg.norm(np.float64(old.weight), axis=1, keepdims=True)
            np.testing.assert_allclose(new.weight, np.float64(old.weight) / norms, atol=1e-5)
            assert old.bias is None or (old.bias == new.bias).all()
            continue
        old_gains, new_gains = (
            np.concatenate([n.scale, n.offset] if isinstance(n, BatchRenorm) else [n.scale], axis=-1).astype(float)
            for n in (old, new)
        )
        size = np.linalg.norm(old_gains, axis=-1, keepdims=True) / np.sqrt(old.scale.shape[-1])
        np.testing.assert_allclose(new_gains, old_gains / size if gains else old_gains, atol=1e-5)


def test_units_begin_orthogonal_with_norm_1():
    weight = np.float64(UnitLinear(jax.random.PRNGKey(0), 6, 4).weight)
    np.testing.assert_allclose(weight.T @ weight, np.eye(4), atol=1e-5)
    wide = np.float64(UnitLinear(jax.random.PRNGKey(0), 3, 9).weight)
    np.testing.assert_allclose(np.linalg.norm(wide, axis=0), 1.0, atol=1e-5)


def test_rms_norm_equals_its_formula():
    x = np.random.default_rng(0).normal(size=(4, 5))
    norm = eqx.tree_at(lambda n: n.scale, RMSNorm(5), jnp.arange(1.0, 6.0))
    expected = x / np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-6) * np.arange(1.0, 6.0)
    np.testing.assert_allclose(norm(jnp.asarray(x, jnp.float32)), expected, atol=1e-5)


def test_weights_of_several_networks_are_drawn_one_after_another() -> None:
    """Batches of QR decompositions hung where XLA had fewer threads than a program had batches."""
    draw = jax.jit(jax.vmap(lambda key: UnitLinear(key, 4, 4).weight))
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    factorizations = [line for line in draw.lower(keys).as_text().splitlines() if "geqrf" in line]
    assert factorizations
    assert all("tensor<4x4xf32>" in line and "tensor<3x4x4xf32>" not in line for line in factorizations)
    one_by_one = np.stack([UnitLinear(key, 4, 4).weight for key in keys])
    np.testing.assert_allclose(draw(keys), one_by_one, atol=1e-6)
