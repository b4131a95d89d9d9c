import csv
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import rejeu
from rejeu.agents import AGENTS
from rejeu.callbacks import Evaluate
from rejeu.checkpoints import run_folder as folder
from rejeu.lab import cli
from rejeu.lab.cli import main
from rejeu.lab.reporting.report.page import plotly_script
from rejeu.lab.runs import config
from rejeu.lab.runs.begin import untuned
from rejeu.logs.logging import CsvFile
from tests.bad_environments import RewardReadsInfo
from tests.environments import Counter, Reach
from tests.full_disk import FullDisk
from tests.helpers import assert_same_parameters, error_of
from tests.tiers import exhaustive

FILES = {
    "agent.safetensors",
    "best.safetensors",
    "checkpoints",
    "config.json",
    "curve.png",
    "episodes.csv",
    "evaluations.csv",
    "metrics.csv",
    "models",
    "report.html",
    "video.mp4",
}
TINY = ["policy_kwargs.net_arch=[8]", "batch_size=8", "buffer_size=5000", "learning_starts=50"]
FEWER_FILES = ["--no-report", "--no-video"]
"""Without what takes longer than such a training."""

pytestmark = pytest.mark.usefixtures("learners_are_shared")


class Words(gym.Env):
    """An environment whose actions nothing here takes."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Text(3)


class Switches(gym.Env):
    """An environment whose actions SAC does not take."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.MultiBinary(3)


class Broken(gym.Env):
    """An environment whose 120th reward is NaN; its episodes have 50 steps."""

    observation_space = gym.spaces.Box(np.array([-1, -1, -8], np.float32), np.array([1, 1, 8], np.float32))
    action_space = gym.spaces.Box(-2, 2, (1,))  # those of Pendulum, so that nothing is compiled for it alone
    steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(3, np.float32), np.nan if self.steps == 120 else 1.0, False, self.steps % 50 == 0, {}


gym.register("rejeu-test/Words-v0", Words)
gym.register("rejeu-test/Switches-v0", Switches)
gym.register("rejeu-test/Broken-v0", Broken)


CUBE = gym.spaces.Box(-1, 1, (3,))


