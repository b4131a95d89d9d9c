"""Networks against the same computation written once more in NumPy, in double precision."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from scipy import stats

import rejeu
from rejeu.algorithms import config as configs, sac
from rejeu.core import validation
from rejeu.core.algorithm import ensemble
from rejeu.core.errors import CheckpointError
from rejeu.core.spaces import leaves
from rejeu.lab import cli
from rejeu.networks import (
    ENCODERS,
    Convolution,
    Encoder,
    Linear,
    MemoryConfig,
    Network,
    PolicyConfig,
    QNetwork,
    action_values,
    convolutions,
    encoder,
)
from rejeu.networks.encoder import CNN, NATURE, SMALL, channels_last, image_shape
from tests.tiers import only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

DOCUMENT = {
    "action_layers": (16, 32),
    "state_layers": (17, 33),
    "common_layers": (60, 70),
    "critic_layers": (12,),
    "actor_layers": (24,),
}
"""The example of branches in ``../shared/seeds/002_c02ee75899cc9380.txt``."""
VECTOR = spaces.Box(-np.inf, np.inf, (5,), np.float32)
RNG = np.random.default_rng(0)
KEY = jax.random.PRNGKey(0)
OBS = RNG.normal(size=(7, 5)).astype(np.float32)
ACTION = RNG.uniform(-1, 1, (7, 3)).astype(np.float32)


class OwnTorso(eqx.Module):
    """One hidden layer whose output is concatenated with its input."""

    weight: jax.Array
    n_outputs: int = eqx.field(static=True)

    def __init__(self, key, n_inputs, width=6):
        self.weight = jax.random.normal(key, (n_inputs, width)) / np.sqrt(n_inputs)
        self.n_outputs = n_inputs + width

    def __call__(self, x):
        return jnp.concatenate([x, jnp.tanh(x @ self.weight)], axis=-1)


SHAPES = {
    "mlp": {"net_arch": [6, 4]},
    "layer norm": {"net_arch": [6, 4], "layer_norm": True},
    "branches": DOCUMENT,
    "branches, layer norm": {**DOCUMENT, "layer_norm": True},
    "critic layers alone": {"critic_layers": (12,)},
    "simba": {"architecture": "simba", "n_blocks": 2, "width": 6},
    "own": {"torso": OwnTorso},
}


def make(shape, space=VECTOR):
    """An actor of 4 outputs and a critic for 3-dimensional actions, with random parameters."""
    shape = PolicyConfig(**shape)

    def init(key):
        actor = Network(key, leaves(space), 4, shape.actor_widths((6, 4)), shape)
        return actor, QNetwork(key, leaves(space), 3, shape.critic_widths((6, 4)), shape)

    return filled(jax.eval_shape(init, jax.random.PRNGKey(0)))


def filled(network):
    """The network with every parameter drawn here: no scale of 1 and no offset of 0 can hide a mistake."""
    rng = np.random.default_rng(3)
    draw = lambda p: jnp.asarray(rng.normal(0.0, 1 / np.sqrt(p.size // p.shape[-1]), p.shape).astype(np.float32))  # noqa: E731
    return jax.tree.map(draw, network)


@jax.jit
def call(network, *inputs):
    return network(*inputs)


def linear(layer, x):
    return x @ np.asarray(layer.weight, np.float64) + np.asarray(layer.bias, np.float64)


def normalised(norm, x):
    mean, variance = x.mean(axis=1, keepdims=True), x.var(axis=1, keepdims=True)
    return (x - mean) / np.sqrt(variance + 1e-5) * np.asarray(norm.scale) + np.asarray(norm.offset)


def relu(x):
    return np.maximum(x, 0)


def mlp(net, x):
    for i, layer in enumerate(net.layers):
        x = linear(layer, x)
        x = relu(normalised(net.norms[i], x) if net.norms else x)
    return x


def numpy_torso(torso, kind, state, action):
    """What the hidden layers of that kind ought to give; ``action`` is None in an actor."""
    joined = state if action is None else np.concatenate([state, action], axis=1)
    if kind.startswith(("branches", "critic layers")):
        x = mlp(torso.state, state)
        if action is not None:
            x = np.concatenate([x, mlp(torso.action, action)], axis=1)
        return mlp(torso.last, mlp(torso.common, x))
    if kind == "simba":
        x = linear(torso.embedding, joined)
        for block in torso.blocks:
            x = x + linear(block.contract, relu(linear(block.expand, normalised(block.norm, x))))
        return normalised(torso.norm, x)
    if kind == "own":
        return np.concatenate([joined, np.tanh(joined @ np.asarray(torso.weight, np.float64))], axis=1)
    return mlp(torso, joined)


@pytest.mark.parametrize("kind", SHAPES)
def test_forward_passes_equal_numpy(kind, strict_dtypes):
    actor, critic = make(SHAPES[kind])
    state, action = OBS.astype(np.float64), ACTION.astype(np.float64)
    outputs = linear(actor.head, numpy_torso(actor.torso, kind, state, None))
    values = linear(critic.head, numpy_torso(critic.torso, kind, state, action))
    assert outputs.shape == (7, 4)
    assert values.shape == (7, 1)
    np.testing.assert_allclose(call(actor, OBS), outputs, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(call(critic, OBS, ACTION), values, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", SHAPES)
def test_gradients_reach_every_parameter(kind):
    actor, critic = make(SHAPES[kind])
    loss = lambda networks: jnp.sum(networks[0](OBS) ** 2) + jnp.sum(networks[1](OBS, ACTION) ** 2)  # noqa: E731
    gradients = jax.jit(jax.grad(loss))((actor, critic))
    for path, gradient in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.abs(gradient).max() > 0, jax.tree_util.keystr(path)


def test_action_values_are_those_of_each_critic():
    shape = PolicyConfig(**DOCUMENT)
    init = lambda key: QNetwork(key, leaves(VECTOR), 3, shape.critic_widths(()), shape)  # noqa: E731
    critics = filled(jax.eval_shape(lambda key: ensemble(init, key, 3), jax.random.PRNGKey(0)))
    together = jax.jit(action_values)(critics, OBS, ACTION)
    for i in range(3):
        one = jax.tree.map(lambda p, i=i: p[i], critics)
        np.testing.assert_allclose(together[i], call(one, OBS, ACTION)[:, 0], rtol=1e-4, atol=1e-4)


def test_the_default_widths_are_the_algorithms_own():
    assert PolicyConfig().actor_widths((400, 300)) == (400, 300)
    assert PolicyConfig(net_arch={"pi": [7], "qf": [8, 9]}).actor_widths((1,)) == (7,)
    assert PolicyConfig(net_arch={"pi": [7], "qf": [8, 9]}).critic_widths((1,)) == (8, 9)
    assert PolicyConfig(architecture="simba", width=32, n_blocks=3).critic_widths((1,)) == (32, 32, 32)
    assert PolicyConfig(architecture="simba", net_arch={"pi": [8], "qf": [16, 16]}).actor_widths((1,)) == (8,)
    assert PolicyConfig(net_arch={"pi": [4]}).critic_widths((9,)) == (9,)
    assert PolicyConfig(**DOCUMENT).actor_widths((1,)) == (24,)
    assert PolicyConfig(state_layers=[5]).critic_widths((1,)) == ()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"state_layers": [8], "net_arch": [8]}, "state_layers conflicts with net_arch"),
        ({"common_layers": [8], "architecture": "simba"}, "common_layers conflicts with architecture='simba'"),
        ({"torso": OwnTorso, "net_arch": {"pi": [8]}}, "torso conflicts with pi"),
        ({"torso": OwnTorso, "layer_norm": True}, "torso conflicts with layer_norm"),
        ({"architecture": "simba", "layer_norm": True}, "conflicts with layer_norm"),
        ({"architecture": "simba", "net_arch": [8, 16]}, r"net_arch=\[8, 16\] must hold equal numbers"),
        ({"architecture": "transformer"}, "must be one of mlp, simba"),
        ({"actor_layers": [0]}, r"actor_layers=\[0\] must hold positive whole numbers"),
        ({"n_blocks": True}, "n_blocks=True must be a whole number"),
        ({"net_arch": "64"}, "net_arch='64' must be a list"),
        ({"net_arch": [6.5]}, "must hold positive whole numbers"),
        ({"net_arch": [True]}, "must hold positive whole numbers"),
        ({"net_arch": {"vf": [8]}}, r"net_arch has the unknown keys \['vf'\]; expected 'pi' and 'qf'"),
        ({"activation_fn": "rellu"}, "activation_fn='rellu' must be one of relu, tanh"),
        ({"torso": "OwnTorso"}, "must be a class or function"),
    ],
)
def test_impossible_shapes_are_refused(given, message):
    with pytest.raises((ValueError, TypeError), match=message):
        PolicyConfig(**given)


@pytest.mark.parametrize("kind", [kind for kind in SHAPES if kind != "own"])
def test_a_shape_survives_json(kind):
    config = sac.Config(policy_kwargs=SHAPES[kind])
    assert validation.build(sac.Config, configs.to_json(config)) == config
    assert hash(config.policy_kwargs) == hash(MemoryConfig(**SHAPES[kind]))


# --- encoders -------------------------------------------------------------------------------------------------------


def one_hot(values, starts, sizes):
    """Rows of zeros with one 1 a component, written out."""
    rows = []
    for row in values:
        bits = []
        for value, start, size in zip(row, starts, sizes, strict=True):
            bits += [float(value == start + i) for i in range(size)]
        rows.append(bits)
    return np.array(rows)


@pytest.mark.parametrize(
    ("space", "values", "expected"),
    [
        (spaces.Discrete(3, start=-1), [-1, 1, 0], one_hot([[-1], [1], [0]], [-1], [3])),
        (
            spaces.MultiDiscrete([2, 4], start=[5, -2]),
            [[5, -2], [6, 1]],
            np.array([[1, 0, 1, 0, 0, 0], [0, 1, 0, 0, 0, 1]]),
        ),
        (
            spaces.MultiDiscrete([[2, 3], [2, 2]]),
            [[[1, 2], [0, 1]]],
            one_hot([[1, 2, 0, 1]], [0, 0, 0, 0], [2, 3, 2, 2]),
        ),
        (spaces.MultiBinary((2, 2)), [[[0, 1], [1, 1]]], np.array([[0, 1, 1, 1]])),
        (spaces.Box(-1, 1, (2, 2)), [[[0.5, -1], [1, 0]]], np.array([[0.5, -1, 1, 0]])),
    ],
    ids=["discrete", "multi-discrete", "matrix of discrete", "multi-binary", "matrix"],
)
def test_spaces_are_encoded_as_vectors(space, values, expected):
    encoder = Encoder(leaves(space))
    np.testing.assert_array_equal(encoder(jnp.asarray(np.array(values, leaves(space)[0].dtype))), expected)
    assert encoder.n_features == expected.shape[1]


def test_nested_observations_are_encoded_leaf_by_leaf_in_the_order_of_sorted_keys():
    space = spaces.Dict(
        z=spaces.Discrete(2, start=7),
        a=spaces.Tuple((spaces.MultiBinary(2), spaces.Box(-1, 1, (1,)))),
        m=spaces.Dict(inner=spaces.MultiDiscrete([2, 2])),
    )
    obs = {
        "z": np.array([8, 7], np.int32),
        "a": (np.array([[0, 1], [1, 1]], np.int8), np.array([[0.25], [-0.5]], np.float32)),
        "m": {"inner": np.array([[0, 1], [1, 1]], np.int32)},
    }
    expected = [[0, 1, 0.25, 1, 0, 0, 1, 0, 1], [1, 1, -0.5, 0, 1, 0, 1, 1, 0]]
    np.testing.assert_array_equal(Encoder(leaves(space))(obs), expected)


def numpy_cnn(cnn, pixels):
    """Pixels ``(batch, height, width, channels)`` through the network, by explicit loops over rows and columns."""
    x = pixels.astype(np.float64) / 255
    for layer in cnn.layers:
        weight, stride = np.asarray(layer.weight, np.float64), layer.stride
        kernel = weight.shape[0]
        rows, columns = ((side - kernel) // stride + 1 for side in x.shape[1:3])
        out = np.empty((len(x), rows, columns, weight.shape[3]))
        for i in range(rows):
            for j in range(columns):
                patch = x[:, i * stride : i * stride + kernel, j * stride : j * stride + kernel]
                out[:, i, j] = np.einsum("nhwc,hwcf->nf", patch, weight) + np.asarray(layer.bias)
        x = relu(out)
    return relu(linear(cnn.linear, x.reshape(len(x), -1)))


@pytest.mark.parametrize(("shape", "kind"), [((36, 40, 1), NATURE), ((10, 8, 3), SMALL)])
def test_the_convolutional_encoder_equals_loops(shape, kind):
    (leaf,) = leaves(spaces.Box(0, 255, shape, np.uint8))
    assert convolutions(leaf) == kind
    cnn = filled(jax.eval_shape(lambda key: CNN(key, shape, kind), jax.random.PRNGKey(0)))
    pixels = RNG.integers(0, 256, (2, *shape), dtype=np.uint8)
    features = call(cnn, pixels)
    assert features.shape == (2, kind.n_outputs)
    np.testing.assert_allclose(features, numpy_cnn(cnn, pixels), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "fan_in"),
    [(lambda key: Linear(key, 100, 200), 100), (lambda key: Convolution(key, 4, 200, 4, 2), 4 * 4 * 4)],
    ids=["linear", "convolution"],
)
def test_weights_begin_uniform_within_the_inverse_root_of_the_number_of_inputs(make, fan_in):
    layer = make(jax.random.PRNGKey(0))
    bound = fan_in**-0.5
    for parameters in (layer.weight, layer.bias):
        values = np.asarray(parameters).ravel()
        assert stats.kstest(values, stats.uniform(-bound, 2 * bound).cdf).pvalue > 1e-4


def test_images_in_chunks_give_the_same_features_and_gradients(monkeypatch):
    cnn, images = CNN(jax.random.PRNGKey(0), (8, 8, 1), SMALL), RNG.integers(0, 256, (7, 8, 8, 1), dtype=np.uint8)

    def features_and_gradient():
        loss = lambda cnn: (jnp.sum(jnp.square(cnn(images))), cnn(images))  # noqa: E731
        return jax.tree.leaves(jax.jit(jax.grad(loss, has_aux=True))(cnn))

    expected = features_and_gradient()
    for size in (1, 3):  # without and with a rest
        monkeypatch.setattr(encoder, "CHUNK", size)
        for one, other in zip(features_and_gradient(), expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_the_memory_for_images_does_not_grow_with_their_number(monkeypatch):
    """Each takes 102 kB in the convolutions (9 x 9 patches of 288 numbers and 11 x 11 of 16), and 1 kB as features."""
    cnn = CNN(jax.random.PRNGKey(0), (24, 24, 1), SMALL)
    loss = lambda cnn, images: jnp.sum(jnp.square(cnn(images)))  # noqa: E731

    def temporaries(n):
        images = jax.ShapeDtypeStruct((n, 24, 24, 1), np.uint8)
        return jax.jit(jax.grad(loss)).lower(cnn, images).compile().memory_analysis().temp_size_in_bytes

    whole = temporaries(256)
    monkeypatch.setattr(encoder, "CHUNK", 16)
    few, many = temporaries(64), temporaries(256)
    assert many < whole / 5
    assert many - few < (256 - 64) * 6_000


def test_channels_are_found_where_stable_baselines3_finds_them():
    last = RNG.integers(0, 256, (2, 9, 8, 3), dtype=np.uint8)
    first = np.transpose(last, (0, 3, 1, 2))
    np.testing.assert_array_equal(channels_last(jnp.asarray(first)), last)
    np.testing.assert_array_equal(channels_last(jnp.asarray(last)), last)
    assert image_shape((3, 9, 8)) == image_shape((9, 8, 3)) == (9, 8, 3)
    stack = np.stack([last, last + 1, last + 2, last + 3], axis=1)
    merged = channels_last(jnp.asarray(stack))
    assert merged.shape == (2, *image_shape((4, 9, 8, 3))) == (2, 9, 8, 12)
    for frame in range(4):
        np.testing.assert_array_equal(merged[..., 3 * frame : 3 * frame + 3], stack[:, frame])


def test_each_image_of_a_nested_observation_has_an_encoder_of_its_own():
    space = spaces.Dict(
        left=spaces.Box(0, 255, (9, 8, 3), np.uint8),
        pose=spaces.Box(-1, 1, (2,)),
        right=spaces.Box(0, 255, (3, 40, 36), np.uint8),
        tiny=spaces.Box(0, 255, (4, 4, 1), np.uint8),
    )
    obs = {key: np.stack([part.sample(), part.sample()]) for key, part in space.spaces.items()}
    actor, critic = make({}, space)
    left, right = actor.encoder.images
    right_last = np.transpose(obs["right"], (0, 2, 3, 1))
    parts = [numpy_cnn(left, obs["left"]), obs["pose"], numpy_cnn(right, right_last), obs["tiny"].reshape(2, -1) / 255]
    np.testing.assert_allclose(call(actor.encoder, obs), np.concatenate(parts, axis=1), rtol=1e-4, atol=1e-5)
    assert actor.encoder.n_features == 256 + 2 + 512 + 16
    loss = lambda networks: jnp.sum(networks[0](obs)) + jnp.sum(networks[1](obs, ACTION[:2]))  # noqa: E731
    gradients = jax.jit(jax.grad(loss))((actor, critic))
    assert all(np.abs(gradient).max() > 0 for gradient in jax.tree.leaves(gradients))


# --- a user's own module --------------------------------------------------------------------------------------------


class NoOutputs(eqx.Module):
    weight: jax.Array

    def __init__(self, key, n_inputs):
        self.weight = jnp.ones((n_inputs, 2))

    def __call__(self, x):
        return x @ self.weight


class ThreeAxes(NoOutputs):
    def __call__(self, x):
        return (x @ self.weight)[None, None]


class DynamicOutputs(eqx.Module):
    n_outputs: int

    def __init__(self, key, n_inputs):
        self.n_outputs = n_inputs


@pytest.mark.parametrize(
    ("torso", "message"),
    [
        (ThreeAxes, r"torso=ThreeAxes must map inputs of shape \(3,\) to a vector"),
        (DynamicOutputs, "torso=DynamicOutputs holds n_outputs, which is of type int"),
        (lambda key, n_inputs: jnp.ones(3), "expected an equinox.Module"),
    ],
)
def test_a_module_that_cannot_be_learned_is_refused(torso, message):
    with pytest.raises(TypeError, match=message):
        rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"torso": torso}, seed=0)


def test_a_saved_torso_must_be_given_again(tmp_path):
    agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"torso": OwnTorso, "activation_fn": "tanh"}, seed=0)
    path = agent.save(tmp_path / "own")
    with pytest.raises(
        CheckpointError, match=r"its torso is your own, 'OwnTorso', .* policy_kwargs=dict\(torso=OwnTorso\)"
    ):
        rejeu.SAC.load(path)
    with pytest.raises(CheckpointError, match="OwnTorso"):
        rejeu.SAC.load(path, gamma=0.9)
    loaded = rejeu.load(path, policy_kwargs={"torso": OwnTorso})
    assert loaded.config == agent.config
    assert loaded.config.policy_kwargs.activation_fn == "tanh"
    with pytest.raises(CheckpointError, match=r"torso\.weight is float32"):
        rejeu.SAC.load(path, policy_kwargs={"torso": lambda key, n_inputs: OwnTorso(key, n_inputs, width=7)})


def own_mlp(key, n_inputs):
    return eqx.nn.MLP(n_inputs, 6, 5, 1, key=key)


class OwnCNN(eqx.Module):
    """Takes one image, channels first, as Equinox's layers do."""

    conv: eqx.nn.Conv2d

    def __init__(self, key, leaves):
        (leaf,) = leaves
        self.conv = eqx.nn.Conv2d(leaf.shape[0], 4, 3, key=key)

    def __call__(self, image):
        return jax.nn.relu(self.conv(image.astype(jnp.float32) / 255)).mean(axis=(1, 2))


