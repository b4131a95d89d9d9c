"""Plans: what they expand to, and where a mistake is said to be."""

import pytest

import rejeu
from rejeu.experiments.jobs import MAX_JOBS
from rejeu.experiments.plan import PlanError, line_of, read_plan

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
    assert fast.run.hyperparameters["train_freq"] == 8
    assert (first.run.steps, first.run.evaluate_every, first.run.minutes) == (1000, 500, None)


def test_a_dict_is_a_plan_too():
    plan, text = read_plan({"environments": "CartPole-v1", "seeds": [3, 5], "steps": 100})
    assert text is None
    assert [job.name for job in plan.jobs] == ["CartPole-v1-DQN-seed3", "CartPole-v1-DQN-seed5"]


def test_options_of_one_environment():
    tables = {
        "easy": {"id": "FrozenLake-v1", "env_kwargs": {"map_name": "4x4", "is_slippery": False}, "steps": 100},
        "CartPole-v1": {"algorithms": ["PPO"]},
    }
    plan, _ = read_plan({"environments": tables, "algorithms": ["DQN", "PPO"], "minutes": 1})
    assert [job.name for job in plan.jobs] == ["easy-DQN-seed0", "easy-PPO-seed0", "CartPole-v1-PPO-seed0"]
    easy, cart_pole = plan.jobs[0], plan.jobs[-1]
    assert (easy.run.steps, easy.run.minutes) == (100, None)
    assert (cart_pole.run.steps, cart_pole.run.minutes) == (None, 1.0)
    assert easy.run.env_kwargs == {"map_name": "4x4", "is_slippery": False}


def test_a_setting_for_some_algorithms():
    settings = {"a": {}, "b": {"algorithms": ["DQN"], "tau": 0.5}}
    plan, _ = read_plan({"environments": ["CartPole-v1"], "algorithms": ["DQN", "PPO"], "settings": settings})
    assert [(job.run.algorithm, job.setting) for job in plan.jobs] == [("DQN", "a"), ("DQN", "b"), ("PPO", "a")]


MISTAKES = [
    ("learning_rate", "learning_rat", 11, "DQN has no setting 'learning_rat'; did you mean learning_rate?"),
    ("1e-3", "-1", 11, "learning_rate=-1 must not fall below 0"),
    ("steps = 1e3", "steps = 1.5", 5, "expected `int"),
    ("steps =", "stepz =", 5, "did you mean steps?"),
    ('"DQN", "PPO"', '"DQN", "PPP"', 3, "did you mean PPO?"),
    ('"DQN", "PPO"', '"DQN", "TQC"', 2, "TQC needs a Box action space"),
    ("Acrobot-v1", "Acrobat-v1", 2, "did you mean Acrobot-v1"),
    ("Acrobot-v1", "os:Acrobot-v1", 2, "no file may name a module"),
    ("Acrobot-v1", "CartPole-v1", 2, "names one twice"),
    ("train_freq = 8", "train_freq = 'x'", 17, "train_freq='x' must be"),
    ("  8,", "  'x',", 12, "net_arch=['x'] must hold"),
    ("memory", "memori", 20, "did you mean memory?"),
    ("2 GB", "2 XB", 20, "such as '4 GB'"),
    ("seeds = 2", "seeds = [1, 1]", 4, "different seeds"),
    ("seeds = 2", "seeds = nan", 4, "finite"),
    ("seeds = 2", "seeds = 2021-01-01", 4, "must be a number, a string"),
    ("seeds = 2", "seeds = [", 5, "expected TOML"),
    ("[settings.fast]", "[settings.default]", 10, "twice"),
    ("evaluate_every = 500", "minutes = 3", 6, "exclude each other"),
    ("evaluate_every = 500", "log = ['jsn']", 6, "expected any of"),
    ("evaluate_every = 500", "backend = 'envpol'", 6, "must be 'auto'"),
    ("evaluate_every = 500", "env_kwargs = {render_mode = 'human'}", 6, "render_mode=human"),
    ("evaluate_every = 500", "env_kwargs = {foo = 1}", 2, "unexpected keyword argument"),
    ("evaluate_every = 500", "threads = 0", 6, "threads=0 must be"),
    ("train_freq = 8", "buffer_size = 1_000_000_000_000_000", 17, "at most 1000000000000"),
]


@pytest.mark.parametrize(("old", "new", "line", "problem"), MISTAKES, ids=[one[1] for one in MISTAKES])
def test_a_mistake_is_one_line_with_its_place(tmp_path, old, new, line, problem):
    assert old in PLAN
    path = write(tmp_path, PLAN.replace(old, new, 1))
    with pytest.raises(PlanError) as raised:
        read_plan(path)
    message = str(raised.value)
    assert message.startswith(f"{path}, line {line}: ")
    assert problem in message
    assert "\n" not in message


def test_a_mistake_in_a_dict_is_named_by_its_path():
    with pytest.raises(PlanError, match=r"plan, settings\.a\.gama: PPO has no setting 'gama'; did you mean gamma"):
        read_plan({"environments": ["CartPole-v1"], "algorithms": ["PPO"], "settings": {"a": {"gama": 1}}})


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
    with pytest.raises(PlanError, match="lines"):
        read_plan(write(tmp_path, "\n" * 2000))
    with pytest.raises(PlanError, match="nested"):
        read_plan({"environments": "CartPole-v1", "settings": {"a": {"b": deep(30)}}})
    with pytest.raises(FileNotFoundError):
        read_plan(tmp_path / "none.toml")


def deep(n):
    return {"b": deep(n - 1)} if n else 1


def test_a_line_is_found_in_tables_and_across_lines():
    text = "a = 1\n[b]\nc = [\n 1,\n]\n\n[b.d]\n'e f'.g = 2\n"
    assert line_of(text, ("b", "c")) == 3
    assert line_of(text, ("b", "d", "e f", "g")) == 8
    assert line_of(text, ("b", "d", "missing")) == 7
    assert line_of(text, ()) == 1


def test_a_line_that_is_not_certain_is_that_of_the_table():
    text = (
        '[a]\n# b = 1\n\'b = 2\' = 0\nb = 3\n"e\\tf" = 4\n["g\\t".h]\nc = 5\n[i . "j.k"]\nrows = [\n [1],\n]\nc = 6\n'
    )
    assert line_of(text, ("a", "b")) == 4  # neither the comment nor the key that contains a =
    assert line_of(text, ("a", "e\tf")) == 1
    assert line_of(text, ("a", "c")) == 1
    assert line_of(text, ("i", "j.k", "rows")) == 9
    assert line_of(text, ("i", "j.k", "c")) == 8


def test_an_invalid_plan_starts_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlanError):
        rejeu.sweep({"environments": "CartPole-v1", "stepz": 1})
    assert list(tmp_path.iterdir()) == []
