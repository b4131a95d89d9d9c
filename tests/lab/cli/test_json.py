"""The option ``--json``, exit codes, and what programs read of the documentation."""

import csv
import json
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest

from rejeu.agents import presets
from rejeu.core.interrupt import Stopped
from rejeu.lab import cli
from rejeu.lab.cli import main, runs
from rejeu.lab.cli.commands import COMMANDS, TASKS
from rejeu.teaching.courses import leaderboard

ROOT = Path(__file__).parents[3]
PENDULUM = "Pendulum-v1"
TINY = ["policy_kwargs.net_arch=[8]", "batch_size=8", "buffer_size=5000", "learning_starts=50"]
FEWER_FILES = ["--no-report", "--no-video"]

pytestmark = pytest.mark.usefixtures("learners_are_shared")


class NoInfo(gym.Env):
    """An environment whose ``reset`` returns no info."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        print("a line of the environment")
        return self.observation_space.sample()

    def step(self, action):
        return self.observation_space.sample(), 0.0, True, False, {}


gym.register("rejeu-test/NoInfo-v0", NoInfo)


def document(capsys, *argv, status=0):
    """The JSON document that a command prints, and its messages."""
    assert main([*argv, "--json"]) == status
    printed = capsys.readouterr()
    return json.loads(printed.out, parse_constant=pytest.fail), printed.err


def documented_keys(command):
    """The keys that the documentation lists for a command, the nested ones left out."""
    text = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    (row,) = [row for row in text.splitlines() if re.match(rf"\|.*`{command}`(?! of).* \| `", row)]
    return set(re.findall(r"`(\w+)`", re.sub(r"\([^()]*\)", "", row.split("|")[2]).replace("`null`", "")))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "pendulum"
    argv = ["train", PENDULUM, "--steps", "200", "--seed", "3", "--out", str(out), "--evaluate-episodes", "2"]
    assert main([*argv, *FEWER_FILES, "--backend", "gymnasium", "--log", "json", "--set", *TINY]) == 0
    return out


def test_train_prints_its_summary(capsys, tmp_path):
    argv = [
        "train",
        PENDULUM,
        "--steps",
        "60",
        "--seed",
        "3",
        "--out",
        str(tmp_path / "run"),
        "--evaluate-episodes",
        "1",
    ]
    result, messages = document(capsys, *argv, *FEWER_FILES, "--backend", "gymnasium", "--set", *TINY)
    assert result.keys() == documented_keys("train")
    assert (result["complete"], result["signal"], result["steps"], result["not_written"]) == (True, None, 60, [])
    assert result["best"]["episodes"] == 1
    assert result["best"]["return_interval"] == [None, None]  # of one episode, NaN
    assert set(result["files"]) == {path.name for path in (tmp_path / "run").iterdir()}
    assert "environment   Pendulum-v1" in messages
    assert "60/60 steps" in messages


def test_resume_prints_its_summary_and_continues_the_logs(run, capsys):
    result, messages = document(capsys, "resume", str(run), "--steps", "50", *FEWER_FILES)
    assert result.keys() == documented_keys("resume")
    assert (result["steps"], result["seed"], result["algorithm"], result["env_id"]) == (250, 3, "SAC", PENDULUM)
    table = list(csv.DictReader((run / "episodes.csv").read_text(encoding="utf-8").splitlines()))
    trained, found = result["training"], [float(row["return"]) for row in table]
    assert (result["episodes"], trained["episodes"], trained["mean_length"]) == (1, 1, 200)
    assert (trained["mean_return"], trained["std_return"]) == (pytest.approx(found[0]), 0)
    evaluated = list(csv.DictReader((run / "evaluations.csv").read_text(encoding="utf-8").splitlines()))
    best = max(evaluated, key=lambda row: float(row["mean_return"]))
    assert result["best"]["step"] == int(best["step"])
    assert result["best"]["mean_return"] == pytest.approx(float(best["mean_return"]))
    assert 0 <= result["compile_seconds"] <= result["seconds"]
    assert "checkpoint    resumed at step 200" in messages
    rows = [json.loads(line) for line in (run / "metrics.json").read_text(encoding="utf-8").splitlines()]
    steps = [row["step"] for row in rows]
    assert steps == sorted(steps)
    assert [row["step"] for row in rows if "eval/mean_reward" in row] == [200, 250]


def test_evaluate_prints_the_statistics_and_every_episode(run, capsys):
    result, messages = document(capsys, "evaluate", str(run), "--episodes", "3", "--seed", "0")
    assert result.keys() == documented_keys("evaluate")
    assert sum(result["returns"]) / 3 == pytest.approx(result["mean_return"])
    assert len(result["lengths"]) == len(result["successes"]) == result["episodes"] == 3
    assert "3 episodes" in messages


def test_record_prints_the_path(run, capsys, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    argv = ["record", str(run), "--out", str(tmp_path / "v.mp4"), "--episodes", "1", "--seed", "0"]
    result, _ = document(capsys, *argv)
    assert result.keys() == documented_keys("record")
    assert result["video"] == str(tmp_path / "v.mp4")
    assert (tmp_path / "v.mp4").stat().st_size


def test_list_prints_algorithms_and_presets(capsys):
    result, messages = document(capsys, "list")
    assert result.keys() == documented_keys("list")
    assert "SAC" in result["algorithms"]
    (parking,) = [one for one in result["presets"] if (one["env_id"], one["algorithm"]) == ("parking-v0", "SAC")]
    known, preset = presets.find_result("parking-v0", "SAC"), presets.find("parking-v0", "SAC")
    shown = {key: parking["result"][key] for key in ("measure", "mean", "low", "high", "seeds")}
    assert shown == {key: getattr(known, key) for key in shown}
    for key in ("n_envs", "total_steps", "evaluate_every", "evaluate_episodes"):
        assert parking[key] == getattr(preset, key)
    assert messages == ""


def test_check_prints_its_findings_and_nothing_of_the_environment(capsys):
    result, messages = document(capsys, "check", "rejeu-test/NoInfo-v0", status=1)
    assert result.keys() == documented_keys("check")
    assert result["errors"] == len([one for one in result["findings"] if one["level"] == "error"]) > 0
    assert "a line of the environment" in messages


def test_the_keys_of_a_leaderboard_are_documented():
    board = leaderboard.Leaderboard("CartPole-v1", 50, rows=(), problems=(), language="en", equal=())
    assert {*leaderboard.to_dict(board), "file"} == documented_keys("class")


def test_an_error_leaves_standard_output_empty(capsys):
    assert main(["evaluate", "no-such-run", "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert re.fullmatch(r"rejeu: error: [^\n]+\n", printed.err)


def test_every_command_that_prints_a_result_is_documented_with_its_option():
    text = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    for command, kind in COMMANDS.items():
        assert f"| `rejeu {command}" in text, command
        if "json" in kind.__dataclass_fields__:
            assert documented_keys(command), command


def test_the_documentation_lists_the_commands_as_the_help_does():
    listed = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8").partition("## Commands\n")[2].partition("\n## ")[0]
    sections = [part.partition("\n") for part in listed.split("### ")[1:]]
    named = {title: dict.fromkeys(re.findall(r"`rejeu (\w+)", rows)) for title, _, rows in sections}
    tasks = {task.title(): dict.fromkeys(kind.__name__.lower() for kind in kinds) for task, kinds in TASKS.items()}
    assert [(title, [*names]) for title, names in named.items()] == [(task, [*names]) for task, names in tasks.items()]


@pytest.mark.parametrize("kind", ["wandb", "mlflow", "trackio"])
def test_a_log_that_is_missing_or_unknown_is_an_error_before_training(kind, run, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, kind, None)
    assert main(["train", PENDULUM, "--log", kind]) == 2
    assert capsys.readouterr().err.endswith(f'is not installed; run: pip install "rejeu[{kind}]"\n')
    assert main(["train", PENDULUM, "--log", f"{kind}s"]) == 2
    assert f"--log contains '{kind}s', expected any of 'csv', 'json'" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]
    config = json.loads((run / "config.json").read_text(encoding="utf-8"))
    (tmp_path / "config.json").write_text(json.dumps({**config, "log": ["os"]}), encoding="utf-8")
    assert main(["resume", str(tmp_path)]) == 2
    assert "config.json is damaged: log[0]='os'" in capsys.readouterr().err


def test_exit_codes_are_those_of_the_documentation(monkeypatch, capsys):
    text = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8").partition("## Exit codes")[2]
    cells = re.findall(r"^\| ([\d, ]+) \|", text, re.MULTILINE)
    codes = {int(code) for cell in cells for code in cell.split(",")}
    seen = {main(["list"]), main(["check", "rejeu-test/NoInfo-v0"]), main(["lisst"]), main(["evaluate", "no-such-run"])}
    real = cli.importlib.import_module
    for error in (KeyboardInterrupt(), Stopped(signal.SIGINT), Stopped(signal.SIGTERM)):

        def raise_error(arguments, error=error):
            raise error

        monkeypatch.setattr(
            cli.importlib,
            "import_module",
            lambda name, run=raise_error: SimpleNamespace(run_list=run) if name == "rejeu.lab.cli.list" else real(name),
        )
        seen.add(main(["list"]))
    elsewhere = {129, 141, *runs.EXIT.values()}  # a closed terminal and a closed output have tests of their own
    assert seen | elsewhere == codes == {0, 1, 2, 3, 4, 129, 130, 141, 143}


def test_every_page_that_llms_txt_names_exists():
    text = (ROOT / "llms.txt").read_text(encoding="utf-8")
    named = re.findall(r"^- \[.+\]\(([^)]+)\): \S", text, re.MULTILINE)
    assert len(named) == len(re.findall(r"\]\(", text)) > 20
    assert [path for path in named if not (ROOT / path).is_file()] == []
    assert [command for command in COMMANDS if f"\n- `rejeu {command}" not in text] == []
