"""Settings and statistics of the benchmarks; nothing is timed."""

import json
import tomllib

import pytest

import rejeu
from benchmarks import device_peers, learning
from rejeu.validation import build

ZOO = [(one["env_id"], one["algorithm"]) for one in tomllib.loads(learning.ZOO.read_text("utf-8"))["preset"]]


def peer(turn, library, threads, rate, **more):
    return {
        "round": turn, "case": "dqn", "library": library, "threads_of_process": threads, "steps_per_second": rate,
        "compile_seconds": 1.0, **more,
    }  # fmt: skip


@pytest.mark.parametrize("name", device_peers.CASES)
def test_the_settings_of_rejeu_are_hyperparameters(name):
    kind = rejeu.AGENTS[device_peers.CASES[name].algorithm].algorithm.Config
    config = build(kind, device_peers.settings_of(name, "rejeu"))
    assert config.policy_kwargs.net_arch == (64, 64)
    assert json.loads(json.dumps(device_peers.settings_of(name, "sb3")["policy_kwargs"]["net_arch"])) == [64, 64]


def test_the_settings_of_rejax_have_groups():
    settings = device_peers.settings_of("ppo", "rejax")
    assert settings["agent_kwargs"] == {"hidden_layer_sizes": [64, 64], "activation": "tanh"}
    assert settings["num_minibatches"] * settings_of_rejeu("ppo")["batch_size"] == 16 * settings["num_steps"]


def settings_of_rejeu(name):
    return device_peers.settings_of(name, "rejeu")


def test_ratios_to_a_peer_are_those_of_the_rounds():
    found = [
        *[peer(turn, "rejeu", "", rate) for turn, rate in enumerate((300.0, 100.0, 200.0))],
        peer(0, "rejax", "all threads", 100.0),
        peer(0, "rejax", "1 thread", 50.0),
        *[peer(turn, "rejax", "all threads", rate) for turn, rate in ((1, 100.0), (2, 50.0))],
    ]
    own, other = device_peers.summary(found)
    assert own["steps_per_second"] == 200.0
    assert (other["threads"], other["rounds"], other["steps_per_second"]) == ("all threads", 3, 100.0)
    assert (other["rejeu_to_this"], other["least_ratio"], other["most_ratio"]) == (3.0, 1.0, 4.0)


def test_a_peer_that_failed_has_no_row():
    found = [
        peer(0, "rejeu", "", 1.0),
        {"round": 0, "case": "dqn", "library": "rejax", "threads_of_process": "1 thread", "error": "no"},
    ]
    assert [row["library"] for row in device_peers.summary(found)] == ["rejeu"]


@pytest.mark.parametrize(("env_id", "algorithm"), ZOO)
def test_the_settings_of_rl_zoo_are_hyperparameters_and_a_result_is_published(env_id, algorithm):
    preset = learning.zoo(env_id, algorithm)
    build(rejeu.AGENTS[algorithm].algorithm.Config, dict(preset.hyperparameters))
    published = json.loads((learning.RESULTS.parent / "published.json").read_text("utf-8"))
    assert (algorithm, env_id, preset.total_steps) in {(e["algorithm"], e["env"], e["steps"]) for e in published}