def train(out, *more, env="Pendulum-v1", steps=850):
    return main(
        ["train", env, "--steps", str(steps), "--out", str(out), "--evaluate-episodes", "2", *more, "--set", *TINY]
    )


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a short run."""
    out = tmp_path_factory.mktemp("runs") / "pendulum"
    assert train(out, "--seed", "3", "--evaluate-every", "400", "--backend", "gymnasium") == 0
    return out


def test_train_leaves_a_complete_run_folder(run):
    assert {path.name for path in run.iterdir()} == FILES
    assert all(path.stat().st_size for path in run.iterdir())


def test_config_holds_what_repeats_the_run(run):
    config = json.loads((run / "config.json").read_text())
    assert (config["env"], config["algorithm"], config["seed"], config["n_envs"]) == ("Pendulum-v1", "SAC", 3, 1)
    assert (config["steps"], config["minutes"], config["backend"]) == (850, None, "gymnasium")
    assert config["hyperparameters"]["policy_kwargs"]["net_arch"] == [8]
    assert config["hyperparameters"]["learning_rate"] == 1e-3  # the preset's
    assert {"rejeu", "jax", "numpy", "gymnasium", "envpool"} <= set(config["versions"])
    again = rejeu.SAC("MlpPolicy", "Pendulum-v1", **config["hyperparameters"])
    assert again.config == rejeu.load(run / "agent.safetensors").config


def test_tables_hold_every_episode_and_evaluation(run):
    assert [float(row["step"]) for row in rows(run / "episodes.csv")] == [200, 400, 600, 800]
    assert [int(row["step"]) for row in rows(run / "evaluations.csv")] == [400, 800, 850]
    assert "train/critic_loss" in rows(run / "metrics.csv")[0]


def test_the_best_model_is_that_of_the_best_evaluation(run):
    table = rows(run / "evaluations.csv")
    last_best = max(i for i, row in enumerate(table) if row["best"] == "1")
    assert last_best == np.argmax([float(row["mean_return"]) for row in table])
    counters = rejeu.load(run / "best.safetensors").num_timesteps
    assert counters == int(table[last_best]["step"])


@pytest.mark.needs_envpool
def test_train_says_what_it_does_and_what_came_of_it(tmp_path, capsys):
    assert train(tmp_path / "run", "--seed", "1", *FEWER_FILES, steps=60) == 0
    text = capsys.readouterr().out
    assert "environment   Pendulum-v1, 1 at once\nbackend       envpool\n" in text
    assert "SAC, preset, seed 1" in text
    assert "60/60 steps" in text
    assert "95 % CI" in text
    assert re.search(r"[\d.]+ s in all, [\d.]+ s of them compiling", text)


@pytest.mark.usefixtures("untrained")
def test_a_preset_for_envpool_trains_on_gymnasium_without_it_and_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "envpool", None)
    assert train(tmp_path / "run", "--seed", "1") == 0
    said = (
        'backend       gymnasium; EnvPool would be faster (about 770 MB with its assets): pip install "rejeu[envpool]"'
        ", or train jax/Pendulum-v1"
    )
    assert said in capsys.readouterr().out
    assert json.loads((tmp_path / "run" / "config.json").read_text())["backend"] == "gymnasium"


@pytest.mark.needs_envpool
@pytest.mark.usefixtures("untrained")
def test_goal_environments_are_trained_with_hindsight(tmp_path):
    assert train(tmp_path / "run", "--envs", "2", env="parking-v0") == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["policy"] == "MultiInputPolicy"
    assert config["hyperparameters"]["replay_buffer_class"] == "HerReplayBuffer"
    assert (config["n_envs"], config["backend"]) == (2, "envpool")


def test_an_environment_that_fails_to_render_has_no_video(tmp_path, capsys):
    """The run is complete all the same: what ``render`` raises can be of any kind."""
    (tmp_path / "unseen.py").write_text(
        "import gymnasium as gym\n"
        "class Unseen(gym.envs.classic_control.CartPoleEnv):\n"
        "    def render(self):\n"
        "        raise KeyError('palette')\n"
        "gym.register('Unseen-v0', Unseen, max_episode_steps=50)\n"
    )
    assert train(tmp_path / "run", "--import", str(tmp_path / "unseen.py"), env="Unseen-v0", steps=60) == 0
    assert "no video: KeyError('palette')" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "run").iterdir()} - {"warnings.txt"} == FILES - {"video.mp4"}


def test_where_jax_is_not_installed_a_command_says_what_to_install(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rejeu.lab.cli.list", None)
    monkeypatch.setattr(cli.errors, "installed", {"msgspec": "0.19"}.get)
    assert "only rejeu.load_policy can do without: install them" in error_of(capsys, "list")


def test_without_the_video_extra_the_run_goes_on_and_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "plotly", None)
    plotly_script.cache_clear()
    assert train(tmp_path / "run", "--backend", "gymnasium", steps=60) == 0
    text = capsys.readouterr().out
    assert re.search(r"no report: .*rejeu\[report\]", text)
    assert re.search(r"no curve: .*rejeu\[plot\]", text)
    assert re.search(r"no video: .*rejeu\[video\]", text)
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES - {"curve.png", "report.html", "video.mp4"}


@pytest.mark.parametrize(
    ("missing", "argv", "extra"),
    [
        ("imageio_ffmpeg", ["train", "Pendulum-v1", "--video-every", "9"], "video"),
        ("highway_env", ["train", "parking-v0"], "parking"),
    ],
)
def test_a_missing_extra_is_named_before_anything_runs(missing, argv, extra, run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setitem(sys.modules, "envpool", None)
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name in (missing, "envpool") else find(name))
    if missing == "highway_env":
        for name in [name for name in gym.registry if name.startswith("parking-")]:
            monkeypatch.delitem(gym.registry, name)
    assert f'pip install "rejeu[{extra}]"' in error_of(capsys, *(one.format(models=run) for one in argv))
    assert not [*tmp_path.iterdir()]


def test_evaluate_prints_the_result_repeats_itself_with_a_seed_and_writes_nothing(run, capsys):
    before = {path: path.stat().st_mtime_ns for path in run.iterdir()}
    for _ in range(2):
        assert main(["evaluate", str(run), "--episodes", "2", "--seed", "5", "--backend", "gymnasium"]) == 0
    first, second = capsys.readouterr().out.split("Pendulum-v1 on gymnasium")[1:]
    assert first.strip() == second.strip()
    assert "2 episodes" in first
    assert str(run / "best.safetensors") in first
    assert main(["evaluate", str(run), "--minutes", "1e-6", "--backend", "gymnasium", "--which", "last"]) == 0
    assert main(["evaluate", str(run / "agent.safetensors"), "--episodes", "1"]) == 0
    text = capsys.readouterr().out
    assert "16 episodes" in text  # an episode in each environment
    assert text.count("agent.safetensors") == 2
    assert {path: path.stat().st_mtime_ns for path in run.iterdir()} == before


@pytest.mark.usefixtures("untrained")
def test_a_preset_says_what_a_success_is_where_the_environments_threshold_ranks_by_luck(tmp_path):
    out = tmp_path / "run"
    argv = ["train", "Taxi-v4", "--steps", "8", "--out", str(out), "--evaluate-episodes", "1", *FEWER_FILES]
    assert main(argv) == 0
    assert json.loads((out / "config.json").read_text("utf-8"))["success_threshold"] == 0.0


def test_a_reader_that_closes_the_output_is_no_error(monkeypatch, capsys):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", buffering=1) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert main(["list"]) == 141
    assert capsys.readouterr().err == ""


def help_of(capsys, *words):
    """Returns the lists of a help text by title: the first word of each entry."""
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    text = capsys.readouterr().out
    lists = re.findall(r"^([a-z ]+):\n((?:  .*\n|\n(?=  ))+)", text, re.MULTILINE)
    return {title: re.findall(r"^  (?:-h, )?([\w-]+)", entries, re.MULTILINE) for title, entries in lists}


def test_help_lists_commands_by_task(capsys):
    lists = help_of(capsys)
    assert [*lists] == ["options", "train", "look", "share", "teach"]
    assert {"tune": "train", "compare": "look", "export": "share", "class": "teach"}.items() <= {
        name: title for title, names in lists.items() for name in names
    }.items()
    assert sorted(name for title in [*lists][1:] for name in lists[title]) == sorted(cli.COMMANDS)


@pytest.mark.parametrize(("command", "usage"), [("train", "ENV"), ("runs", "[FOLDER]"), ("compare", "RUN ...")])
def test_the_first_line_of_help_says_which_words_may_be_left_out(capsys, command, usage):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert capsys.readouterr().out.startswith(f"usage: rejeu {command} {usage} [options]\n")


def test_help_of_train_begins_with_what_people_need_first_and_has_five_groups(capsys):
    lists = help_of(capsys, "train")
    assert lists.pop("positional arguments") == ["ENV"]
    assert lists["options"] == ["--help", "--algo", "--steps", "--minutes", "--envs", "--seed", "--set", "--out"]
    assert [*lists] == ["options", "environment", "training", "evaluation", "output"]
    assert max(map(len, lists.values())) == 8
    assert sum(map(len, lists.values())) == 33
    assert [*help_of(capsys, "compare")] == ["positional arguments", "options"]


def test_set_takes_dotted_names_numbers_lists_and_words():
    argv = ['train_freq=[1,"episode"]', "learning_rate=1e-3", "policy_kwargs.net_arch=[64,64]", "ent_coef=auto_0.1"]
    assert config.merged(config.assigned(argv), {"policy_kwargs": {"layer_norm": True}, "gamma": 0.9}) == {
        "policy_kwargs": {"layer_norm": True, "net_arch": [64, 64]},
        "gamma": 0.9,
        "train_freq": [1, "episode"],
        "learning_rate": 1e-3,
        "ent_coef": "auto_0.1",
    }


def test_set_understands_pythons_false_and_leaves_the_preset_as_it_was():
    assert config.merged(config.assigned(["policy_kwargs.layer_norm=False"]), {}) == {
        "policy_kwargs": {"layer_norm": False}
    }
    preset = rejeu.agents.presets.find("parking-v0")
    config.merged(config.assigned(["policy_kwargs.net_arch=[1]"]), preset.hyperparameters)
    assert preset.hyperparameters["policy_kwargs"]["net_arch"] != [1]


@pytest.mark.parametrize(
    ("options", "algorithm"),
    [
        ([], "XQC"),
        (["--steps", "100000"], "XQC"),
        (["--minutes", "20"], "XQC"),
        (["--steps", "99999"], "SAC"),
        (["--minutes", "19"], "SAC"),
        (["--set", "gamma=0.98"], "SAC"),
        (["--envs", "64"], "SAC"),
        (["--algo", "td3"], "TD3"),
        (["--env-kwargs", "goals=true"], "SAC"),
    ],
)
@pytest.mark.usefixtures("untrained")
def test_long_runs_without_a_preset_and_without_settings_take_xqc_for_box_actions(
    options, algorithm, tmp_path, monkeypatch
):
    slider = EnvSpec("Slider-v0", lambda goals=False: Reach() if goals else Counter(), max_episode_steps=10)
    monkeypatch.setitem(gym.registry, slider.id, slider)
    assert main(["train", slider.id, *options, "--out", str(tmp_path / "run")]) == 0
    found = json.loads((tmp_path / "run" / "config.json").read_text())
    assert found["algorithm"] == algorithm
    assert not found["preset"]
    if algorithm == "XQC":
        assert found["steps"] == (None if "--minutes" in options else 100_000)
        assert found["hyperparameters"]["policy_kwargs"]["qf"] == [128, 128]


@pytest.mark.usefixtures("untrained")
def test_rewards_of_goals_may_read_the_info_only_if_it_is_kept(tmp_path, monkeypatch, capsys):
    spec = EnvSpec("ReadsInfo-v0", RewardReadsInfo, max_episode_steps=10)
    monkeypatch.setitem(gym.registry, spec.id, spec)
    argv = ["train", spec.id, "--algo", "sac", "--steps", "20", "--set", "replay_buffer_class=HerReplayBuffer"]
    assert main([*argv, "--out", str(tmp_path / "refused")]) == 2
    assert "keep infos with replay_buffer_kwargs={'copy_info_dict': True}" in capsys.readouterr().err
    assert main([*argv, "replay_buffer_kwargs.copy_info_dict=true", "--out", str(tmp_path / "run")]) == 0


@pytest.mark.usefixtures("untrained")
def test_without_a_preset_dqn_has_values_of_its_own_but_on_images(tmp_path):
    pixels = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)
    assert untuned("DQN", 1, CUBE) == rejeu.agents.presets.small("DQN") != {}
    assert untuned("DQN", 1, gym.spaces.Dict(eye=pixels, arm=CUBE)) == {}
    assert untuned("PQN", 1, CUBE) == {}
    assert untuned("PQN", 128, CUBE) == AGENTS["PQN"].algorithm.Config.for_many
    for env, steps in (("Blackjack-v1", 2), ("CartPole-v1", 1)):  # the second has a preset
        out = tmp_path / env
        argv = ["train", env, "--algo", "DQN", "--steps", "20", "--out", str(out), "--evaluate-episodes", "1"]
        assert main([*argv, "--set", "learning_starts=30", "gradient_steps=1"]) == 0
        found = json.loads((out / "config.json").read_text())["hyperparameters"]
        assert (found["n_steps"], found["gradient_steps"]) == (steps, 1)
        assert found["policy_kwargs"]["net_arch"] == [128, 128]


@pytest.mark.usefixtures("untrained")
def test_set_may_be_given_more_than_once(tmp_path):
    assert train(tmp_path / "run", "--backend", "gymnasium", "--set", "gamma=0.5") == 0
    hyperparameters = json.loads((tmp_path / "run" / "config.json").read_text())["hyperparameters"]
    assert (hyperparameters["gamma"], hyperparameters["batch_size"]) == (0.5, 8)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["train", "Pendulum-v1", "--set", "learning_rat=1"], "did you mean learning_rate?"),
        (["train", "Pendulum-v1", "--set", "policy_kwargs.net_archh=[1]"], "did you mean net_arch?"),
        (["train", "Pendulum-v1", "--set", "gamma=7"], "gamma=7 must be"),
        (["train", "Pendulum-v1", "--set", "gamma"], "must be name=value"),
        (["train", "Pendulmu-v1"], "did you mean Pendulum-v1"),
        (["train", "Pendulum-v1", "--algo", "SCA"], "did you mean SAC?"),
        (["train", "Pendulum-v1", "--backend", "envpol"], "must be one of auto, envpool"),
        (["train", "Pendulum-v1", "--steps", "5", "--minutes", "1"], "exclude each other"),
        (
            ["train", "LunarLander-v2"],
            "LunarLander-v2 is an old version that Gymnasium no longer has; use LunarLander-v3",
        ),
        pytest.param(
            ["train", "ALE/Pong-v5"],
            "pip install ale-py; EnvPool has Pong-v5: backend='envpool' (--backend envpool)",
            marks=pytest.mark.needs_envpool,
        ),
        (["train", "Pendulum-v1", "--env-cpus", "2"], "--env-cpus are for --backend ray"),
        (["check", ":Walk-v0"], "':Walk-v0' must be MODULE:ID, such as my_env:Walk-v0"),
        pytest.param(
            ["check", "Pong-v5"],
            "Gymnasium has no Pong-v5, so it cannot be drawn or stepped by Gymnasium; EnvPool has",
            marks=pytest.mark.needs_envpool,
        ),
        (["trian", "Pendulum-v1"], "no command is called 'trian'; did you mean train?"),
        ([], "expected a command, such as rejeu train parking-v0"),
        (["train"], "rejeu train needs ENV"),
        (["train", "Pendulum-v1", "CartPole-v1"], "does not expect 'CartPole-v1'"),
        (["train", "Pendulum-v1", "--step", "5"], "no option --step; did you mean --steps?"),
        (["train", "Pendulum-v1", "--steps"], "--steps needs a value"),
        (["evaluate", "run", "--episodes", "9e18"], "--episodes=9000000000000000000 must be"),
        (["train", "Pendulum-v1", "--json=false"], "--json takes no value, got 'false'"),
        (["train", "Pendulum-v1", "--algo", "-x"], "--algo needs a value, got '-x'"),
        (["train", "--env", "Pendulum-v1"], "the environment is given without an option: rejeu train ENV"),
        (["tune", "Pendulum-v1", "--lr", "1e-3"], "hyperparameters are given as --set learning_rate=1e-3"),
        (["evaluate", "run", "-n", "5"], "no option -n; "),
        (["train", "Pendulum-v1", "--tensorboard"], "no option --tensorboard; logs are named by --log tensorboard"),
        (["resume", "run", "--net-arch", "64"], "given as --set policy_kwargs.net_arch=[64,64]"),
        (["train", "Pendulum v1"], "no environment is called 'Pendulum v1'; did you mean Pendulum-v1"),
        (["train", "Pendulum-v1", "--seed", "x"], "--seed 'x' must be a whole number"),
        (["train", "Pendulum-v1", "--minutes", "ten"], "--minutes 'ten' must be a number"),
        (["evaluate", "run", "--which", "bets"], "--which 'bets' must be one of best, last"),
        (["train", "rejeu-test/Words-v0"], "which no algorithm here takes"),
        (["train", "rejeu-test/Switches-v0", "--algo", "SAC"], "MultiBinary(3)"),
        (["runs"], "there is no folder runs; rejeu train ENV makes runs in the folder runs"),
        (["evaluate", "no-such-run"], "no run folder or model file no-such-run"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_fix(capsys, monkeypatch, tmp_path, argv, message):
    monkeypatch.chdir(tmp_path)
    assert message in error_of(capsys, *argv)
    assert not [*tmp_path.iterdir()]


@pytest.mark.filterwarnings("ignore:.*HalfCheetah-v3 is out of date:DeprecationWarning")
def test_an_old_version_that_gymnasium_lists_and_cannot_make_names_the_new_one(capsys):
    text = error_of(capsys, "check", "HalfCheetah-v3")
    assert "HalfCheetah-v3 is an old version that cannot be made any more" in text


def test_a_folder_that_is_no_run_is_an_error_and_a_run_is_never_overwritten(capsys, run, tmp_path):
    assert "is a folder without a model" in error_of(capsys, "evaluate", str(tmp_path))
    before = (run / "config.json").read_text()
    assert "not an empty folder" in error_of(capsys, "train", "Pendulum-v1", "--steps", "5", "--out", str(run))
    assert (run / "config.json").read_text() == before


def test_a_nan_reward_is_an_error_and_what_was_learnt_until_then_is_saved(capsys, tmp_path):
    argv = ["train", "rejeu-test/Broken-v0", "--steps", "500", "--evaluate-every", "60", "--evaluate-episodes", "1"]
    argv += ["--algo", "SAC", "--no-report", "--out", str(tmp_path / "run")]
    text = error_of(capsys, *argv, "--set", *TINY, "learning_rate=1e-3")
    assert "returned the reward nan" in text
    assert rejeu.load(tmp_path / "run" / "agent.safetensors").num_timesteps == 119
    assert rejeu.load(tmp_path / "run" / "best.safetensors").num_timesteps == 60
    assert len(rows(tmp_path / "run" / "episodes.csv")) == 2


def test_a_table_that_is_gone_on_with_keeps_the_rows_up_to_a_step(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,a\n1,1.0\n2,2.0\n3,3.0\n4,")  # and the last was cut short
    table = CsvFile(path, up_to=2)
    table.write(3, {"a": 3.5, "b": 1.0})
    table.close()
    assert [list(row.values()) for row in rows(path)] == [["1", "1.0", ""], ["2", "2.0", ""], ["3", "3.5", "1.0"]]


def table(path):
    """A table without what depends on the clock."""
    return [{k: v for k, v in row.items() if "seconds" not in k and not k.startswith("time/")} for row in rows(path)]


def test_a_run_that_was_killed_goes_on_to_the_same_end(tmp_path, capsys, monkeypatch):
    argv = ["train", "Pendulum-v1", "--steps", "500", "--seed", "3", "--evaluate-every", "150", *FEWER_FILES]
    evaluate = Evaluate.__call__

    def call(self, agent, progress):
        evaluate(self, agent, progress)
        if progress.step == 320:  # what a process leaves that is killed here
            shutil.copytree(tmp_path / "whole", tmp_path / "cut")

    monkeypatch.setattr(Evaluate, "__call__", call)
    argv += ["--backend", "gymnasium", "--evaluate-episodes", "2", "--checkpoint-minutes", "3e-4"]
    argv += ["--out", str(tmp_path / "whole")]
    assert main([*argv, "--set", *TINY]) == 0
    monkeypatch.undo()
    assert not (tmp_path / "cut" / "agent.safetensors").exists()
    assert main(["resume", str(tmp_path / "cut"), *FEWER_FILES]) == 0
    assert re.search(r"resumed at step \d+, exactly as it was saved", capsys.readouterr().out)
    for name in ("episodes.csv", "evaluations.csv", "metrics.csv"):
        assert table(tmp_path / "cut" / name) == table(tmp_path / "whole" / name), name
    assert_same_parameters(*(rejeu.load(tmp_path / run / "agent.safetensors") for run in ("whole", "cut")))


def test_the_files_of_a_complete_run_are_written_once_more(run, tmp_path):
    out = shutil.copytree(run, tmp_path / "run")
    before = {name: (out / name).read_bytes() for name in ("agent.safetensors", "episodes.csv", "evaluations.csv")}
    for name in ("agent.safetensors", "episodes.csv"):
        (out / name).unlink()
    assert main(["resume", str(out), "--finish", *FEWER_FILES]) == 0
    assert {name: (out / name).read_bytes() for name in before} == before


def test_a_complete_run_can_be_trained_further(run, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "run")
    text = error_of(capsys, "resume", str(tmp_path / "run"))
    assert "the run is complete" in text
    before = rejeu.load(tmp_path / "run" / "agent.safetensors").num_timesteps
    assert main(["resume", str(tmp_path / "run"), "--steps", "50", *FEWER_FILES]) == 0
    assert rejeu.load(tmp_path / "run" / "agent.safetensors").num_timesteps == before + 50


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")
def test_resume_with_steps_pauses_and_keeps_the_goal(run, tmp_path, capsys):
    """Pausing changes nothing about the run: it ends where the one that was never paused ended."""
    argv = ["--seed", "3", "--evaluate-every", "400", "--backend", "gymnasium", *FEWER_FILES]
    out = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        kill = lambda self, agent, turn: os.kill(os.getpid(), signal.SIGINT) if turn.step == 100 else None  # noqa: E731
        patch.setattr(rejeu.callbacks.Evaluate, "__call__", kill)
        arguments = ["train", "Pendulum-v1", "--steps", "850", "--out", str(out), "--evaluate-episodes", "2", *argv]
        assert main([*arguments, "--set", *TINY]) == 130
    assert "stopped by Ctrl-C; everything is saved" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == FILES - {"curve.png", "models", "report.html", "video.mp4"}
    assert rejeu.load(out / "agent.safetensors").num_timesteps == 100
    assert main(["resume", str(out), "--steps", "1e2", *FEWER_FILES]) == 0
    text = capsys.readouterr().out
    assert f"paused; everything is saved; rejeu resume {out} continues" in text
    paused = rejeu.load(out / "agent.safetensors").num_timesteps
    assert paused == 200
    assert main(["status", str(out)]) == 3
    assert "paused" in capsys.readouterr().out
    assert main(["resume", str(out), *FEWER_FILES]) == 0
    assert not (out / "paused").exists()
    one, two = (rejeu.load(path / "agent.safetensors") for path in (run, out))
    assert one.num_timesteps == two.num_timesteps == 850
    assert_same_parameters(one, two)


@exhaustive
def test_the_best_model_is_kept_when_a_complete_run_is_trained_further(tmp_path, capsys, monkeypatch):
    """The last evaluation of the first part, at step 60, is the best by far and must be remembered."""
    better = iter([10.0, 1.0])
    evaluation = rejeu.Evaluation
    fake = lambda *_, **__: evaluation(np.array([next(better)]), np.array([5]), np.array([np.nan]))  # noqa: E731
    monkeypatch.setattr(rejeu.SAC, "evaluate", fake)
    assert train(tmp_path / "run", "--evaluate-every", "1000", *FEWER_FILES, steps=60) == 0
    assert main(["resume", str(tmp_path / "run"), "--steps", "20", *FEWER_FILES]) == 0
    assert [row["best"] for row in rows(tmp_path / "run" / "evaluations.csv")] == ["1", "0"]
    assert rejeu.load(tmp_path / "run" / "best.safetensors").num_timesteps == 60


def test_resume_explains_what_it_cannot_go_on_with(run, tmp_path, capsys):
    assert "no run folder" in error_of(capsys, "resume", str(tmp_path))
    assert "exclude each other" in error_of(capsys, "resume", str(run), "--steps", "5", "--minutes", "1")
    shutil.copytree(run, tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    content = json.loads(config.read_text())
    for damage, message in (
        ({"n_envs": "8"}, "n_envs"),
        ({"algorithm": "os.system"}, "'os.system', which is not registered"),
        ({"seed": None}, "seed"),
    ):
        config.write_text(json.dumps({**content, **damage}))
        assert message in error_of(capsys, "resume", str(tmp_path / "run"))
    config.write_text("{")
    assert "is damaged" in error_of(capsys, "resume", str(tmp_path / "run"))
    config.write_text(json.dumps(content))
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    assert "no checkpoint in" in error_of(capsys, "resume", str(tmp_path / "run"))


@pytest.mark.filterwarnings("always::UserWarning")
def test_resume_says_that_it_skipped_a_damaged_checkpoint(run, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "run")
    newest = max((tmp_path / "run" / "checkpoints").glob("run_*"))
    content = bytearray(newest.read_bytes())
    content[-9] ^= 1
    newest.write_bytes(content)
    assert main(["resume", str(tmp_path / "run"), "--steps", "10", *FEWER_FILES]) == 0
    said = capsys.readouterr()
    assert "resumed at step 0" in said.out
    warning = (
        rf"warning: {re.escape(str(newest))}: the array '?\S+ is damaged .*; resuming from the checkpoint before it\n"
    )
    assert re.fullmatch(warning, said.err)


@pytest.mark.filterwarnings("always::UserWarning")
def test_what_could_not_be_written_is_repeated_at_the_end_of_the_command(tmp_path, capsys, monkeypatch):
    disk, call = FullDisk(monkeypatch), Evaluate.__call__

    def fill(self, agent, progress):
        call(self, agent, progress)
        disk.full = progress.step >= 50

    monkeypatch.setattr(Evaluate, "__call__", fill)
    out = tmp_path / "run"
    assert train(out, "--seed", "3", "--evaluate-every", "40", "--backend", "gymnasium", steps=250) == 2
    lines = capsys.readouterr().err.splitlines()
    assert all(line.startswith("warning: ") for line in lines)
    said = lines[-1].removeprefix("warning: ")
    assert said.startswith("not written (No space left on device): ")
    for name in ("checkpoints", "evaluations.csv", "episodes.csv", "agent.safetensors"):
        assert str(out / name) in said
    assert [row["step"] for row in rows(out / "evaluations.csv")] == ["40"]
    assert not (out / "agent.safetensors").exists()
    assert rejeu.load(out / "best.safetensors").num_timesteps == 40


@pytest.mark.filterwarnings("always::UserWarning")
def test_nothing_is_advised_that_needs_a_model_or_a_checkpoint_that_was_not_written(tmp_path, monkeypatch, capsys):
    disk, call = FullDisk(monkeypatch), Evaluate.__call__

    def fill(self, agent, progress):
        disk.full = True
        call(self, agent, progress)

    monkeypatch.setattr(Evaluate, "__call__", fill)
    assert train(tmp_path / "run", *FEWER_FILES, "--backend", "gymnasium", steps=60) == 2
    printed = capsys.readouterr()
    assert "agent.safetensors" in printed.err
    assert "try it" not in printed.out
    assert "resume" not in printed.out


def test_check_leaves_out_what_only_the_authors_of_a_package_can_change(capsys):
    assert main(["check", "CartPole-v1"]) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[0] == "CartPole-v1: 0 errors, 0 warnings"
    assert re.search(r"\d+ warnings? on what only the authors of gymnasium can change; --all shows it", text)
    assert main(["check", "CartPole-v1", "--all"]) == 0
    assert "warning: gymnasium.utils.env_checker" in capsys.readouterr().out


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such names")
def test_a_name_of_a_file_cannot_control_the_terminal(capsys, tmp_path):
    name = "a\x1b]0;title\x07\x1b[2J"
    (tmp_path / name).mkdir()
    (tmp_path / name / "config.json").touch()
    assert main(["evaluate", str(tmp_path)]) == 2
    assert r"a\x1b]0;title\x07\x1b[2J" in (printed := capsys.readouterr().err)
    assert "\x1b" not in printed


def test_a_warning_is_one_line_on_the_command_line(capsys):
    argv = ["train", "Pendulum-v1", "--algo", "TD3", "--steps", "1"]
    with pytest.MonkeyPatch.context() as patch:
        warn = lambda out: warnings.warn("\x1b[33mWARN: one\n  two\x1b[0m", UserWarning, stacklevel=1)  # noqa: E731
        patch.setattr("rejeu.lab.runs.begin.check_free", warn)
        patch.setattr("rejeu.lab.runs.begin.from_arguments", lambda *_: (_ for _ in ()).throw(ValueError("over")))
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            assert main(argv) == 2
    assert re.fullmatch(r"warning: one two\nrejeu: error: over \(.*\)\n", capsys.readouterr().err)


def test_report_replays_the_episodes_that_record_and_watch_show(run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    assert main(["report", str(folder), "--replay", "2"]) == 0
    with (folder / "replays.csv").open(encoding="utf-8") as file:
        replayed = [float(row["return"]) for row in csv.DictReader(file)]
    agent, env, returns = rejeu.load(folder), gym.make("Pendulum-v1"), []
    for seed in range(2):  # as rejeu.record_video plays
        obs, _ = env.reset(seed=seed)
        state, total, done = None, 0.0, False
        while not done:
            action, state = agent.predict(obs, state, deterministic=True)
            obs, reward, terminated, truncated, _ = env.step(action)
            total, done = total + np.float32(reward), terminated or truncated
        returns.append(total)
    assert replayed == pytest.approx(returns, abs=1e-3)
    assert "--seed N --episodes 1" in (folder / "report.html").read_text(encoding="utf-8")


def test_without_a_name_the_run_folder_is_new_each_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = [folder.create(None, "ALE/Pong-v5", "SAC", 7).path for _ in range(3)]
    assert len(set(folders)) == 3
    assert re.fullmatch(r"ALE-Pong-v5-SAC-seed7-\d{8}-\d{6}", folders[0].name)


def test_list_groups_presets_by_environment_in_columns(capsys):
    assert main(["list"]) == 0
    algorithms, _, presets = capsys.readouterr().out.partition("environments with")
    assert re.search(r"SAC +Soft actor-critic", algorithms)
    assert re.search(r"parking-v0 +SAC +56,000 steps  success", presets)
    rows = [line for line in presets.splitlines()[1:] if " steps  " in line]
    assert len(rows) == len(rejeu.agents.presets.every())
    assert len({row.index(" steps  ") for row in rows}) == 1
    named = [row.split()[0] for row in rows if not row.startswith("   ")]
    assert sorted(named) == sorted({preset.env_id for preset in rejeu.agents.presets.every()})


def test_help_names_the_commands_and_python_m_rejeu_is_the_same_command(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rejeu {rejeu.__version__}\n"
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(command in text for command in ("train", "evaluate", "record", "list", "--version"))
    done = subprocess.run([sys.executable, "-m", "rejeu", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"rejeu {rejeu.__version__}\n"
