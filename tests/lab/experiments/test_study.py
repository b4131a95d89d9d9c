"""Studies with trainings that only pretend, so that what they find is known: the best learning rate is 1e-3."""

import dataclasses
import json
import math
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rejeu.agents import presets
from rejeu.algorithms.search import LogUniform
from rejeu.core.errors import CheckpointError
from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import process, search, study as studies, study_plan as plans, tune as tuning
from rejeu.lab.experiments.search import Search
from rejeu.lab.experiments.study import StudyFolder
from rejeu.lab.runs.config import RunConfig
from tests.lab.experiments.fake_training import Pretended

optuna = pytest.importorskip("optuna")
RATE = {"learning_rate": LogUniform(1e-5, 4e-3)}


@pytest.fixture(autouse=True, scope="module")
def pretend():
    """Lets trainings pretend, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process.LocalLauncher, "start", lambda self, task, log, lock: Pretended(task, log, lock))
        patch.setattr("rejeu.lab.experiments.scheduler.POLL", 0)
        yield


def make_plan(**changes):
    given = {
        "trials": 4,
        "steps": 40,
        "evaluate_every": 10,
        "final_seeds": 5,
        "only": ("learning_rate",),
        "search": RATE,
    }
    return plans.make("Pendulum-v1", "SAC", **{**given, **changes})


def run(study, workers=1, stop=None, watch=lambda trials: None):
    return tuning.run(study, RunConfig(env="Pendulum-v1"), workers, stop or Interrupt(), watch, lambda text: None)


def facts(result):
    """What must be the same in a repetition of a study."""
    return [(one.index, one.state, one.value, one.values, one.evaluations) for one in result.trials]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The result of a study of four trials."""
    return run(tuning.open_study(make_plan(final_seeds=0), tmp_path_factory.mktemp("whole") / "study"))


@pytest.fixture
def journal(whole, tmp_path):
    """The journal in a copy of its folder."""
    shutil.copytree(whole.folder, tmp_path / "study")
    return tmp_path / "study" / "journal.log"


def commands(folder):
    return [line.split() for path in folder.rglob("commands.txt") for line in path.read_text().splitlines()]


def test_a_study_finds_the_best_trial_and_writes_it_as_a_preset(tmp_path):
    result = run(tuning.open_study(make_plan(), tmp_path / "study"))
    assert result.complete
    assert [one.index for one in result.trials] == [0, 1, 2, 3]
    assert result.trials[0].values == {"learning_rate": 1e-3}  # that of rejeu's preset
    assert result.best is result.trials[0]
    assert result.preset.hyperparameters["learning_rate"] == 1e-3
    assert result.preset.hyperparameters["policy_kwargs"] == {"net_arch": [64, 64]}  # of rejeu's preset
    assert result.preset.total_steps == 40
    assert "trial 0 of 4, mean return" in result.preset.source
    assert not list(tmp_path.rglob("checkpoints"))
    assert result.final.verdict == "the default itself"


def test_a_study_with_one_worker_is_reproducible_and_another_seed_differs(whole, tmp_path):
    one, other = (
        run(tuning.open_study(make_plan(seed=seed, trials=trials, final_seeds=0), tmp_path / f"seed {seed}"))
        for seed, trials in ((0, 4), (1, 2))
    )
    assert facts(one) == facts(whole)
    assert facts(one)[1] != facts(other)[1]


def test_an_interrupted_study_continues_as_if_it_had_not_been_interrupted(whole, tmp_path):
    stop = Interrupt()

    def interrupt(trials):
        if trials[-1].index == 2 and trials[-1].evaluations:
            stop.signal = 2

    first = run(tuning.open_study(make_plan(final_seeds=0), tmp_path / "study"), stop=stop, watch=interrupt)
    assert (first.complete, first.signal) == (False, 2)
    assert [one.state for one in first.trials] == ["complete", "complete", "running"]
    second = run(studies.open_study(StudyFolder(tmp_path / "study")))
    assert facts(second) == facts(whole)
    begun = commands(tmp_path / "study")
    assert sorted(word for word, _ in begun) == ["resume", "train", "train", "train", "train"]


