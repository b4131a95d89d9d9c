"""Population-based training: decisions, copies, interruptions. The trainings only pretend."""

import csv
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from rejeu.algorithms.search import Choice, Integers, LogUniform, NearOne, Uniform
from rejeu.errors import CheckpointError, RunInUseError
from rejeu.experiments import population as populations, process
from rejeu.experiments.population import Members
from rejeu.experiments.space import encoded
from rejeu.interrupt import Interrupt
from rejeu.runs.config import RunConfig

FAKE = Path(__file__).parent / "fake_training.py"
RATE = {"learning_rate": LogUniform(1e-5, 4e-3)}
SPACE = {
    "learning_rate": LogUniform(1e-5, 1e-2),
    "gamma": NearOne(0.9, 0.9999),
    "policy_delay": Integers(1, 4),
    "batch_size": Choice((32, 64, 128)),
    "exploration_final_eps": Uniform(0.0, 0.2),
}


@pytest.fixture(autouse=True)
def pretend(monkeypatch):
    """Lets trainings run the program that pretends."""
    monkeypatch.setattr(process, "program", lambda task: [sys.executable, "-S", str(FAKE), str(task)])
    monkeypatch.setattr("rejeu.experiments.scheduler.POLL", 0.03)
    monkeypatch.setattr(
        "rejeu.experiments.population.copy_run", lambda source, target, seed: shutil.copytree(source, target)
    )


def make(members=4, rounds=3, **changes):
    given = {"env_id": "Pendulum-v1", "algorithm": "SAC", "search": RATE, "only": ("learning_rate",)}
    return populations.make(rounds, 10, members, **{**given, **changes})


CONFIG = RunConfig(env="Pendulum-v1")


def train(members, workers=2, stop=None, echo=lambda text: None):
    return populations.train(members, CONFIG, workers, stop or Interrupt(), echo)


def state_of(members, member):
    """What the newest checkpoint of a member holds."""
    folder = members.run(member) / "checkpoints"
    return json.loads(max(folder.glob("run_*.safetensors")).read_text())


def test_the_worst_copy_the_best_and_all_train_to_the_end(tmp_path):
    members = populations.create(tmp_path / "population", make(members=8))
    lines = []
    assert train(members, echo=lines.append)
    assert len(lines) == 3
    history = members.history()
    assert len(history) == 8 * 3
    for number in range(2):
        scores = [row["score"] for row in history if row["round"] == number]
        order = sorted(range(8), key=lambda i: (-scores[i], i))
        copied = {
            row["member"]: row["copies"] for row in history if row["round"] == number and row["copies"] is not None
        }
        assert copied.keys() == {*order[-2:]}
        assert {*copied.values()} <= {*order[:2]}
    assert all(row["copies"] is None for row in history if row["round"] == 2)
    assert all(state_of(members, member)["step"] == 30 for member in range(8))
    best = json.loads((tmp_path / "population" / "best.safetensors").read_text())
    assert best == state_of(members, members.best())
    with (tmp_path / "population" / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["score"]) for row in rows] == [row["score"] for row in history]


def test_the_first_member_has_the_values_of_the_default_and_is_reproducible():
    initial = make(members=5).initial()
    assert initial[0] == {"learning_rate": 1e-3}
    assert initial == make(members=5).initial() != make(members=5, seed=1).initial()
    assert all(RATE["learning_rate"].contains(one["learning_rate"]) for one in initial)


def test_a_copy_has_weights_of_its_source_and_perturbed_hyperparameters(tmp_path):
    members = populations.create(tmp_path / "population", make(rounds=2))
    assert populations.train_round(members, 0, CONFIG, 4, Interrupt(), print)
    decisions = members.decide(0)
    (worst,) = [i for i, one in enumerate(decisions) if one.parent is not None]
    before = state_of(members, worst)
    members.copy(0)
    source = decisions[worst].parent
    assert before["weight"] != state_of(members, worst)["weight"] == state_of(members, source)["weight"]
    ratio = decisions[worst].next_values["learning_rate"] / decisions[source].values["learning_rate"]
    assert min(abs(ratio - 0.8), abs(ratio - 1.25)) < 1e-9
    (members.run(worst) / "checkpoints" / "mine").write_text("not copied again")
    members.copy(0)
    assert (members.run(worst) / "checkpoints" / "mine").exists()


