"""When agents train on the device, and what callbacks are told if they need what a chunk hides."""

import gc
import weakref
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import rejeu
from rejeu.agents import device
from rejeu.callbacks import TrainingCallback
from rejeu.lab.cli import main
from rejeu.sb3.common.callbacks import BaseCallback
from tests.tiers import exhaustive, only
from tests.training.compiled.test_off_policy import make


def rewards_of(agent: Any, progress: Any) -> None:
    """Looks at the rewards of a step."""
    assert progress.result.reward.shape == (1,)


class Rewards(TrainingCallback):
    """Looks at the rewards of every step."""

    every_step = True

    def __call__(self, agent: Any, progress: Any) -> None:
        rewards_of(agent, progress)


class Rewards3(BaseCallback):
    """Likewise, as in Stable-Baselines3."""

    def _on_step(self) -> bool:
        return bool(self.locals["rewards"].shape == (1,))


def test_a_callback_that_looks_at_single_steps_is_told_what_to_do() -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1")
    with pytest.raises(AttributeError, match="'NoneType' object has no attribute 'reward'") as raised:
        agent.learn(30, rewards_of)
    (note,) = raised.value.__notes__
    assert "progress.result" in note
    assert "agent.on_device = False" in note
    assert "\n" not in note
    agent.on_device = False
    assert agent.learn(30, rewards_of).num_timesteps == 30


def test_other_errors_of_callbacks_are_left_alone() -> None:
    def fails(agent: Any, progress: Any) -> None:
        raise TypeError("no such option")

    with pytest.raises(TypeError) as raised:
        make(rejeu.DQN, "jax/CartPole-v1").learn(30, fails)
    assert not hasattr(raised.value, "__notes__")


@pytest.mark.parametrize("callback", only([Rewards3], [Rewards, Rewards3]))
def test_callbacks_of_every_step_train_on_the_host_and_are_named(callback: Any) -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1")
    with pytest.warns(UserWarning, match=f"the callback {callback.__name__} must be called after every step"):
        agent.learn(30, callback())
    assert agent.num_timesteps == 30
    agent.on_device = True
    with pytest.raises(ValueError, match=f"on_device=True is not possible: the callback {callback.__name__} must"):
        agent.learn(30, callback())


def test_an_agent_that_must_train_on_the_device_says_why_it_cannot() -> None:
    agent = rejeu.DQN("MlpPolicy", rejeu.make_vector("CartPole-v1"), policy_kwargs={"net_arch": [8]})
    agent.on_device = True
    with pytest.raises(ValueError, match="the backend of CartPole-v1 is 'gymnasium', not 'jax'"):
        agent.learn(30)


@pytest.mark.parametrize("env", ["jax/CartPole-v1", "CartPole-v1"])
def test_more_steps_than_32_bits_count_are_refused(env: str) -> None:
    with pytest.raises(ValueError, match=r"would end at step 5,000,000,000, and steps are counted up to 4,294,967,294"):
        make(rejeu.DQN, env).learn(5_000_000_000)


@pytest.mark.parametrize("env", ["jax/CartPole-v1", "CartPole-v1"])
def test_a_run_without_a_limit_of_steps_ends_where_they_cannot_be_counted(env: str) -> None:
    agent = make(rejeu.DQN, env)
    agent.run.step = 2**32 - 10
    agent.learn(minutes=1.0, reset_num_timesteps=False)
    assert agent.run.step == 2**32 - 2
    assert agent.call.training_call.is_over(agent.run)


def test_the_progress_bar_counts_the_steps_of_a_first_chunk_of_many_turns(capsys: Any) -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1")
    agent.learn(30, progress_bar=True)
    assert "100%  30/30 steps" in capsys.readouterr().out
    agent.learn(31, progress_bar=True)
    assert "100%  31/31 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    "limit",
    only(
        [{"episodes": 5}],
        [{"total_timesteps": n} for n in (150, 200, 250)] + [{"episodes": 5}],
    ),
    ids=str,
)
def test_all_episodes_are_judged_when_learn_reaches_its_limit(limit: Any, monkeypatch: Any) -> None:
    """Before that, once in 100 turns."""
    monkeypatch.setattr(device, "MAX_TURNS", 100)
    monkeypatch.setattr("rejeu.training.compiled.MAX_TURNS", 100)
    agent = make(rejeu.DQN, "jax/CartPole-v1", learning_starts=10_000, best_window=3).learn(**limit)
    assert agent.call.stops is not None
    means = np.convolve(agent.history["return"], np.full(3, 1 / 3), "valid")
    assert agent.best is not None
    assert agent.best.score == pytest.approx(means.max())
    assert agent.best.step in (100, 200, agent.num_timesteps)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--seeds", "0"], "--seeds=0 must be a whole number of at least 1"),
        (["--seeds", "2", "--pause", "10"], "--pause is for a single run; leave it out, or --seeds"),
        (["--seeds", "2", "--set", "learning_rate=[1e-3,1e-4]"], "learning_rate=[0.001, 0.0001]"),
        (["--seeds", "2", "--algo", "MaskablePPO"], "CartPole.action_mask returned None, expected a mask"),
    ],
)
def test_what_seeds_cannot_be_combined_with_is_said_in_one_line(
    options: list[str], said: str, tmp_path: Path, capsys: Any
) -> None:
    argv = ["train", "jax/CartPole-v1", "--algo", "DQN", "--steps", "30", "--out", str(tmp_path / "runs")]
    assert main([*argv, *options]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert not (tmp_path / "runs").exists()


@exhaustive
@pytest.mark.parametrize("seeds", only([2], [1, 2]))
def test_compiled_programs_are_collected_with_their_agents(seeds: int) -> None:
    settings: dict[str, Any] = {"learning_starts": 10, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    agents = rejeu.train_seeds(rejeu.DQN, "MlpPolicy", "jax/CartPole-v1", 30, seeds=seeds, **settings)
    kept = weakref.ref(agents[0].learner.algorithm.update)
    assert kept() is not None
    del agents
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize(
    ("kind", "env_id", "settings"),
    [
        pytest.param(rejeu.PPO, "jax/CartPole-v1", {"n_steps": 16, "batch_size": 16}, marks=exhaustive),
        pytest.param(rejeu.PQN, "jax/CartPole-v1", {"n_steps": 16}, marks=exhaustive),
        (rejeu.PQN, "CartPole-v1", {"n_steps": 16}),
        pytest.param(
            rejeu.SAC,
            "jax/Pendulum-v1",
            {"priorities": {}, "learning_starts": 20, "batch_size": 8},
            marks=exhaustive,
        ),
    ],
)
def test_agents_train_where_jax_computes_in_64_bits(kind: Any, env_id: str, settings: Any) -> None:
    with jax.enable_x64(True):
        agent = kind("MlpPolicy", env_id, policy_kwargs={"net_arch": [4]}, seed=0, **settings).learn(64)
        assert agent.n_updates > 0
        assert all(array.dtype != np.float64 for array in agent.get_parameters().values())
