"""``rejeu.load_policy``: model files act in NumPy as ``predict`` does, in processes without JAX."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import rejeu
from rejeu.errors import CheckpointError
from rejeu.export.numpy_policy import ACTIVATIONS, load_policy
from rejeu.networks import layers
from tests import hostile_files
from tests.export.policies import KINDS, agent_of, observations
from tests.export.test_export import OTHERS
from tests.tiers import exhaustive

WITHOUT_MEMORY = [kind for kind in KINDS if kind[0] != "RecurrentPPO"]
CASES = [
    pytest.param(name, action, observation, normalize, marks=[] if i % 4 == j else exhaustive)
    for i, (name, action) in enumerate(WITHOUT_MEMORY)
    for j, (observation, normalize) in enumerate(
        [("MLP", False), ("MLP", True), ("small Dict", False), ("small Dict", True)]
    )
]
FULLY_CONNECTED = [kind for kind in OTHERS if "CNN" not in kind and kind != "GRU"]


def check(agent, path):
    """Compares single observations and a batch with ``predict``."""
    policy = load_policy(agent.save(path))
    samples = observations(agent, 40, seed=5)
    expected = np.stack([agent.predict(one, deterministic=True)[0] for one in samples])
    found = np.stack([policy.predict(one)[0] for one in samples])
    assert found.dtype == expected.dtype
    if expected.dtype.kind == "f":
        np.testing.assert_allclose(found, expected, atol=1e-5)
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("name", "action", "observation", "normalize"), CASES)
def test_numpy_acts_as_predict(name, action, observation, normalize, tmp_path):
    check(agent_of(name, action, observation, normalize=normalize), tmp_path / "model")


@pytest.mark.parametrize("kind", FULLY_CONNECTED)
def test_numpy_acts_as_predict_with_other_networks_and_actions(kind, tmp_path):
    name, action, settings = OTHERS[kind]
    check(agent_of(name, action, **settings), tmp_path / "model")


def test_activations_are_those_of_the_networks():
    x = np.linspace(-4, 4, 41, dtype=np.float32)
    assert ACTIVATIONS.keys() == layers.ACTIVATIONS.keys()
    for name, activation in ACTIVATIONS.items():
        np.testing.assert_allclose(activation(x), layers.ACTIVATIONS[name](x), atol=1e-6, err_msg=name)


def test_goals_share_their_statistics(tmp_path):
    agent = rejeu.SAC("MultiInputPolicy", "jax/PointMaze-v0", seed=0, normalize=True, learning_starts=90)
    agent.on_device = False
    agent.learn(60)
    check(agent, tmp_path / "model")


def test_batches_and_masks(tmp_path):
    agent = agent_of("MaskablePPO", "Discrete")
    policy = load_policy(agent.save(tmp_path / "model"))
    obs, masks = np.stack(observations(agent, 3, seed=0)), np.eye(3, dtype=bool)
    assert policy.predict(obs, action_masks=masks)[0].tolist() == [1, 2, 3]
    assert policy.predict(obs, "kept")[1] == "kept"
    np.testing.assert_array_equal(policy.predict(obs)[0], agent.predict(obs, deterministic=True)[0])


def test_no_jax_is_imported(tmp_path):
    path = agent_of("SAC", "Box").save(tmp_path / "model")
    code = (
        f"import sys, rejeu, numpy; policy = rejeu.load_policy({str(path)!r}); "
        "policy.predict(numpy.zeros(4, numpy.float32)); print('jax' in sys.modules, 'equinox' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]


@pytest.mark.parametrize(("name", "observation"), [("SAC", "CNN"), ("RecurrentPPO", "MLP")])
def test_other_policies_are_one_line(name, observation, tmp_path):
    path = agent_of(name, "Box", observation).save(tmp_path / "model")
    with pytest.raises(CheckpointError, match=r"has images, memory or modules .* rejeu export --to onnx"):
        load_policy(path)


def test_wrong_observations_are_one_line(tmp_path):
    policy = load_policy(agent_of("PPO", "Box").save(tmp_path / "model"))
    with pytest.raises(ValueError, match=r"has shape \(3,\), expected \(4,\), or a batch of it"):
        policy.predict(np.zeros(3))
    with pytest.raises(ValueError, match="deterministic"):
        policy.predict(np.zeros(4), deterministic=False)
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "missing")


HEADERS = {
    "IQN": {"n_policy_quantiles": (10**9, 0, -1, 1.5, "8", None)},
    "QRDQN": {"n_quantiles": (10**9, 25, 100, 0)},
    "DQN": {"n_atoms": (10**9, 2, 1), "v_min": (-1e308, "x"), "v_max": (1e308, None)},
    "SAC": {"normalize": ({"norm_obs": True, "epsilon": -9.0, "clip_obs": 10.0, "norm_reward": False},)},
}
"""Numbers that the shape of no array checks."""


@pytest.mark.parametrize("name", HEADERS)
def test_a_number_in_a_header_is_refused_where_no_array_checks_it(name, tmp_path):
    settings = {"DQN": {"distribution": "categorical"}, "SAC": {"normalize": True}}.get(name, {})
    env_id = "Pendulum-v1" if name == "SAC" else "CartPole-v1"
    agent = rejeu.AGENTS[name]("MlpPolicy", env_id, policy_kwargs={"net_arch": [4]}, seed=0, **settings)
    path = agent.save(tmp_path / "model")
    rejeu.load_policy(path).predict(agent.observation_space.sample())
    content = path.read_bytes()
    for key, values in HEADERS[name].items():
        for variant in hostile_files.with_values(content, "number", f"config.{key}", values):
            if name == "SAC":
                variant = variant._replace(content=hostile_files.changed(variant.content, seen_once))
            path.write_bytes(variant.content)
            for load in (rejeu.load_policy, rejeu.load):
                with pytest.raises(rejeu.CheckpointError) as caught:
                    load(path)
                assert "\n" not in str(caught.value)


def seen_once(header, arrays):
    arrays.update({key: np.ones_like(array) for key, array in arrays.items() if key.endswith("n_seen")})
