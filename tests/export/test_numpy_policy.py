"""``rejeu.load_policy``: model files act in NumPy, in processes without JAX. See also ``test_export``."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import rejeu
from rejeu.core.errors import CheckpointError
from rejeu.export.numpy_policy import ACTIVATIONS, load_policy
from rejeu.networks import layers
from tests import hostile_files
from tests.export.policies import agent_of, observations


def test_activations_are_those_of_the_networks():
    x = np.linspace(-4, 4, 41, dtype=np.float32)
    assert ACTIVATIONS.keys() == layers.ACTIVATIONS.keys()
    for name, activation in ACTIVATIONS.items():
        np.testing.assert_allclose(activation(x), layers.ACTIVATIONS[name](x), atol=1e-6, err_msg=name)


def test_batches_and_masks(tmp_path):
    agent = agent_of("MaskablePPO", "Discrete")
    policy = load_policy(agent.save(tmp_path / "model"))
    obs, masks = np.stack(observations(agent, 3, seed=0)), np.eye(3, dtype=bool)
    assert policy.predict(obs, action_masks=masks)[0].tolist() == [1, 2, 3]
    assert policy.predict(obs, "kept")[1] == "kept"
    np.testing.assert_array_equal(policy.predict(obs)[0], agent.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match=r"has shape \(3,\), expected \(4,\), or a batch of it"):
        policy.predict(np.zeros(3))
    with pytest.raises(ValueError, match="deterministic"):
        policy.predict(np.zeros(4), deterministic=False)
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "missing")


def test_observations_are_clipped_as_in_training(tmp_path):
    agent = agent_of("SAC", "Box", normalize={"norm_obs": True, "norm_reward": False, "clip_obs": 0.5})
    policy = load_policy(agent.save(tmp_path / "model"))
    for obs in (np.full(4, 50, np.float32), np.full(4, -50, np.float32)):
        np.testing.assert_allclose(policy.predict(obs)[0], agent.predict(obs, deterministic=True)[0], atol=1e-5)


def test_no_jax_is_imported(tmp_path):
    path = agent_of("SAC", "Box").save(tmp_path / "model")
    code = (
        f"import sys, rejeu, numpy; policy = rejeu.load_policy({str(path)!r}); "
        "policy.predict(numpy.zeros(4, numpy.float32)); print('jax' in sys.modules, 'equinox' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]


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
    agent = agent_of(name, "Box" if name == "SAC" else "Discrete", policy_kwargs={"net_arch": [4]}, **settings)
    path = agent.save(tmp_path / "model")
    rejeu.load_policy(path).predict(agent.observation_space.sample())
    content = path.read_bytes()
    for key, values in HEADERS[name].items():
        for variant in hostile_files.with_values(content, "number", f"config.{key}", values):
            if name == "SAC":
                variant = variant._replace(content=hostile_files.changed(variant.content, seen_once))
            path.write_bytes(variant.content)
            for load in (rejeu.load_policy, rejeu.load):
                with pytest.raises(CheckpointError) as caught:
                    load(path)
                assert "\n" not in str(caught.value)


def seen_once(header, arrays):
    arrays.update({key: np.ones_like(array) for key, array in arrays.items() if key.endswith("n_seen")})
