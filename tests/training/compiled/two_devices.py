"""Trains three runs that two devices share, and each alone; run by ``test_sharing.py`` in a process with two CPU devices."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core import devices
from rejeu.training.compiled import trainer as device_trainer
from rejeu.training.compiled.trainer import DeviceTrainer, RunGroup
from tests.agents.test_together import ON_POLICY, SMALL, assert_same_runs

CASES: dict[str, Any] = {
    "replay on the device": (rejeu.DQN, "jax/CartPole-v1", SMALL),
    "rollouts on the device": (rejeu.PPO, "jax/CartPole-v1", ON_POLICY),
}


def share(name: str) -> None:
    """Compares runs that stop at different steps with single ones, and resumes one of them."""
    kind, env, settings = CASES[name]
    device_trainer.MOST_ON_CPU = 1  # so that there are two groups of runs
    used: list[int] = []
    start = DeviceTrainer.start

    def counted(trainer: DeviceTrainer, group: RunGroup, limits: Any) -> None:
        start(trainer, group, limits)
        used.append(len(jax.tree.leaves(group.carry.state)[0].sharding.device_set))

    DeviceTrainer.start = counted  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:

        def callbacks(agent: Any) -> list[Any]:
            return [
                Checkpoint(Path(folder) / str(agent.seed), every=40),
                lambda agent, progress: agent.seed != 1 or progress.step < 40,
            ]

        agents = rejeu.train_seeds(kind, "MlpPolicy", env, 120, seeds=3, n_envs=2, callback=callbacks, **settings)
        assert [agent.num_timesteps for agent in agents] == [120, 40, 120]
        assert all(n == 2 for n in used), used
        for agent in agents:
            alone = kind("MlpPolicy", rejeu.make_vector(env, 2), seed=agent.seed, **settings).learn(agent.num_timesteps)
            assert_same_runs(agent, alone)
        resumed = kind.resume(Path(folder) / "2")
        for key, value in resumed.get_parameters().items():
            np.testing.assert_array_equal(value, agents[2].get_parameters()[key])


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
    place() if sys.argv[1] == "placement" else share(sys.argv[1])
