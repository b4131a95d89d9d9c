import dataclasses

import pytest

from rejeu import AGENTS, config, presets


@pytest.mark.parametrize("preset", presets.ALL, ids=lambda preset: f"{preset.env_id}-{preset.algorithm}")
def test_every_preset_is_understood_by_its_algorithm(preset):
    config.build(AGENTS[preset.algorithm].algorithm.Config, preset.hyperparameters)
    assert preset.source


def test_no_environment_has_two_presets_of_one_algorithm():
    names = [(preset.env_id, preset.algorithm) for preset in presets.ALL]
    assert len(names) == len(set(names))


def test_find_returns_the_preset_of_an_environment_and_algorithm():
    assert presets.find("parking-v0").env_id == "parking-v0"
    assert presets.find("parking-v0", "SAC").algorithm == "SAC"


def test_find_returns_none_where_there_is_no_preset():
    assert presets.find("parking-v0", "DQN") is None
    assert presets.find("Taxi-v3") is None


def test_every_default_algorithm_exists():
    assert set(presets.ALGORITHM_FOR.values()) <= set(AGENTS)


def test_a_preset_cannot_be_changed():
    preset = presets.find("parking-v0")
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset.n_envs = 1
    with pytest.raises(TypeError):
        preset.hyperparameters["gamma"] = 0.5
    assert hash(preset)
