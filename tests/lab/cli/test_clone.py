"""``rejeu clone`` and ``rejeu train --offline``."""

import json
from pathlib import Path
from typing import Any

import equinox as eqx
import pytest

import rejeu
from rejeu.demonstrations import record
from rejeu.lab.cli import main
from rejeu.logs.tables import read_table
from tests.helpers import error_of
from tests.tiers import exhaustive

pytest.importorskip("minari")
pytestmark = pytest.mark.usefixtures("learners_are_shared")

TINY = ["policy_kwargs.net_arch=[16]"]
FEWER_FILES = ["--no-report", "--no-video", "--evaluate-episodes", "3"]


class Balance:
    """Balances the pole for a while."""

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[int, None]:
        return int(obs[2] + 0.5 * obs[3] > 0), None


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "shown"
    record(Balance(), "CartPole-v1", 3, folder, seed=0)
    return folder


def printed(capsys: Any, *argv: Any) -> dict[str, Any]:
    """Returns what a command prints as JSON."""
    assert main([*map(str, argv), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_clone_is_a_run_that_is_evaluated_and_trained_on(shown, tmp_path, capsys):
    out = tmp_path / "clone"
    how = ["--algo", "PPO", "--updates", 400, "--learning-rate", "1e-2", "--seed", 0, "--out", out]
    found = printed(capsys, "clone", shown, *how, *FEWER_FILES, "--set", *TINY, "n_steps=64")
    assert found["demonstrations"]["episodes"] == 3
    assert found["demonstrations"]["mean_return"] > 100
    assert found["best"]["mean_return"] > 60  # nothing learned has about 20
    assert found["complete"]
    assert {"agent.safetensors", "best.safetensors", "evaluations.csv", "config.json"} <= set(found["files"])
    assert printed(capsys, "evaluate", out, "--episodes", 2)["env_id"] == "CartPole-v1"
    resumed = printed(capsys, "resume", out, "--steps", 64, "--no-report", "--no-video")
    assert resumed["steps"] == 8 * 64  # a rollout of the preset's environments


@exhaustive
def test_critics_learn_after_cloning_and_training_goes_on(shown, tmp_path, capsys):
    actors, steps = [], []
    for n in (0, 3):
        out = tmp_path / str(n)
        how = ["--algo", "SAC", "--updates", 5, "--critic-updates", n, "--seed", 0, "--out", out]
        printed(capsys, "clone", shown, *how, *FEWER_FILES, "--set", *TINY, f"demonstrations={shown}")
        agent = rejeu.SAC.load(out / "agent.safetensors")
        state = agent.learner.state(agent.run.state)
        actors, steps = [*actors, state.actor], [*steps, int(state.n_updates)]
    assert eqx.tree_equal(*actors)
    assert steps == [0, 3]
    assert printed(capsys, "resume", out, "--steps", 110, "--no-report", "--no-video")["steps"] == 110


@exhaustive
def test_an_expert_labels_what_the_clone_does(shown, tmp_path, capsys):
    expert = rejeu.PPO("MlpPolicy", "CartPole-v1", seed=0).save(tmp_path / "expert")
    how = ["--algo", "PPO", "--updates", 5, "--seed", 0, "--expert", expert, "--rounds", 2, "--round-steps", 30]
    assert main([*map(str, ["clone", shown, *how, "--out", tmp_path / "clone", *FEWER_FILES, "--set", *TINY])]) == 0
    text = capsys.readouterr().out
    assert [text.count(f"round  {i} ") for i in range(4)] == [1, 1, 1, 0]
    assert "; the demonstrations have " in text


def test_what_does_not_fit_is_one_line(shown, tmp_path, capsys):
    assert "holds no Minari dataset" in error_of(capsys, "clone", str(tmp_path))
    clone = ["clone", str(shown), "--out", str(tmp_path / "run"), "--set", *TINY, "--algo"]
    assert "observation space" in error_of(capsys, *clone, "PPO", "--env", "MountainCar-v0")
    assert "PPO has no critics" in error_of(capsys, *clone, "PPO", "--critic-updates", "1")
    memory = ["RecurrentPPO", "--set", "policy_kwargs.lstm_hidden_size=4"]
    assert "has a memory" in error_of(capsys, *clone, *memory)
    offline = ["--offline", str(shown), "--out", str(tmp_path / "o")]
    assert "PPO has none" in error_of(capsys, "train", "CartPole-v1", "--algo", "PPO", *offline)
    assert "IQL" in error_of(capsys, "train", "CartPole-v1", *offline)
    assert "give demonstrations" in error_of(capsys, "train", "Pendulum-v1", "--algo", "IQL", "--set", "offline=true")


@exhaustive
def test_a_run_without_an_environment_is_a_run(tmp_path, capsys):
    with_random = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0)
    record(with_random, "Pendulum-v1", 1, tmp_path / "shown", seed=0)
    out = tmp_path / "run"
    how = ["--steps", 1200, "--seed", 0, "--evaluate-every", 600, "--out", out, "--set", *TINY, "batch_size=16"]
    paused = printed(
        capsys, "train", "Pendulum-v1", "--offline", tmp_path / "shown", *how, *FEWER_FILES, "--pause", 400
    )
    assert not paused["complete"]
    found = printed(capsys, "resume", out, "--no-report", "--no-video")
    assert found["complete"]
    assert (found["algorithm"], found["steps"], found["episodes"]) == ("IQL", 1200, 0)
    assert read_table(out / "evaluations.csv", ("step",)).column("step").tolist() == [600, 1200]
    assert "train/value_loss" in (out / "metrics.csv").read_text()
    more = ["--no-report", "--no-video", "--steps", 210, "--set", "offline=false", "learning_starts=0"]
    online = printed(capsys, "resume", out, *more)
    assert online["steps"] == 1410
    assert online["episodes"] == 1
