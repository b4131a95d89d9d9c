"""The same scripts with Stable-Baselines3, recorded by ``tests/golden/record_vec_env.py``, and with rejeu's mirror."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.golden import vec_env_script as script

pytestmark = pytest.mark.usefixtures("learners_are_shared")

GOLDEN = Path(__file__).parents[1] / "golden" / "vec_env_sb3.npz"


def recorded(group):
    with np.load(GOLDEN, allow_pickle=False) as file:
        return {key.removeprefix(f"{group}."): file[key] for key in file if key.startswith(f"{group}.")}


def assert_same(found, expected):
    assert sorted(found) == sorted(expected)
    for key, value in expected.items():
        assert found[key].shape == value.shape, key
        if value.dtype.kind == "U":
            assert found[key].tolist() == value.tolist(), key
        else:
            np.testing.assert_allclose(found[key].astype(float), value.astype(float), rtol=2e-6, atol=2e-6, err_msg=key)


def test_vector_environments_show_what_those_of_stable_baselines3_show():
    assert_same(script.vector_environments("rejeu.sb3"), recorded("vec"))


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_callbacks_are_called_when_stable_baselines3_calls_them(name):
    assert_same(script.callbacks("rejeu.sb3", name), recorded(name))