def test_a_trial_whose_process_was_killed_is_entered_again_with_its_parameters(whole, tmp_path):
    killed = tuning.open_study(make_plan(final_seeds=0), tmp_path / "study")
    killed.take()
    killed.take()
    for index in (0, 1):
        killed.release(index)  # as the end of a process does
    other = studies.open_study(StudyFolder(tmp_path / "study"))
    assert other.take()[1] == 0
    third = studies.open_study(StudyFolder(tmp_path / "study"))
    assert third.take()[1] == 1  # the first one is held
    other.release(0)
    third.release(1)
    assert facts(run(studies.open_study(StudyFolder(tmp_path / "study")))) == facts(whole)


def test_a_killed_training_continues_and_the_study_is_the_same(whole, tmp_path, monkeypatch):
    monkeypatch.setenv("KILLED_AT", "20")  # each training, once
    result = run(tuning.open_study(make_plan(final_seeds=0), tmp_path / "study"))
    assert facts(result) == facts(whole)
    assert [word for word, _ in commands(tmp_path / "study")].count("resume") == 4


def test_optuna_opens_the_journal(whole):
    """As its dashboard does."""
    path = str(whole.folder / "journal.log")
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(path))
    study = optuna.load_study(study_name=None, storage=storage)
    assert study.best_trial.params == whole.best.values
    assert [trial.value for trial in study.trials] == [one.value for one in whole.trials]
    assert set(study.trials[0].intermediate_values) == {10, 20, 30, 40}


def test_two_processes_share_the_trials_of_a_study(tmp_path):
    one = tuning.open_study(make_plan(trials=3), tmp_path / "study")
    two = studies.open_study(StudyFolder(tmp_path / "study"))
    taken = [one.take(), two.take(), one.take(), two.take()]
    assert [None if it is None else it[1] for it in taken] == [0, 1, 2, None]


def test_several_trials_at_once(tmp_path):
    result = run(tuning.open_study(make_plan(trials=6, final_seeds=0), tmp_path / "study"), workers=3)
    assert [one.index for one in result.trials] == list(range(6))
    assert result.complete


def test_a_trial_is_the_mean_over_its_seeds(tmp_path):
    result = run(tuning.open_study(make_plan(trials=1, trial_seeds=3, final_seeds=0), tmp_path / "study"))
    runs = sorted((tmp_path / "study" / "trials" / "0000").glob("seed_*/config.json"))
    seeds = [json.loads(path.read_text())["seed"] for path in runs]
    assert len(seeds) == 3
    assert result.best.value == pytest.approx(1 + sum(seed % 7 for seed in seeds) / 300)


def test_a_failed_trial_keeps_its_reason_and_does_not_stop_the_study(tmp_path):
    rates = {"learning_rate": LogUniform(6e-3, 1e-2)}
    result = run(tuning.open_study(make_plan(trials=3, search=rates, final_seeds=5), tmp_path / "study"))
    assert [one.state for one in result.trials] == ["failed"] * 3
    assert all(one.reason.endswith("failed with exit status 2: at step 20: the loss is NaN") for one in result.trials)
    assert (result.best, result.final, result.preset) == (None, None, None)
    again = run(studies.open_study(StudyFolder(tmp_path / "study")))
    assert facts(again) == facts(result)
    assert len(commands(tmp_path / "study")) == 3  # failed trials are not repeated


def test_a_trial_below_the_median_is_pruned(tmp_path):
    study = tuning.open_study(
        make_plan(trials=6, steps=200, evaluate_every=20, seed=2, final_seeds=0), tmp_path / "study"
    )
    result = run(study)
    pruned = [one for one in result.trials if one.state == "pruned"]
    assert pruned
    for one in pruned:
        assert one.index >= studies.STARTUP_TRIALS
        assert 200 // 3 <= max(one.evaluations) < 200
        assert one.value == one.evaluations[max(one.evaluations)]
        assert one.value < result.best.value


@pytest.mark.parametrize("pruner", ["halving", "none"])
def test_other_pruners(tmp_path, pruner):
    plan = make_plan(trials=6, steps=200, evaluate_every=20, seed=2, final_seeds=0, pruner=pruner)
    result = run(tuning.open_study(plan, tmp_path / "study"))
    assert (pruner == "halving") == any(one.state == "pruned" for one in result.trials)


