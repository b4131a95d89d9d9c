"""NaN on the device is reported as by the loops of the host: the same message, the same batch, the same state."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rejeu
from rejeu.core import checkpoint
from tests.jax_environments import Breaks, Undefined
from tests.training.compiled import test_on_policy as on_policy
from tests.training.compiled.same_draws import use_same_draws
from tests.training.compiled.test_off_policy import learn_on_host, make

HINDSIGHT = {"replay_buffer_class": "HerReplayBuffer", "action_noise": 0.3}
HUGE = {"learning_rate": 1e30}


@pytest.mark.parametrize(
    ("what", "said"),
    [
        pytest.param("reward", "returned the reward nan in environment 0 after 48 steps", marks=pytest.mark.exhaustive),
        pytest.param("observation", r"returned an observation with nan at \[0\]", marks=pytest.mark.exhaustive),
        ("reset", r"reset returned an observation with nan at \[0\]"),
    ],
)
def test_an_environment_that_returns_nan_is_reported_as_on_the_host(what: str, said: str) -> None:
    device, host = (make(rejeu.DQN, Breaks(what=what), 2) for _ in range(2))
    with pytest.raises(rejeu.BadEnvironmentError, match=said) as raised:
        device.learn(100)
    assert device.stops is not None
    with pytest.raises(rejeu.BadEnvironmentError) as expected:
        learn_on_host(host, 100)
    assert str(raised.value) == str(expected.value)


def error_of(agent: Any, folder: Path) -> tuple[rejeu.NonFiniteError, str, Any]:
    """Returns the error of training for 300 steps, its message without the path of the batch, and the batch."""
    agent.report_folder = folder
    with pytest.raises(rejeu.NonFiniteError) as raised:
        agent.learn(300)
    error = raised.value
    assert error.batch is not None
    return error, str(error).replace(str(error.batch), "PATH"), checkpoint.read(error.batch, "batch")


def assert_same_errors(device: Any, host: Any, folder: Path) -> str:
    """Asserts that two agents fail with the same message, batch, counters and state; returns the message."""
    error, message, (header, arrays) = error_of(device, folder / "device")
    assert device.stops is not None
    other, expected, (its_header, its_arrays) = error_of(host, folder / "host")
    assert message == expected
    assert "\n" not in message
    assert (error.names, error.step, error.n_updates) == (other.names, other.step, other.n_updates)
    assert device.n_updates == host.n_updates
    assert header["clock"] == pytest.approx(its_header["clock"])
    for name in arrays.keys() | its_arrays.keys():
        np.testing.assert_allclose(arrays[name], its_arrays[name], rtol=1e-4, atol=1e-4)
    for name, value in device.get_parameters().items():
        np.testing.assert_allclose(value, host.get_parameters()[name], rtol=1e-3, atol=1e-4, err_msg=name)
        assert np.isfinite(value).all()
    return message


@pytest.mark.parametrize(
    ("kind", "env", "settings", "said"),
    [
        (rejeu.DQN, "jax/CartPole-v1", HUGE, "lower learning_rate"),
        pytest.param(rejeu.DQN, "jax/CartPole-v1", {**HUGE, "train_freq": 8, "gradient_steps": 3}, "update 2. ",
                     marks=pytest.mark.exhaustive),
        pytest.param(rejeu.DDPG, Undefined(), HINDSIGHT, "the batch held reward .nan.*compute_reward",
                     marks=pytest.mark.exhaustive),
        pytest.param(rejeu.DDPG, Undefined(), {**HINDSIGHT, "n_steps": 2}, "the batch held reward .nan",
                     marks=pytest.mark.exhaustive),
        pytest.param(rejeu.DQN, "jax/CartPole-v1", {**HUGE, "nonfinite": "skip", "train_freq": 1},
                     "100 updates in a row were skipped", marks=pytest.mark.exhaustive),
    ],
)  # fmt: skip
def test_nan_of_an_update_is_reported_as_on_the_host(
    kind: Any, env: Any, settings: dict[str, Any], said: str, tmp_path: Path
) -> None:
    device, host = (make(kind, env, **settings) for _ in range(2))
    use_same_draws(host.run)
    host.on_device = False
    assert re.search(said, assert_same_errors(device, host, tmp_path))


@pytest.mark.exhaustive
def test_nan_of_an_on_policy_update_is_reported_as_on_the_host(tmp_path: Path) -> None:
    make_one = lambda: on_policy.make(rejeu.PPO, "jax/CartPole-v1", **on_policy.PPO, learning_rate=1e38)  # noqa: E731
    device, host = make_one(), make_one()
    host.on_device = False
    assert "lower learning_rate" in assert_same_errors(device, host, tmp_path)
