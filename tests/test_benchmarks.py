"""Settings and statistics of the benchmarks; nothing is timed."""

import json
import tomllib

import pytest

import rejeu
from benchmarks import learning
from rejeu.core.validation import build

ZOO = [(one["env_id"], one["algorithm"]) for one in tomllib.loads(learning.ZOO.read_text("utf-8"))["preset"]]


@pytest.mark.parametrize(("env_id", "algorithm"), ZOO)
def test_the_settings_of_rl_zoo_are_hyperparameters_and_a_result_is_published(env_id, algorithm):
    preset = learning.zoo(env_id, algorithm)
    build(rejeu.AGENTS[algorithm].algorithm.Config, dict(preset.hyperparameters))
    published = json.loads((learning.RESULTS.parent / "published.json").read_text("utf-8"))
    assert (algorithm, env_id, preset.total_steps) in {(e["algorithm"], e["env"], e["steps"]) for e in published}
