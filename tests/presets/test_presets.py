import dataclasses
from pathlib import Path

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


ROOT = Path(__file__).parents[2]
PAGES = {
    "parking-v0 SAC": "README.md",
    "rejeu/Ball-v0 TD3": "docs/ball.md",
    "rejeu/Ball-v0 DDPG": "docs/ball.md",
    "rejeu/Ball-v0 SAC": "docs/ball.md",
    "rejeu/CartPoleNoVelocity-v0 RecurrentPPO": "docs/algorithms/ppo.md",
}
"""Where results are stated, if not on the page of the algorithm."""


def test_every_preset_has_a_result_and_every_result_a_preset():
    assert {f"{preset.env_id} {preset.algorithm}" for preset in presets.ALL} == set(presets.results())


@pytest.mark.parametrize("name", presets.results())
def test_results_are_the_same_in_the_documentation(name):
    page = PAGES.get(name, f"docs/algorithms/{name.split()[1].lower()}.md")
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split()).replace("**", "")
    figures = presets.results()[name]["figures"]
    if name.startswith("rejeu/Ball-v0"):  # a cell for each algorithm
        assert f"| {figures} |" in text
    else:
        assert figures in text
    assert figures in next(p.result for p in presets.ALL if f"{p.env_id} {p.algorithm}" == name)