def test_a_population_that_is_resumed_repeats_no_copy_of_an_earlier_round(tmp_path):
    members = populations.create(tmp_path / "population", make(rounds=6))
    assert train(members)
    copies = [row["member"] for row in members.history() if row["copies"] is not None]
    assert len(copies) > len(set(copies))
    before = [state_of(members, member) for member in range(4)]
    assert train(members)
    assert [state_of(members, member) for member in range(4)] == before


def test_a_member_that_was_stopped_in_the_evaluation_of_a_round_evaluates_again(tmp_path):
    members = populations.create(tmp_path / "population", make())
    assert populations.train_round(members, 0, CONFIG, 4, Interrupt(), print)
    before = [members.score(member, 0) for member in range(4)]
    folder = members.run(1) / "checkpoints"
    (newest,) = folder.glob("run_*.safetensors")
    earlier = {**json.loads(newest.read_text()), "step": 5}
    (folder / "run_000000000005.safetensors").write_text(json.dumps(earlier))
    (members.run(1) / "evaluations.csv").unlink()
    assert populations.train_round(members, 0, CONFIG, 4, Interrupt(), print)
    assert members.score(1, 0) is not None
    assert [members.score(member, 0) for member in (0, 2, 3)] == [before[0], *before[2:]]


def test_a_population_that_is_interrupted_goes_on_as_it_would_have(tmp_path):
    undisturbed = populations.create(tmp_path / "undisturbed", make())
    assert train(undisturbed)
    members = populations.create(tmp_path / "population", make())
    stop = Interrupt()

    def interrupt(text):
        stop.signal = 2

    assert not train(members, 4, stop, interrupt)
    assert members.n_decided() == 1
    other = populations.read(tmp_path / "population")
    assert train(other, 1)
    assert other.history() == undisturbed.history()


def test_a_population_that_is_killed_between_decision_and_copy_goes_on_as_it_would_have(tmp_path, monkeypatch):
    undisturbed = populations.create(tmp_path / "undisturbed", make())
    assert train(undisturbed)
    members = populations.create(tmp_path / "population", make())

    def killed(source, target, seed):
        target.mkdir()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("rejeu.experiments.population.copy_run", killed)
        with pytest.raises(KeyboardInterrupt):
            train(members)
    assert train(members)
    assert members.history() == undisturbed.history()


def test_a_member_that_fails_copies_one_of_the_best(tmp_path):
    members = populations.create(
        tmp_path / "population", make(members=6, seed=2, search={"learning_rate": LogUniform(1e-3, 1e-2)})
    )
    failing = [i for i, one in enumerate(members.population.initial()) if one["learning_rate"] > 5e-3]
    assert failing
    lines = []
    assert train(members, echo=lines.append)
    assert any(
        f"member {failing[0]} in round 0 failed with exit status 2: at step 20: the loss is NaN" in one for one in lines
    )
    rows = [row for row in members.history() if row["member"] == failing[0]]
    assert rows[0]["score"] is None
    assert rows[0]["copies"] is not None
    assert rows[1]["score"] is not None


def test_a_population_in_which_all_fail_is_an_error(tmp_path):
    members = populations.create(
        tmp_path / "population", make(search={"learning_rate": LogUniform(6e-3, 1e-2)}, fixed={"gamma": 0.9})
    )
    with pytest.raises(ValueError, match="all members failed; see their logs"):
        train(members)


@pytest.mark.parametrize("rounds", [1, 2])
def test_a_population_whose_measure_has_no_value_ends_with_one_line(tmp_path, rounds):
    members = populations.create(tmp_path / "population", make(members=2, rounds=rounds, measure="success"))
    for _ in range(2):  # also when it is resumed
        lines = []
        with pytest.raises(ValueError, match="all members failed"):
            train(members, echo=lines.append)
        assert len(lines) == 2
    commands = [path.read_text().count("\n") for path in tmp_path.rglob("commands.txt")]
    assert commands == [1, 1]


def test_a_member_whose_evaluation_is_lost_copies_another(tmp_path, monkeypatch):
    monkeypatch.setenv("NO_ROW_AT", "10")
    members = populations.create(tmp_path / "population", make(members=2, rounds=2))
    with pytest.raises(ValueError, match="all members failed"):
        train(members)
    monkeypatch.delenv("NO_ROW_AT")
    table = members.run(0) / "evaluations.csv"
    table.write_text(table.read_text() + "10,0.1,nan,1.0,0,1,3,0\n")
    lines = []
    assert train(members, echo=lines.append)
    assert any("member 1 in round 0 ended without a result" in one for one in lines)
    assert members.history()[1]["copies"] == 0


