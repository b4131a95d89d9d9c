"""Settings and statistics of the benchmarks, and the texts that the pages have of them; nothing is timed."""

import json

import pytest

import rejeu
from benchmarks import device, device_peers, parking_transfer, tables
from rejeu.validation import build

PROVENANCE = {"command": "python it", "device": "cpu (cpu)", "machine": {"cores": 2, "device": "cpu"}}


def measured(name, kind, n_envs, n_seeds, rate):
    return {
        "case": name, "kind": kind, "n_envs": n_envs, "n_seeds": n_seeds, "steps_per_second": rate, "compile_seconds": 2.0
    }  # fmt: skip


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
    assert settings["agent_kwargs"] == {"hidden_layer_sizes": [64, 64], "activation": "swish"}
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


def test_the_text_on_peers_has_ratios_and_differences():
    found = [peer(0, "rejeu", "", 300.0), peer(0, "rejax", "1 thread", 100.0)]
    text = tables.peers(
        {
            **PROVENANCE,
            "results": device_peers.summary(found),
            "versions": {"rejax": {"rejax": "0.1.3"}},
            "differences": device_peers.DIFFERENCES,
        }
    )
    assert "| DQN, CartPole-v1 | Rejax, 1 thread | 100 (100 to 100) | 3.00 | 1.0 s |" in text
    assert "- Rejax treats time limits as terminations" in text


def test_the_tables_of_the_device_compare_with_the_host_and_with_one_seed():
    results = [
        measured("sac", "device", 1, 1, 900.0),
        measured("sac", "host", 1, 1, 300.0),
        measured("sac, 64-64", "host", 1, 1, 100.0),
        measured("sac, 64-64", "host", 1, 8, 200.0),
        measured("sac, 64-64", "host", 4, 1, 999.0),
        {"case": "ppo", "kind": "device", "n_envs": 16, "n_seeds": 1, "error": "no memory"},
    ]
    data = {**PROVENANCE, "results": results}
    assert f"| sac: {device.CASES['sac'].env} | 1 | 900 |  | 300 | 3.0 | 2.0 s |" in tables.device_loops(data)
    assert "| sac, 64-64, on the host | 4.0 |" in tables.device_seeds(data)


def test_success_rates_agree_where_the_interval_of_their_difference_contains_zero():
    def evaluated(n):
        low, high = parking_transfer.wilson(n, 500)
        return {"episodes": 500, "n_successes": n, "success_rate": n / 500, "success_interval": [low, high]}

    near = {"device": evaluated(480), "highway_env": evaluated(475)}
    found = parking_transfer.compared(near)
    # Newcombe's method 10 from Wilson's intervals (0.9390, 0.9740) and (0.9272, 0.9660), by hand
    assert found["interval"] == pytest.approx([-0.0364, 0.0161], abs=5e-4)
    assert found["agree"]
    assert not parking_transfer.compared({"device": evaluated(480), "highway_env": evaluated(400)})["agree"]
    run = {"seed": 3, "steps": 56_000, "training_seconds": 9.0, **near, **found}
    text = tables.transfer(
        {**PROVENANCE, "runs": [run], "all": parking_transfer.pooled([run]), "versions": {"highway-env": "1.12.1"}}
    )
    assert "| seed 3 | 9 s | 96.0 % (93.9 to 97.4) | 95.0 %" in text


def test_the_texts_on_sweeps_have_shares_and_kills():
    share = {
        "seconds": 100.0, "share_of_ideal_of_one_core": 0.95, "share_of_the_times_of_its_processes": 0.97
    }  # fmt: skip
    text = tables.sweep(
        {"command": "it", "runs": 24, "steps": 100, "workers": 2, "cores": 2, "local": share, "ray": share}
    )
    assert "95 % of the ideal" in text.replace("\n", " ")
    kills = {
        "kills": 3,
        "kills_of_a_run": 3,
        "runs": 8,
        "models_that_differ": ["a"],
        "most_seconds_of_training_lost": 2.5,
    }
    text = tables.sweep_kills({"command": "it", "checkpoint_interval_seconds": 3.0, "local": kills})
    assert "| local processes | 3: 3 of a run | 7 of 8 | 2.5 s |" in text


def test_table_of_the_replay_buffer_on_the_device():
    entry = {
        "case": "SAC", "microseconds": {"host": 2.0, "one call": 5.0},
        "of_each_round": {"host": [1.0, 2.0, 3.0], "one call": [4.0, 5.0, 6.0]}, "batch_by_numpy_microseconds": 1.0,
    }  # fmt: skip
    text = tables.device_replay({**PROVENANCE, "results": [entry]})
    assert "of 3 rounds" in text
    assert "| SAC | 2 (1 to 3) | 5 (4 to 6) | 1 |" in text


def test_sentence_on_pqn_counts_the_seeds_that_reached_the_return():
    run = {"reached": {"seconds": 1.25, "steps": 2_000}, "whole_run": {"compile_seconds": 0.5}}
    missed = {"reached": None, "whole_run": {"compile_seconds": 0.75}}
    data = {**PROVENANCE, "env": "jax/CartPole-v1", "target": 500.0, "episodes": 20, "runs": [run, missed]}
    text = " ".join(tables.pqn(data).split())
    assert "after 1.2 to 1.2 s and 2,000 to 2,000 steps (1 of 2 seeds" in text
    assert "up to 0.8 s" in text
