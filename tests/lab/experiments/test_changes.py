"""Every hyperparameter of a search space can be changed when a run of its algorithm is resumed."""

import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.lab.experiments import space as spaces

FIXED_AT_START = ("policy_kwargs", "replay_buffer_kwargs", "n_steps", "learning_starts")
"""What changes shapes, or acts only when training starts."""
ENVIRONMENTS = dict.fromkeys(("DQN", "QRDQN", "IQN", "PPO", "A2C", "PQN", "RecurrentPPO"), "CartPole-v1")
SMALL = {"policy_kwargs": {"net_arch": [8]}}
OFF_POLICY = {"learning_starts": 32, "buffer_size": 1000, **SMALL}
ON_POLICY = {"n_steps": 16, **SMALL}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", [name for name in rejeu.AGENTS if name not in ("MaskablePPO", "ARS")])
def test_a_run_goes_on_with_the_other_end_of_every_range(name, tmp_path):
    """The configuration of MaskablePPO is that of PPO, and ARS updates after more steps."""
    kind = rejeu.AGENTS[name]
    space = {
        key: one for key, one in kind.algorithm.Config.search_space.items() if key.split(".")[0] not in FIXED_AT_START
    }
    assert len(space) >= 2
    low, high = (spaces.applied({}, {key: one.ends()[end] for key, one in space.items()}) for end in (0, -1))
    settings = OFF_POLICY if issubclass(kind, rejeu.OffPolicyAgent) else ON_POLICY
    agent = kind("MlpPolicy", ENVIRONMENTS.get(name, "Pendulum-v1"), seed=0, **settings, **low)
    agent.learn(200, [Checkpoint(tmp_path), lambda agent, progress: progress.step < 100])
    resumed = kind.resume(tmp_path, **high)
    assert resumed.num_timesteps == 100
    assert resumed.learn().num_timesteps == 200
    assert resumed.n_updates > agent.n_updates
    assert resumed.config.gamma == high["gamma"]
