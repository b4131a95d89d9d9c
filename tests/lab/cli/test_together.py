"""``rejeu train jax/ENV --seeds N``: the seeds are trained in one program."""

import json

import pytest

from rejeu.lab import cli
from rejeu.lab.cli import sweep
from rejeu.lab.runs.arguments import Train

TINY = ["--set", "policy_kwargs.net_arch=[8]", "batch_size=8", "learning_starts=20", "buffer_size=200"]


@pytest.mark.exhaustive
def test_seeds_in_one_program_write_a_run_folder_each_and_a_comparison(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["train", "jax/CartPole-v1", "--algo", "DQN", "--seeds", "2", "--seed", "3", "--steps", "120", "--no-video"]
    words += ["--evaluate-every", "60", "--evaluate-episodes", "2", "--out", str(out), "--json", "--device", "cpu"]
    assert cli.main([*words, *TINY]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert [(run["seed"], run["exit_status"]) for run in result["runs"]] == [(3, 0), (4, 0)]
    assert "2 seeds in one program" in printed.err
    for seed in (3, 4):
        folder = out / f"seed_{seed}"
        files = {"agent.safetensors", "best.safetensors", "config.json", "curve.png", "episodes.csv", "evaluations.csv"}
        assert files <= {path.name for path in folder.iterdir()}
        config = json.loads((folder / "config.json").read_text())
        assert (config["seed"], config["device"]) == (seed, "cpu")
        assert len((folder / "evaluations.csv").read_text().splitlines()) == 3
    assert (out / "compare.html").is_file()
    path = out / "seed_3" / "config.json"
    path.write_text(path.read_text().replace('"device": "cpu"', '"device": "gpu"'))  # as on a machine that has one
    assert cli.main(["resume", str(out / "seed_3"), "--steps", "40", "--no-video"]) == 0
    assert len((out / "seed_3" / "evaluations.csv").read_text().splitlines()) == 4


def test_seeds_are_trained_in_one_program_unless_processes_are_asked_for():
    assert sweep.fit_together(Train(env="jax/CartPole-v1", seeds=2))
    assert not sweep.fit_together(Train(env="jax/CartPole-v1", seeds=2, jobs=2))
    assert not sweep.fit_together(Train(env="CartPole-v1", seeds=2))
    assert not sweep.fit_together(Train(env="jax/CartPole-v1", seeds=2, wrappers=("my_env:Shaped",)))
