"""Devices by name."""

import jax
import numpy as np
import pytest

import rejeu
from rejeu.core import devices, xla
from tests.agents.test_together import SMALL

needs_no_gpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="of machines without a GPU")


@needs_no_gpu
def test_a_missing_device_is_one_line_with_what_there_is_and_how_to_get_it():
    with pytest.raises(ValueError, match=r"device='gpu'.* only 1 CPU device.*pip install .jax\[cuda") as raised:
        rejeu.DQN("MlpPolicy", "CartPole-v1", device="cuda", **SMALL)
    assert "\n" not in str(raised.value)


def test_a_saved_agent_is_loaded_on_any_device(tmp_path):
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", seed=0, device="cpu", **SMALL)
    loaded = rejeu.load(agent.save(tmp_path / "agent"))
    assert (agent.device, loaded.device) == ("cpu", "auto")
    assert rejeu.load(tmp_path / "agent", device="cpu").device == "cpu"
    observation = np.zeros(4, np.float32)
    assert agent.predict(observation, deterministic=True)[0] == loaded.predict(observation, deterministic=True)[0]


@needs_no_gpu
def test_a_missing_device_is_no_damage_of_the_file(tmp_path):
    path = rejeu.DQN("MlpPolicy", "CartPole-v1", seed=0, **SMALL).save(tmp_path / "agent")
    with pytest.raises(ValueError, match="JAX has no such device") as raised:
        rejeu.load(path, device="gpu")
    assert not isinstance(raised.value, rejeu.core.errors.CheckpointError)


@needs_no_gpu
def test_the_default_device_may_be_another_than_jax_has_chosen():
    device = jax.local_devices()[0]
    assert devices.local("auto") == [device]
    with jax.default_device("cpu"):
        assert (xla.platform(), devices.local("auto")) == ("cpu", [device])
    with devices.chosen("cpu"):
        assert jax.config.jax_default_device is None


def test_a_device_with_too_little_memory_is_refused_before_training(monkeypatch):
    monkeypatch.setattr(devices, "room", lambda device: 2**20)
    large = {**SMALL, "buffer_size": 100_000}
    agent = rejeu.DQN("MlpPolicy", "jax/CartPole-v1", seed=0, **large)
    with pytest.raises(MemoryError, match=r"the run would need about .* lower buffer_size \(it is 100,000\)"):
        agent.learn(100)
    with pytest.raises(MemoryError, match=r"300 runs would need .* GiB on .* or the number of seeds"):
        rejeu.train_seeds(rejeu.DQN, "MlpPolicy", "jax/CartPole-v1", 100, seeds=300, **large)
    with pytest.raises(MemoryError, match=r"lower n_steps \(it is 50,000\) or the number of environments \(it is 1\)"):
        rejeu.PPO("MlpPolicy", "jax/CartPole-v1", n_steps=50_000, policy_kwargs={"net_arch": [8]}).learn(100)
