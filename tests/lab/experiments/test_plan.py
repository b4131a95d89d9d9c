"""Plans: what they expand to, and where a mistake is said to be."""

from contextlib import closing
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

import rejeu
from rejeu.algorithms.config import to_json as config_to_json
from rejeu.lab.experiments import plan as plan_module
from rejeu.lab.experiments.folder import MAX_JOBS
from rejeu.lab.experiments.plan import PlanError, read_plan
from rejeu.lab.runs.arguments import of_task
from rejeu.lab.runs.begin import make_config, make_env
from rejeu.lab.runs.environment import from_arguments
from tests.environments import Counter

PLAN = """\
# two algorithms
environments = ["CartPole-v1", "Acrobot-v1"]
algorithms = ["DQN", "PPO"]
seeds = 2
steps = 1e3
evaluate_every = 500

[settings.default]

[settings.fast]
learning_rate = 1e-3
policy_kwargs.net_arch = [
  8,
]

[settings.fast.DQN]
train_freq = 8
learning_rate = 1e-2

[resources]
memory = "2 GB"
"""


def write(tmp_path, text):
    path = tmp_path / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_environments_algorithms_settings_and_seeds(tmp_path):
    plan, text = read_plan(write(tmp_path, PLAN))
    assert text == PLAN
    assert len(plan.jobs) == 16
    assert len({job.name for job in plan.jobs}) == 16
    assert plan.resources.memory == 2 * 10**9
    first, last = plan.jobs[0], plan.jobs[-1]
    assert (first.name, first.run.hyperparameters) == ("CartPole-v1-DQN-default-seed0", {})
    assert (last.name, last.run.seed, last.run.algorithm) == ("Acrobot-v1-PPO-fast-seed1", 1, "PPO")
    assert last.run.hyperparameters == {"learning_rate": 1e-3, "policy_kwargs.net_arch": [8]}
    fast = next(job for job in plan.jobs if job.run.algorithm == "DQN" and job.setting == "fast")
    assert (fast.run.hyperparameters["train_freq"], fast.run.hyperparameters["learning_rate"]) == (8, 1e-2)
    assert (first.run.steps, first.run.evaluate_every, first.run.minutes) == (1000, 500, None)


def test_a_dict_is_a_plan_too():
    plan, text = read_plan({"environments": "CartPole-v1", "seeds": [3, 5], "steps": 100})
    assert text is None
    assert [job.name for job in plan.jobs] == ["CartPole-v1-DQN-seed3", "CartPole-v1-DQN-seed5"]
    plan, _ = read_plan({"environments": "CartPole-v1", "seeds": 2, "first_seed": 3})
    assert [job.run.seed for job in plan.jobs] == [3, 4]


@pytest.mark.parametrize(
    ("options", "algorithms"),
    [
        ({}, ["XQC"]),
        ({"minutes": 5}, ["SAC"]),
        ({"steps": 100_000}, ["XQC"]),
        ({"envs": 64}, ["SAC"]),
        ({"settings": {"default": {}, "far": {"gamma": 0.999}}}, ["SAC", "SAC"]),  # one for all that are compared
    ],
)
def test_without_algorithms_and_settings_long_runs_take_that_of_rejeu_train(options, algorithms, monkeypatch):
    spec = EnvSpec("Slider-v0", Counter, max_episode_steps=10)
    monkeypatch.setitem(gym.registry, spec.id, spec)
    plan, _ = read_plan({"environments": spec.id, **options})
    assert [job.run.algorithm for job in plan.jobs] == algorithms


@pytest.mark.parametrize(("algorithm", "n_envs"), [("DQN", 1), ("PQN", 128)])
def test_a_plan_checks_the_configuration_that_is_trained(algorithm, n_envs, monkeypatch):
    checked = []
    monkeypatch.setattr(plan_module, "check_spaces", lambda environment, config: checked.append(config))
    content = {"environments": "Blackjack-v1", "algorithms": algorithm, "settings": {"slow": {"learning_rate": 1e-5}}}
    plan, _ = read_plan({**content, "envs": n_envs})
    _, arguments = of_task(plan.jobs[0].task(Path("run"), False, ()))
    environment = from_arguments(arguments.env, arguments)
    with closing(make_env(arguments, environment, None, 0)) as env:
        trained = make_config(arguments, environment, None, env, 0, ())
    assert config_to_json(checked[0]) == trained.hyperparameters
    assert trained.hyperparameters["batch_size"] != type(checked[0])().batch_size  # it differs from the defaults


def test_options_of_one_environment():
    tables = {
        "easy": {"id": "FrozenLake-v1", "env_kwargs": {"map_name": "4x4", "is_slippery": False}, "steps": 100},
        "CartPole-v1": {"algorithms": ["PPO"], "evaluate_every": 7, "no_report": True},
    }
    common = {"minutes": 1, "evaluate_every": 50, "no_video": True, "env_kwargs": {"map_name": "8x8"}}
    with pytest.raises(PlanError, match="map_name"):  # which CartPole does not take
        read_plan({"environments": tables, **common})
    common["env_kwargs"] = {}
    plan, _ = read_plan({"environments": tables, "algorithms": ["DQN", "PPO"], **common})
    assert [job.name for job in plan.jobs] == ["easy-DQN-seed0", "easy-PPO-seed0", "CartPole-v1-PPO-seed0"]
    easy, cart_pole = plan.jobs[0], plan.jobs[-1]
    assert (easy.run.steps, easy.run.minutes) == (100, None)
    assert (cart_pole.run.steps, cart_pole.run.minutes) == (None, 1.0)
    assert easy.run.env_kwargs == {"map_name": "4x4", "is_slippery": False}
    assert [job.run.evaluate_every for job in plan.jobs] == [50, 50, 7]
    assert [(job.no_report, job.no_video) for job in plan.jobs] == [(False, True), (False, True), (True, True)]
    tables = {"FrozenLake-v1": {"env_kwargs": {"map_name": "4x4"}}}
    own, _ = read_plan({"environments": tables, "env_kwargs": {"map_name": "8x8", "is_slippery": False}})
    assert own.jobs[0].run.env_kwargs == {"map_name": "4x4", "is_slippery": False}