class OwnGoalEncoder(eqx.Module):
    weight: jax.Array

    def __init__(self, key, leaves):
        self.weight = jnp.full((2, 3), 0.5)

    def __call__(self, obs):
        return (obs["desired_goal"] - obs["achieved_goal"]) @ self.weight


def test_an_own_encoder_reads_one_image_or_a_dict():
    image = spaces.Box(0, 255, (3, 9, 9), np.uint8)
    network = Network(KEY, leaves(image), 2, (4,), PolicyConfig(encoder=OwnCNN))
    assert network.encoder.n_features == 4
    assert network(np.zeros((6, 3, 9, 9), np.uint8)).shape == (6, 2)
    goal = spaces.Dict({key: spaces.Box(-1, 1, (2,)) for key in ("achieved_goal", "desired_goal", "observation")})
    network = Network(KEY, leaves(goal), 2, (4,), PolicyConfig(encoder=OwnGoalEncoder))
    obs = {key: np.full((4, 2), i, np.float32) for i, key in enumerate(sorted(goal.spaces))}
    np.testing.assert_allclose(network.encoder(obs), np.ones((4, 3)))


def test_a_head_of_another_width_is_refused():
    shape = PolicyConfig(head=lambda key, n, m: eqx.nn.Linear(n, m + 1, key=key))
    with pytest.raises(TypeError, match="must have 2 outputs, got 3"):
        Network(KEY, leaves(VECTOR), 2, (4,), shape)