def test_the_winner_is_compared_with_the_default_on_fresh_seeds(tmp_path, monkeypatch):
    default = presets.Preset(**{**vars(presets.find("Pendulum-v1")), "hyperparameters": {"learning_rate": 1e-5}})
    study = tuning.open_study(make_plan(preset=default, final_seeds=5, seed=3), tmp_path / "study")
    monkeypatch.setenv("KILLED_AT", "20")  # which changes nothing
    result = run(study, workers=3)
    assert (result.final.verdict, result.final.failed) == ("better", ())
    assert result.final.difference[1] > 0
    assert "on fresh seeds the winner is better than the default by" in str(result.final)
    assert [group.label for group in result.final.comparison.groups] == [
        "default",
        f"winner (trial {result.best.index})",
    ]
    searched = {seed for one in result.trials for seed in study.plan.seeds(one.index)}
    assert not searched & set(study.plan.fresh_seeds())
    n = len(commands(tmp_path / "study"))
    assert run(studies.open_study(StudyFolder(tmp_path / "study"))).final.difference == result.final.difference
    assert len(commands(tmp_path / "study")) == n  # nothing is repeated


def test_difference_says_whether_zero_is_in_the_interval():
    rng = np.random.default_rng(0)
    good, bad = rng.normal(10, 1, 20), rng.normal(0, 1, 20)
    value, low, high = search.difference([good], [bad], 0)
    assert low < value < high
    assert low > 5
    value, low, high = search.difference([bad], [bad[::-1]], 0)
    assert low < 0 < high
    assert value == pytest.approx(0)


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.5, 2.0), "better"),
        ((-0.5, 2.0), "no difference found"),
        ((-2.0, 0.5), "no difference found"),
        ((-2.0, -0.5), "worse"),
    ],
)
def test_the_verdict_is_that_of_the_interval_and_not_of_the_difference_alone(interval, verdict, monkeypatch):
    found = (sum(interval) / 2, *interval)
    for name, value in {
        "is_default": False,
        "difference": found,
        "compare": None,
        "finished": [],
        "last_values": 0,
    }.items():
        monkeypatch.setattr(search, name, lambda *_, value=value, **__: value)
    monkeypatch.setattr(search, "MIN_FINAL_SEEDS", 0)
    best = studies.Trial(0, "complete", 1.0, {}, {}, 1.0, "")
    final = search.compared(SimpleNamespace(plan=make_plan(), folder=StudyFolder(Path()), preset_of=print), best, [])
    assert (final.verdict, final.difference, final.measure) == (verdict, found, "return")


def test_the_best_trial_is_a_complete_one_and_of_equals_the_first():
    trials = [
        ("failed", 9.0),
        ("complete", 1.0),
        ("complete", 2.0),
        ("pruned", 5.0),
        ("complete", 2.0),
        ("running", 7.0),
    ]
    trials = [studies.Trial(i, state, value, {}, {}, 1.0, "") for i, (state, value) in enumerate(trials)]
    assert studies.best_of(trials).index == 2
    assert studies.best_of([trials[0], trials[3], trials[5]]) is None


def test_trainings_are_those_of_the_plan_and_as_many_at_once_as_asked(tmp_path, monkeypatch):
    begun = []
    monkeypatch.setattr(tuning, "Search", lambda *given: begun.extend(given) or SimpleNamespace(run=print, scheduler=0))
    plan = make_plan(checkpoint_minutes=2.0, trial_seeds=2)
    study, stop = studies.open_study(StudyFolder(tmp_path), plan), Interrupt()
    with pytest.raises(AttributeError, match="left"):
        run(study, workers=3, stop=stop)
    assert begun == [study, RunConfig(env="Pendulum-v1", checkpoint_minutes=2.0), 3, stop]
    search = Search(study, begun[1], 3, stop)
    assert search.scheduler.launcher.capacity == 6
    search.begin()
    assert len(search.running) == 3
    folder = StudyFolder(tmp_path).trial(0)
    first = search.running[0].trainings[1]
    assert first.task().run == dataclasses.replace(begun[1], preset=str(folder / "preset.json"), seed=plan.seeds(0)[1])
    for one in search.running:
        study.release(one.index)


