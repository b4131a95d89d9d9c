"""The commands compare, runs and status, whose rows are those of the studio."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rejeu.lab import cli
from tests.lab.reporting.test_comparison import HOSTILE, write_run

ROOT = Path(__file__).parents[3]


@pytest.fixture
def runs(tmp_path):
    for algorithm, base in (("DQN", 10.0), ("PPO", 20.0)):
        for seed in range(3):
            write_run(tmp_path / "runs" / f"{algorithm}_{seed}", algorithm, seed=seed, level=base + seed)
    return tmp_path / "runs"


def test_compare_prints_groups_and_writes_files(runs, tmp_path, capsys):
    out = tmp_path / "table.csv"
    assert cli.main(["compare", str(runs), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "PPO scores higher than DQN on CartPole-v1 with probability 100%" in printed
    assert "final score: mean return of the training episodes" in printed
    assert "those of 3 runs contain the true score in 75 % of cases" in printed
    assert "steps to" not in printed  # every curve reaches a threshold that is made from it
    assert out.read_text(encoding="utf-8").startswith("group,env,runs,iqm")


def test_compare_as_json(runs, capsys):
    arguments = ["--by", "env", "--x", "time", "--score", "evaluation", "--json", "--reference", "CartPole-v1=0,100"]
    assert cli.main(["compare", *map(str, sorted(runs.iterdir())), *arguments]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [(group["group"], group["runs"]) for group in content["groups"]] == [("CartPole-v1", 6)]
    assert content["groups"][0]["mean"] == pytest.approx(0.17)
    row = next(
        line for line in (ROOT / "docs" / "cli.md").read_text(encoding="utf-8").split("\n") if "| `compare` |" in line
    )
    documented = set(re.findall(r"`(\w+)`", row)) - {"compare", "steps_to_threshold"}
    assert documented == {
        *content,
        *content["groups"][0],
        "label",
        "other",
        "env_id",
        "probability",
        "low",
        "high",
        "pairs",
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--reference", "CartPole-v1=1"], "--reference 'CartPole-v1=1' must be ENV=LOW,HIGH"),
        (["--by", "seed"], "--by"),
        (["--threshold", "nan"], "--threshold=nan must be a finite number"),
        (["--reference", "CartPole-v1=5,inf"], "must be two returns, the lower first"),
        (["--out", "a.pdf"], "'a.pdf' must end in md, csv, json, png, html, or be a folder"),
    ],
)
def test_errors_are_one_line(runs, capsys, arguments, message):
    assert cli.main(["compare", str(runs), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_runs_lists_every_run(runs, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    write_run(runs / "odd", HOSTILE)
    assert cli.main(["runs", str(runs)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("finished") == 7
    assert "21.00" in printed
    assert cli.main(["runs", str(runs), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert sorted(Path(row["run"]).name for row in content["runs"]) == sorted(path.name for path in runs.iterdir())
    assert [len(row["curve"]) for row in content["runs"]] == [40] * 7


def test_runs_are_whole_lines_in_a_pipe(runs, capsys):
    write_run(runs / ("long" * 30), steps=1000)
    config = runs / "PPO_0" / "config.json"
    config.write_text(config.read_text(encoding="utf-8").replace("1000", "5000"), encoding="utf-8")
    (runs / "DQN_0" / "evaluations.csv").unlink()
    assert cli.main(["runs", str(runs)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum("long" * 30 in line and "finished" in line for line in lines) == 1
    assert any("PPO_0" in line and "1,000 of 5,000 (20%)" in line and "interrupted" in line for line in lines)
    assert any("DQN_0" in line and " in training" in line for line in lines)


@pytest.mark.skipif(os.name == "nt", reason="Windows allows no such name")
def test_names_cannot_control_the_terminal(runs, capsys):
    write_run(runs / "a\x1b[2J\nb")
    assert cli.main(["runs", str(runs)]) == 0
    printed = capsys.readouterr().out
    assert "\x1b" not in printed
    assert r"a\x1b[2J\nb" in printed
    (runs / "empty").mkdir()
    assert cli.main(["runs", str(runs / "empty")]) == 0
    assert "there are no runs in" in capsys.readouterr().out


def test_status(runs, capsys):
    assert cli.main(["status", str(runs / "DQN_0")]) == 0
    assert re.search(r"DQN_0 +CartPole-v1 +DQN +finished +1,000 +11.00", capsys.readouterr().out)
    assert cli.main(["status", str(runs / "DQN_0"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["state"], content["best"]["mean_return"]) == ("finished", 11.0)
    write_run(runs / "short", steps=1000, every=10)
    config = runs / "short" / "config.json"
    config.write_text(config.read_text(encoding="utf-8").replace("1000", "5000"), encoding="utf-8")
    capsys.readouterr()
    (runs / "short" / "warnings.txt").write_text("the reward\x1b is large\n", encoding="utf-8")
    assert cli.main(["status", str(runs / "short")]) == 3
    printed = capsys.readouterr().out
    assert "1,000 of 5,000 (20%)" in printed
    assert r"warning: the reward\x1b is large" in printed
    assert cli.main(["status", str(runs / "none")]) == 2


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")
def test_runs_are_followed_until_ctrl_c(runs):
    command = [sys.executable, "-m", "rejeu", "runs", str(runs), "--follow"]
    env = {**os.environ, "PYTHONUNBUFFERED": "1"}
    ended = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", env=env
    )
    for line in ended.stdout:
        if "PPO_2" in line:
            break
    (runs / "DQN_0" / "agent.safetensors").unlink()
    for line in ended.stdout:
        if "DQN_0" in line:
            break
    assert "crashed" in line
    ended.terminate()
    assert ended.communicate(timeout=60)[1].strip() == "rejeu: no longer followed"
