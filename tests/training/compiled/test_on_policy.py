"""On-policy learning on the device: the same as on the host, step by step, and wherever the chunks end."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.envs.functional.cart_pole import CartPole
from tests.jax_environments import Forbidden
from tests.sharing import shared_learners
from tests.tiers import only
from tests.training.compiled.same_draws import assert_same_learning

SMALL: dict[str, Any] = {"n_steps": 16, "policy_kwargs": {"net_arch": [8]}, "seed": 3}
PPO = {"batch_size": 8, "n_epochs": 2}
LIMIT = 15
SHORT = CartPole(max_episode_steps=LIMIT)
"""Many episodes are truncated, and some terminate."""


def make(kind: Any, env: Any, n_envs: int = 2, **settings: Any) -> Any:
    """Returns a small agent in environments in JAX."""
    with shared_learners():
        return kind("MlpPolicy", rejeu.make_vector(env, n_envs), **{**SMALL, **settings})


def assert_same_runs(one: Any, two: Any, tolerance: float) -> None:
    """Asserts that two agents have the same parameters, rollouts, episodes and counters."""
    assert_same_learning(one, two, tolerance)
    assert one.run.replay.length == two.run.replay.length
    np.testing.assert_array_equal(one.run.replay.started, two.run.replay.started)


@pytest.mark.parametrize(
    ("kind", "env", "settings"),
    [
        (rejeu.PPO, SHORT, {**PPO, "learning_rate": "lin_1e-3", "normalize": True}),
        pytest.param(rejeu.A2C, SHORT, {"n_steps": 5}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.PQN, SHORT, {**PPO, "exploration_fraction": 0.5}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.PPO, "jax/Pendulum-v1", {**PPO, "target_kl": 1e-4}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.PPO, "jax/Pendulum-v1", {**PPO, "use_sde": True}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.RecurrentPPO, "jax/CartPole-v1", PPO, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.MaskablePPO, Forbidden(), {**PPO, "normalize": True}, marks=pytest.mark.exhaustive),
    ],
)
@pytest.mark.parametrize("n_steps", only([55], [75, 55]))
def test_training_equals_the_loop_of_the_host(kind: Any, env: Any, settings: dict[str, Any], n_steps: int) -> None:
    """The steps are those of whole rollouts, or end within one."""
    device, host = (make(kind, env, **settings) for _ in range(2))
    host.on_device = False
    for agent in (device, host):
        agent.learn(n_steps)
        agent.learn(30, reset_num_timesteps=False)
    assert device.call.stops is not None
    assert host.call.stops is None
    assert device.n_updates > 2
    assert_same_runs(device, host, 1e-3)
    if env is SHORT:
        assert LIMIT in host.history["length"]


def test_a_resumed_run_continues_bit_for_bit(tmp_path: Path) -> None:
    whole, parts = (make(rejeu.PPO, "jax/CartPole-v1", **PPO) for _ in range(2))
    whole.learn(150)
    parts.learn(150, [Checkpoint(tmp_path, every=22), lambda agent, progress: progress.step < 60])
    assert parts.num_timesteps < 150
    assert parts.run.replay.length
    with shared_learners():
        resumed = rejeu.PPO.resume(tmp_path, env=rejeu.make_vector("jax/CartPole-v1", 2))
    assert resumed.resumed.exact
    resumed.learn()
    assert_same_runs(whole, resumed, 0.0)


@pytest.mark.exhaustive
def test_rollouts_of_whole_episodes_train_on_the_host_with_a_warning() -> None:
    agent = make(rejeu.PPO, "jax/CartPole-v1", **PPO, n_episodes=1)
    with pytest.warns(UserWarning, match="n_episodes"):
        agent.learn(40)
    assert agent.num_timesteps == 40