def test_runs_at_once_share_the_cores(monkeypatch):
    monkeypatch.setattr(process.hardware, "cores", lambda: 8)
    for name in process.THREADS:
        monkeypatch.delenv(name, raising=False)
    assert process.default_workers() == 4
    assert [process.threads_of(n) for n in (1, 3, 8, 20)] == [8, 2, 1, 1]
    for threads, expected in ((None, "2"), (5, "5")):
        environ = process.LocalLauncher(3, threads)._environ
        assert [environ[name] for name in (*process.THREADS, process.hardware.CORES)] == [expected] * 4


def test_more_trials_continue_a_study_and_another_plan_is_refused(journal, tmp_path):
    before = journal.read_bytes()
    journal.write_bytes(before + b'{"op_code":6,"wor')  # half a line of a killed process, which is cut
    (tmp_path / "study" / "journal.log.lock").touch()  # as Optuna's own lock leaves it, for which nobody waits
    began = time.monotonic()
    result = run(tuning.open_study(make_plan(trials=5, final_seeds=0), tmp_path / "study"))
    assert time.monotonic() - began < 10
    assert len(result.trials) == 5
    assert studies.open_study(StudyFolder(tmp_path / "study")).plan.trials == 5  # as rejeu resume opens it
    assert journal.read_bytes().startswith(before)
    with pytest.raises(ValueError, match=r"another study: steps is 40 there, not 80; .* --out"):
        tuning.open_study(make_plan(steps=80), tmp_path / "study")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=r"holds something else than study\.json"):
        tuning.open_study(make_plan(), tmp_path / "mine")


@pytest.mark.parametrize("place", [0.3, 0.6])
def test_a_damaged_journal_is_one_line_and_is_not_changed(journal, place):
    content = bytearray(journal.read_bytes())
    at = int(len(content) * place)
    content[at : at + 40] = b"\xff" * 40
    journal.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"journal\.log is damaged: .*; restore it from a copy"):
        run(studies.open_study(StudyFolder(journal.parent)))
    assert journal.read_bytes() == content


def test_a_journal_that_is_nested_too_deeply_or_a_link_is_refused(journal, tmp_path):
    with journal.open("ab") as file:
        file.write(b"[" * 100_000 + b"]" * 100_000 + b"\n")
    with pytest.raises(CheckpointError, match=r"journal\.log is damaged"):
        studies.open_study(StudyFolder(journal.parent))
    journal.unlink()
    journal.symlink_to(tmp_path / "mine")
    with pytest.raises(CheckpointError, match="is a link and no file"):
        studies.open_study(StudyFolder(journal.parent))
    assert not (tmp_path / "mine").exists()


def test_the_value_of_a_trial_must_be_finite(tmp_path):
    study = tuning.open_study(make_plan(), tmp_path / "study")
    trial, index = study.take()
    study.finish(trial, index, "complete", math.nan)
    assert study.trials()[0].state == "failed"
    assert study.trials()[0].reason == "its last evaluation has the return nan"


def test_processes_are_ended_if_the_search_ends_by_an_error(tmp_path):
    study = tuning.open_study(make_plan(steps=4000), tmp_path / "study")
    search = Search(study, RunConfig(env="Pendulum-v1"), 1, Interrupt())
    begun = []

    def fail(trials):
        begun.extend(attempt.handle for attempt in search.scheduler.running)
        if begun:
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        search.run(fail)
    assert begun
    assert [one.poll() for one in begun] == [143]


def test_a_study_with_fewer_final_seeds_than_are_compared_today_gets_more(tmp_path):
    with pytest.raises(ValueError, match="final_seeds=4 cannot tell luck from a difference; give 5 or more"):
        make_plan(final_seeds=4)
    old = dataclasses.replace(make_plan(), final_seeds=3)  # of an earlier version
    assert old.fresh_seeds() == make_plan().fresh_seeds()
    assert dataclasses.replace(old, final_seeds=0).fresh_seeds() == []


def test_trainings_of_the_final_comparison_that_were_stopped_have_not_ended(monkeypatch):
    class Stopping:
        def __init__(self, launcher, stop, say, waits):
            self.say = say

        def add(self, works):
            pass

        def run(self):
            self.say("stopped")

    said = []
    monkeypatch.setattr(search, "Scheduler", Stopping)
    tasks = [SimpleNamespace(name=one, ending=one, reason="") for one in ("done", "failed", "stopped", "stopped")]
    search.train_final(tasks, 1, Interrupt(), said.append)
    assert said == ["final comparison: 2 of 4 trainings have ended; stopped"]
