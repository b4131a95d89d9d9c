"""An agent on another device than the default one, in a process with two CPU devices."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import rejeu
from rejeu.core import devices
from tests.agents.test_together import SMALL

TWO = "--xla_force_host_platform_device_count=2"


@pytest.mark.exhaustive
def test_an_agent_computes_on_the_device_that_it_was_given() -> None:
    environ = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {TWO}"}
    words = [sys.executable, "-m", "tests.training.compiled.test_placement"]
    done = subprocess.run(words, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def place() -> None:
    """Trains an agent on another device than the default one."""
    other = jax.local_devices()[1]
    devices.find = lambda name: None if name == "auto" else other  # type: ignore[assignment]
    for env, settings in (("jax/CartPole-v1", SMALL), ("CartPole-v1", {**SMALL, "normalize": True})):
        agent = rejeu.DQN("MlpPolicy", env, seed=0, device="cpu", **settings).learn(40)
        agent.predict(agent.observation_space.sample())
        agent.evaluate(2)
        assert {*agent.run.state[0].devices()} == {other}
        default = rejeu.DQN("MlpPolicy", env, seed=0, **settings).learn(40)
        assert {*default.run.state[0].devices()} == {jax.local_devices()[0]}
        for key, value in agent.get_parameters().items():
            np.testing.assert_array_equal(value, default.get_parameters()[key])


if __name__ == "__main__":
    assert len(jax.local_devices()) == 2
    place()
