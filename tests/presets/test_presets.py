import dataclasses

import pytest

from rejeu import AGENTS, presets, validation


@pytest.mark.parametrize("preset", presets.ALL, ids=lambda preset: f"{preset.env_id}-{preset.algorithm}")
def test_every_preset_is_understood_by_its_algorithm(preset):
    validation.build(AGENTS[preset.algorithm].algorithm.Config, preset.hyperparameters)
    assert preset.source


def test_no_environment_has_two_presets_of_one_algorithm():
    names = [(preset.env_id, preset.algorithm) for preset in presets.ALL]
    assert len(names) == len(set(names))


def test_find_returns_the_preset_of_an_environment_and_algorithm():
    assert presets.find("parking-v0").env_id == "parking-v0"
    assert presets.find("parking-v0", "SAC").algorithm == "SAC"


def test_find_returns_none_where_there_is_no_preset():
    assert presets.find("parking-v0", "DQN") is None
    assert presets.find("Blackjack-v1") is None


def test_every_default_algorithm_exists():
    assert set(presets.ALGORITHM_FOR.values()) <= set(AGENTS)


def test_a_preset_cannot_be_changed():
    preset = presets.find("parking-v0")
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset.n_envs = 1
    with pytest.raises(TypeError):
        preset.hyperparameters["gamma"] = 0.5
    assert hash(preset)


def test_every_preset_has_a_result_and_every_result_a_preset():
    found = {(result.env_id, result.algorithm) for result in presets.results()}
    assert found == {(preset.env_id, preset.algorithm) for preset in presets.ALL}


def test_result_shows_mean_interval_and_seeds():
    result = presets.find_result("Pendulum-v1", "TD3")
    assert str(result) == f"mean return {result.mean:.1f} ({result.low:.1f} to {result.high:.1f}), {result.seeds} seeds"


def test_first_result_is_of_the_preset_as_it_is():
    assert presets.find_result("CartPole-v1", "PPO").setting == ""
    assert presets.find_result("Blackjack-v1", "DQN") is None


def test_environments_in_jax_have_the_presets_of_their_twins():
    preset, twin = presets.find("jax/Parking-v0"), presets.find("parking-v0")
    assert dict(preset.hyperparameters) == dict(twin.hyperparameters)
    assert (preset.env_id, preset.backend, preset.n_envs) == ("jax/Parking-v0", "jax", twin.n_envs)
    assert presets.find("jax/Parking-v0", "DQN") is None
    assert {*presets.TWINS.values()} <= {preset.env_id for preset in presets.ALL}
