import contextlib

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu import AGENTS
from rejeu.agents import find_preset, presets
from rejeu.core import validation
from rejeu.envs.registry import register
from tests.tiers import exhaustive


@pytest.mark.parametrize("preset", presets.ALL, ids=lambda preset: f"{preset.env_id}-{preset.algorithm}{preset.name}")
def test_every_preset_is_understood_by_its_algorithm(preset):
    validation.build(AGENTS[preset.algorithm].algorithm.Config, preset.hyperparameters)
    assert preset.source


def test_no_environment_has_two_presets_of_one_algorithm():
    names = [(preset.env_id, preset.algorithm, preset.name) for preset in presets.ALL]
    assert len(names) == len(set(names))


def test_find_returns_the_preset_of_an_environment_and_algorithm_or_none():
    assert presets.find("parking-v0").env_id == "parking-v0"
    assert presets.find("parking-v0", "SAC").algorithm == "SAC"
    assert presets.find("parking-v0", "DQN") is None
    assert presets.find("Blackjack-v1") is None


def test_every_default_algorithm_exists():
    assert set(presets.ALGORITHM_FOR.values()) <= set(AGENTS)


def test_every_result_has_a_preset_and_every_preset_a_result_or_says_that_it_is_not_tuned():
    found = {(result.env_id, result.algorithm) for result in presets.results()}
    untuned = {(preset.env_id, preset.algorithm) for preset in presets.ALL if preset.source.endswith("not tuned")}
    known = {(preset.env_id, preset.algorithm) for preset in presets.ALL}
    as_it_is = [result for result in presets.results() if not result.setting]
    assert all(
        presets.named(result.preset, result.env_id).name == result.preset for result in as_it_is if result.preset
    )
    assert {(result.env_id, result.algorithm) for result in as_it_is if not result.preset} <= known <= found | untuned


def test_a_preset_with_a_name_is_for_any_environment():
    assert presets.named("Rainbow", "CartPole-v1").hyperparameters["distribution"] == "categorical"
    assert presets.named("BTR", "MinAtar/Breakout-v1").algorithm == "IQN"
    assert presets.named("", "CartPole-v1") is None
    assert presets.named("Rainbw", "CartPole-v1") is None
    with pytest.raises(ValueError, match="the preset Rainbow is for DQN, not for PPO"):
        find_preset("CartPole-v1", "PPO", "Rainbow")
    assert find_preset("CartPole-v1", None, "Rainbow") == presets.named("Rainbow", "CartPole-v1")


def test_a_preset_with_a_name_is_first_that_of_the_algorithm_and_then_that_of_the_environment():
    names = [one for one in presets.ALL if one.name]
    for one in names:
        assert presets.named(one.name, one.env_id, one.algorithm) is one
        assert {presets.named(one.name, other.env_id, one.algorithm).algorithm for other in names} == {one.algorithm}


def test_sizes_are_presets_of_each_algorithm_with_a_name():
    widths = lambda found: found.hyperparameters["policy_kwargs"]["net_arch"]["qf"]  # noqa: E731
    found = {name: find_preset("Hopper-v5", name, "small") for name in ("FlashSAC", "XQC")}
    assert {name: widths(one) for name, one in found.items()} == {"FlashSAC": [64, 64], "XQC": [128, 128]}
    assert find_preset("Pendulum-v1", "XQC", "small").total_steps < found["XQC"].total_steps
    assert presets.small("DQN") == find_preset("CartPole-v1", "DQN", "small").hyperparameters != presets.small("XQC")
    assert presets.small("PPO") == {}
    assert find_preset("Pendulum-v1", "FlashSAC", "full").hyperparameters == {}
    assert presets.find("HalfCheetah-v5") is None
    assert presets.find("Pendulum-v1", "FlashSAC") is None


GOALS = [
    preset.env_id
    for preset in presets.ALL
    if preset.hyperparameters.get("replay_buffer_class") == "HerReplayBuffer" and preset.algorithm == "SAC"
]


@exhaustive
@pytest.mark.parametrize("env_id", GOALS)
def test_a_preset_of_a_goal_task_learns_with_the_backend_it_names(env_id):
    """2,000 steps with updates from step 1,800 on; every weight moves and stays finite."""
    preset = presets.find(env_id)
    if not (env_id in gym.registry or register(env_id)):
        pytest.skip("needs gymnasium-robotics")
    with contextlib.closing(rejeu.make_vector(env_id, 2, preset.backend, seed=0)) as env:
        settings = {**preset.hyperparameters, "learning_starts": 1_800, "buffer_size": 2_000}
        agent = AGENTS[preset.algorithm]("MultiInputPolicy", env, seed=0, **settings)
        before = agent.get_parameters()
        agent.learn(2_000)
        assert agent.num_timesteps == 2_000
        assert agent.n_updates > 0
        after = agent.get_parameters()
        assert all(np.isfinite(value).all() for value in after.values())
        assert any((after[name] != before[name]).any() for name in before if name.startswith("actor."))


def test_a_result_is_of_the_preset_as_it_is_or_of_the_named_one_and_shows_its_interval():
    result = presets.find_result("Pendulum-v1", "TD3")
    assert str(result) == f"mean return {result.mean:.1f} ({result.low:.1f} to {result.high:.1f}), {result.seeds} seeds"
    assert presets.find_result("CartPole-v1", "PPO").setting == ""
    assert presets.find_result("Blackjack-v1", "DQN") is None
    small = presets.find_result("HalfCheetah-v5", "FlashSAC", "small")
    assert (small.seeds, small.preset) == (1, "small")
    assert "1 seed" in str(small).split(", ")
    assert presets.find_result("HalfCheetah-v5", "FlashSAC", "full") is None


def test_names_of_presets_have_no_case_and_are_listed_for_a_wrong_one():
    assert presets.named("rainbow", "CartPole-v1") == presets.named("Rainbow", "CartPole-v1")
    with pytest.raises(FileNotFoundError, match="with a name are Rainbow, BTR, small, full"):
        find_preset("CartPole-v1", None, "Rainbw")


def test_environments_in_jax_have_the_presets_of_their_twins():
    preset, twin = presets.find("jax/Parking-v0"), presets.find("parking-v0")
    assert dict(preset.hyperparameters) == dict(twin.hyperparameters)
    assert (preset.env_id, preset.backend, preset.n_envs) == ("jax/Parking-v0", "jax", twin.n_envs)
    assert presets.find("jax/Parking-v0", "DQN") is None
    assert {*presets.TWINS.values()} <= {preset.env_id for preset in presets.ALL}