def test_a_setting_for_some_algorithms():
    settings = {"a": {}, "b": {"algorithms": ["DQN"], "tau": 0.5}}
    plan, _ = read_plan({"environments": ["CartPole-v1"], "algorithms": ["DQN", "PPO"], "settings": settings})
    assert [(job.run.algorithm, job.setting) for job in plan.jobs] == [("DQN", "a"), ("DQN", "b"), ("PPO", "a")]


MISTAKES = [
    (
        "learning_rate",
        "learning_rat",
        "settings.fast",
        "DQN has no setting 'learning_rat'; did you mean learning_rate?",
    ),
    ("1e-3", "-1", "settings.fast", "learning_rate=-1 must not fall below 0"),
    ("steps = 1e3", "steps = 1.5", "", "steps=1.5: expected `int"),
    ('"DQN", "PPO"', '"DQN", "PPP"', "algorithms", "did you mean PPO?"),
    ('"DQN", "PPO"', '"DQN", "TQC"', "environments.CartPole-v1", "TQC needs a Box action space"),
    ("Acrobot-v1", "Acrobat-v1", "environments.Acrobat-v1", "did you mean Acrobot-v1"),
    ("Acrobot-v1", "os:Acrobot-v1", "environments.os:Acrobot-v1", "no file may name a module"),
    ("Acrobot-v1", "CartPole-v1", "environments", "names one twice"),
    ("train_freq = 8", "train_freq = 'x'", "settings.fast", "train_freq='x' must be"),
    ("  8,", "  'x',", "settings.fast", "net_arch=['x'] must hold"),
    ("memory", "memori", "resources", "did you mean memory?"),
    ("2 GB", "2 XB", "resources", "such as '4 GB'"),
    ("seeds = 2", "seeds = [1, 1]", "", "different seeds"),
    ("seeds = 2", "seeds = 'x'", "", "seeds='x': expected"),
    ("seeds = 2", "seeds = nan", "", "not JSON compliant"),
    ("seeds = 2", f"settings.{'a.' * 1000}a = 1", "", "a line of more than 1,000 dots"),
    ("seeds = 2", "seeds = [", "", "line 5, column 1); expected TOML"),
    ("[settings.fast]", "[settings.default]", "", "line 10"),
    ("evaluate_every = 500", "minutes = 3", "", "exclude each other"),
    ("evaluate_every = 500", "log = ['jsn']", "", "expected any of"),
    ("evaluate_every = 500", "backend = 'envpol'", "", "must be one of auto"),
    ("evaluate_every = 500", "ray = 'HOST:6379'", "", "ray='HOST:6379' must be 'auto'"),
    ("evaluate_every = 500", "preset = true", "", "preset=True must be the path of a file"),
    ("evaluate_every = 500", "env_kwargs = {render_mode = 'human'}", "environments.CartPole-v1", "render_mode=human"),
    ("train_freq = 8", "buffer_size = 1_000_000_000_000_000", "settings.fast", "at most 1000000000000"),
]


@pytest.mark.parametrize(("old", "new", "place", "problem"), MISTAKES, ids=[one[1] for one in MISTAKES])
def test_a_mistake_is_one_line_with_its_place(tmp_path, old, new, place, problem):
    assert old in PLAN
    path = write(tmp_path, PLAN.replace(old, new, 1))
    with pytest.raises(PlanError) as raised:
        read_plan(path)
    message = str(raised.value)
    assert message.startswith(f"{path}, {place}: " if place else f"{path}: ")
    assert problem in message
    assert "\n" not in message


def test_a_mistake_at_the_end_of_a_plan_is_found_before_any_agent_is_built(monkeypatch):
    monkeypatch.setattr(rejeu.agents.Agent, "build", lambda *_: pytest.fail("an agent was built"))
    settings = {f"s{i}": {"learning_rate": 1e-4 * (i + 1)} for i in range(300)} | {"last": {"gama": 0.9}}
    with pytest.raises(PlanError, match=r"^plan, settings\.last: DQN has no setting 'gama'"):
        read_plan({"environments": ["CartPole-v1"], "algorithms": ["DQN"], "settings": settings})


@pytest.mark.parametrize(
    "content", [{}, {"environments": []}, {"environments": [1]}, {"environments": "CartPole-v1", "settings": {}}]
)
def test_a_plan_needs_environments(content):
    with pytest.raises(PlanError):
        read_plan(content)


def test_sizes_are_limited(tmp_path):
    with pytest.raises(PlanError, match=f"up to {MAX_JOBS:,}"):
        read_plan({"environments": "CartPole-v1", "seeds": 1000, "settings": {f"s{i}": {} for i in range(11)}})
    with pytest.raises(PlanError, match="bytes"):
        read_plan(write(tmp_path, "#" * 300_000))
    with pytest.raises(FileNotFoundError):
        read_plan(tmp_path / "none.toml")


def test_an_invalid_plan_starts_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlanError):
        rejeu.sweep({"environments": "CartPole-v1", "stepz": 1})
    assert list(tmp_path.iterdir()) == []