def test_a_member_that_is_killed_continues(tmp_path, monkeypatch):
    undisturbed = populations.create(tmp_path / "undisturbed", make())
    assert train(undisturbed)
    monkeypatch.setenv("KILLED_AT", "10")
    members = populations.create(tmp_path / "population", make())
    assert train(members)
    assert members.history() == undisturbed.history()


def test_two_processes_do_not_train_one_population(tmp_path):
    members = populations.create(tmp_path / "population", make())
    with members.lock(), pytest.raises(RunInUseError, match="another process trains the population"):
        Members(tmp_path / "population", members.population).lock()


def test_decisions():
    values = [{"learning_rate": 10.0**-i} for i in (2, 3, 4, 5)]
    space = {"learning_rate": LogUniform(1e-6, 1e-1)}
    found = populations.decide([1.0, 4.0, None, 0.5], values, space, np.random.default_rng(0))
    assert [one.parent for one in found] == [None, None, 1, 1]
    assert [one.score for one in found] == [1.0, 4.0, None, 0.5]
    assert found[0].next_values == values[0]
    found = populations.decide([float("nan"), 4.0, None, None], values, space, np.random.default_rng(0))
    assert [one.parent for one in found] == [1, None, 1, 1]


@pytest.mark.parametrize("name", SPACE)
def test_perturbed_values_stay_in_the_space_and_move(name):
    rng, dimension = np.random.default_rng(0), SPACE[name]
    value, seen = populations.sample(dimension, rng), []
    for _ in range(200):
        before, value = value, populations.perturbed(dimension, value, rng)
        assert dimension.contains(value)
        assert value != before
        seen.append(value)
    assert len({*seen}) > 2


def test_equal_numbers_of_different_types_are_the_same_choice():
    choice = Choice((1, 2, [3, 4]))
    assert choice.contains(2.0)
    assert not choice.contains(True)
    assert populations.neighbor(choice, 1.0, up=True) == 2
    assert populations.neighbor(choice, [3.0, 4], up=False) == 2
    assert populations.perturbed(Choice((1, 2)), 2.0, np.random.default_rng(0)) == 1
    with pytest.raises(ValueError, match="two or more different values"):
        Choice((1, 1.0))
    assert encoded({"a": choice}, {"a": [3.0, 4.0]}) == {"a": "[3, 4]"}


def test_samples_lie_in_the_space():
    rng = np.random.default_rng(0)
    for dimension in SPACE.values():
        assert all(dimension.contains(populations.sample(dimension, rng)) for _ in range(200))


def test_what_changes_shapes_is_not_searched():
    population = populations.make(2, 10, 4, env_id="CartPole-v1", algorithm="PPO")
    assert "learning_rate" in population.plan.space
    assert not any(populations.is_fixed(name) for name in population.plan.space)
    with pytest.raises(ValueError, match=r"policy_kwargs.net_arch cannot change while a run trains"):
        make(only=("policy_kwargs.net_arch",))
    with pytest.raises(ValueError, match="members=1 must be at least 2"):
        make(members=1)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content | {"rounds": 0},
        lambda content: content | {"plan": 3},
        lambda content: content | {"plan": content["plan"] | {"algorithm": "os"}},
        lambda content: content | {"plan": content["plan"] | {"space": {"gamma": {"kind": "evil"}}}},
    ],
)
def test_damaged_settings_are_one_line(tmp_path, change):
    path = populations.create(tmp_path, make()).path / "population.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(CheckpointError, match=r"population\.json is damaged: "):
        populations.read(tmp_path)


@pytest.mark.parametrize(
    "change", [{"parent": 99}, {"parent": -1}, {"values": {}}, {"next_values": {"learning_rate": 7}}, {"score": "high"}]
)
def test_damaged_decisions_are_one_line(tmp_path, change):
    members = populations.create(tmp_path / "population", make())
    values = {"learning_rate": 1e-3}
    rows = [{"score": 1.0, "values": values, "parent": None, "next_values": values} for _ in range(4)]
    path = members.decisions_file(0)
    path.parent.mkdir()
    path.write_text(json.dumps(rows))
    assert len(members.decisions(0)) == 4
    path.write_text(json.dumps([*rows[:3], rows[3] | change]))
    with pytest.raises(CheckpointError, match=r"0000\.json is damaged: "):
        members.decisions(0)
