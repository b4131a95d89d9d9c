"""``rejeu branch``: a new run from a checkpoint of another."""

import json
import shutil

import numpy as np
import pytest

import rejeu
from rejeu.lab.cli import main
from rejeu.lab.runs.read import read_run
from tests.helpers import error_of
from tests.lab.cli.test_cli import FEWER_FILES, TINY, table

pytestmark = pytest.mark.usefixtures("learners_are_shared")
STEPS = 300
PAUSED = 120


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run with checkpoints of steps 0, 120 and 300."""
    out = tmp_path_factory.mktemp("runs") / "parent"
    argv = ["train", "Pendulum-v1", "--steps", str(STEPS), "--pause", str(PAUSED), "--seed", "3", "--out", str(out)]
    argv += ["--backend", "gymnasium", "--evaluate-every", "100", "--evaluate-episodes", "2", *FEWER_FILES]
    assert main([*argv, "--keep-checkpoints", "3", "--set", *TINY]) == 0
    assert main(["resume", str(out), *FEWER_FILES]) == 0
    return out


def branch(run, out, *more):
    return main(["branch", str(run), "--out", str(out), *FEWER_FILES, *more])


def test_a_branch_without_changes_ends_as_the_run_did(run, tmp_path, capsys):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    assert branch(run, tmp_path / "new", "--at", "200") == 0
    assert f"branch of     {run}, whose checkpoint nearest before step 200 is used" in capsys.readouterr().out
    for name in ("agent.safetensors", "best.safetensors"):
        assert (tmp_path / "new" / name).read_bytes() == (run / name).read_bytes(), name
    for name in ("episodes.csv", "evaluations.csv", "metrics.csv"):
        assert table(tmp_path / "new" / name) == table(run / name), name
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_a_branch_with_other_settings_has_the_first_part_of_the_run(run, tmp_path, capsys):
    out = tmp_path / "new"
    assert branch(run, out, "--at", "120", "--set", "learning_rate=0.1", "gamma=0.5") == 0
    assert "nearest" not in capsys.readouterr().out
    one, two = (table(path / "evaluations.csv") for path in (run, out))
    assert [row["step"] for row in two] == ["100", "200", "300"]
    assert one[0] == two[0]
    assert one[1] != two[1]
    config, parent = (json.loads((path / "config.json").read_text()) for path in (out, run))
    assert config["origin"] == {"run": str(run), "step": 120, "changes": {"learning_rate": 0.1, "gamma": 0.5}}
    changed = {"learning_rate": 0.1, "gamma": 0.5}
    assert config["hyperparameters"] == {**parent["hyperparameters"], **changed}
    assert parent["origin"] is None
    again = f"rejeu branch {run} --at 120 --set learning_rate=0.1 gamma=0.5"
    assert read_run(out).command == again
    assert main(["resume", str(out), "--steps", "10", *FEWER_FILES]) == 0  # it is a run like others


def test_the_best_model_of_a_branch_is_the_best_up_to_its_checkpoint(run, tmp_path, monkeypatch):
    """The other run has since replaced its own."""
    parent = shutil.copytree(run, tmp_path / "parent")
    shutil.copyfile(run / "agent.safetensors", parent / "best.safetensors")
    worse = rejeu.Evaluation(np.array([-1e6]), np.array([5]), np.array([np.nan]))
    monkeypatch.setattr(rejeu.SAC, "evaluate", lambda *_, **__: worse)
    assert branch(parent, tmp_path / "new", "--at", "120") == 0
    assert rejeu.load(tmp_path / "new" / "best.safetensors").num_timesteps == 100


def test_a_complete_run_branches_from_its_end_with_further_steps(run, tmp_path, capsys):
    assert "give --steps N, or --minutes M" in error_of(capsys, "branch", str(run), "--out", str(tmp_path / "new"))
    assert branch(run, tmp_path / "new", "--steps", "20") == 0
    assert rejeu.load(tmp_path / "new" / "agent.safetensors").num_timesteps == STEPS + 20


@pytest.mark.parametrize(
    ("words", "messages"),
    [
        (["--set", "policy_kwargs.net_arch=[9]"], ("float32[3, 9]", "policy_kwargs cannot be changed here")),
        (
            ["--set", "buffer_size=70", "gamma=0.9"],
            ("the replay buffer has 70", "buffer_size, gamma cannot be changed"),
        ),
        (["--set", "optimizer=sgd"], ("optimizer cannot be changed here",)),
        (["--set", "gama=0.9"], ("SAC has no setting 'gama'; did you mean gamma?",)),
        (["--set", "learning_rate=fast"], ("learning_rate='fast' must be a number",)),
    ],
)
def test_what_cannot_change_is_named_and_leaves_no_folder(run, tmp_path, capsys, words, messages):
    out = tmp_path / "new"
    text = error_of(capsys, "branch", str(run), "--at", "120", "--out", str(out), *words)
    assert all(message in text for message in messages)
    assert not out.exists()


def test_what_a_run_cannot_begin_from_is_named(run, tmp_path, capsys):
    assert "is no run folder" in error_of(capsys, "branch", str(tmp_path), "--at", "1")
    assert "name another, or remove it first" in error_of(capsys, "branch", str(run), "--out", str(run))
    assert "must be a whole number of at least 0" in error_of(capsys, "branch", str(run), "--at", "-1")
    other = shutil.copytree(run, tmp_path / "other")
    for name in ("run_000000000000.safetensors", "run_000000000120.safetensors"):
        (other / "checkpoints" / name).unlink()
    text = error_of(capsys, "branch", str(other), "--at", "120")
    assert "--at 120: no checkpoint is of this step or before it; there are those of steps 300" in text
    (other / "checkpoints" / "run_000000000300.safetensors").write_bytes(b"x")
    assert "run_000000000300.safetensors" in error_of(capsys, "branch", str(other))
    shutil.rmtree(other / "checkpoints")
    assert "there is no checkpoint in" in error_of(capsys, "branch", str(other))


def test_resume_does_not_fall_back_to_an_older_checkpoint_that_a_setting_fits(run, tmp_path, capsys):
    """A buffer of 70 rows holds what there was at step 0."""
    other = shutil.copytree(run, tmp_path / "other")
    text = error_of(capsys, "resume", str(other), "--steps", "10", "--set", "buffer_size=70")
    assert "run_000000000300.safetensors" in text
    assert "buffer_size cannot be changed here" in text