@pytest.mark.parametrize("agent", only([rejeu.PPO], [rejeu.SAC, rejeu.PPO]))
def test_an_agent_with_own_modules_learns_and_loads(agent, tmp_path):
    policy = {"torso": own_mlp, "head": lambda key, n, m: eqx.nn.Linear(n, m, key=key)}
    short = (
        {"n_steps": 8, "batch_size": 8, "n_epochs": 1}
        if agent is rejeu.PPO
        else {"learning_starts": 4, "batch_size": 4}
    )
    made = agent("MlpPolicy", "Pendulum-v1", policy_kwargs=policy, seed=0, **short).learn(16)
    assert "torso.arrays.layers.0" in made.summary()
    path = made.save(tmp_path / "own")
    with pytest.raises(CheckpointError, match="its torso is your own, 'own_mlp'"):
        rejeu.load(path)
    loaded = rejeu.load(path, policy_kwargs=policy)
    obs = np.array([0.6, -0.8, 2.0], np.float32)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], made.predict(obs, deterministic=True)[0])


NAMED = """
import equinox as eqx
from rejeu.networks import register_encoder

@register_encoder("numbers")
def numbers(key, leaves):
    return eqx.nn.Linear(leaves[0].n_features, 5, key=key)
"""


def test_a_named_encoder_is_given_on_the_command_line_saved_and_loaded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("numbers_file.py").write_text(NAMED)
    given = ["--import", "numbers_file.py", "--set", "policy_kwargs.encoder=numbers", "max_grad_norm=1"]
    given += ["policy_kwargs.net_arch=[8]", "learning_starts=10", "batch_size=8"]
    small = ["--steps", "20", "--evaluate-episodes", "1", "--out", "run", "--no-report", "--no-video"]
    assert cli.main(["train", "Pendulum-v1", "--algo", "SAC", *given, *small]) == 0
    agent = rejeu.load("run")
    assert (agent.config.policy_kwargs.encoder, agent.config.max_grad_norm) == ("numbers", 1.0)
    assert agent.state.actor.encoder.n_features == 5
    del ENCODERS["numbers"]
    with pytest.raises(CheckpointError, match="encoder is your own, 'numbers'"):
        rejeu.load("run")
    assert rejeu.load("run", policy_kwargs={"encoder": numbers}).state.actor.encoder.n_features == 5
    with pytest.raises(ValueError, match="encoder='numbers' is not registered"):
        PolicyConfig(encoder="numbers")


def numbers(key, leaves):
    return eqx.nn.Linear(leaves[0].n_features, 5, key=key)
