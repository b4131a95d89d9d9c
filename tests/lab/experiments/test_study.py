"""Studies with trainings that only pretend, so that what they find is known: the best learning rate is 1e-3."""

import dataclasses
import json
import math
import shutil
import time
from types import SimpleNamespace

import numpy as np
import pytest

from rejeu.agents import presets
from rejeu.algorithms.search import LogUniform
from rejeu.core.errors import CheckpointError
from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import final, study as studies, study_plan as plans, tune as tuning
from rejeu.lab.experiments.search import Search
from rejeu.lab.experiments.study import StudyFolder
from rejeu.lab.runs import process
from rejeu.lab.runs.config import RunConfig
from tests.lab.experiments.fake_training import Pretended
from tests.tiers import only

optuna = pytest.importorskip("optuna")
RATE = {"learning_rate": LogUniform(1e-5, 4e-3)}


@pytest.fixture(autouse=True, scope="module")
def pretend():
    """Lets trainings pretend, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process.LocalLauncher, "start", lambda self, task, log: Pretended(task, log))
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


RUN = RunConfig(env="Pendulum-v1")


def run(study, workers=1, stop=None, echo=lambda text: None):
    return tuning.run(study, RUN, workers, stop or Interrupt(), echo)


def resumed(folder):
    return studies.open_study(StudyFolder(folder))


def records(result):
    return result.to_dict()["trials"]


def facts(result):
    """The trials of a study, without their times."""
    return [{**record, "seconds": 0} for record in records(result)]


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
    assert [trial.number for trial in result.trials] == [0, 1, 2, 3]
    assert result.trials[0].params == {"learning_rate": 1e-3}  # that of rejeu's preset
    assert result.best.number == 0
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


def test_an_interrupted_study_continues_as_if_it_had_not_been_interrupted(whole, tmp_path, monkeypatch):
    stop, report = Interrupt(), optuna.Trial.report

    def interrupt(trial, value, step):
        report(trial, value, step)
        stop.signal = 2 if trial.number == 2 else None

    monkeypatch.setattr(optuna.Trial, "report", interrupt)
    first = run(tuning.open_study(make_plan(final_seeds=0), tmp_path / "study"), stop=stop)
    assert (first.complete, first.signal) == (False, 2)
    assert [record["state"] for record in records(first)] == ["complete", "complete", "running"]
    monkeypatch.undo()
    monkeypatch.setattr(process.LocalLauncher, "start", lambda self, task, log: Pretended(task, log))
    monkeypatch.setattr("rejeu.lab.experiments.scheduler.POLL", 0)
    assert facts(run(resumed(tmp_path / "study"))) == facts(whole)
    begun = commands(tmp_path / "study")
    assert sorted(word for word, _ in begun) == ["resume", "train", "train", "train", "train"]


def test_a_trial_that_lost_its_process_is_continued_by_the_next_one(whole, tmp_path):
    lost = tuning.open_study(make_plan(final_seeds=0), tmp_path / "study")
    for trial in (lost.take(RUN), lost.take(RUN)):
        trial.lock.release()  # as the end of a process does
    other, third = resumed(tmp_path / "study"), resumed(tmp_path / "study")
    continued = other.take(RUN), third.take(RUN)  # each holds one
    assert [trial.trial.number for trial in continued] == [0, 1]
    for trial in continued:
        trial.lock.release()
    assert facts(run(resumed(tmp_path / "study"))) == facts(whole)


def test_a_pruned_trial_stays_pruned_if_everything_is_killed_before_it_stops(tmp_path, monkeypatch):
    plan = make_plan(trials=3, steps=200, evaluate_every=20, seed=2, final_seeds=0, pruner="halving")
    undisturbed = run(tuning.open_study(plan, tmp_path / "undisturbed"))
    index = next(record["index"] for record in records(undisturbed) if record["state"] == "pruned")
    study = tuning.open_study(plan, tmp_path / "study")

    def killed(scheduler, *trainings):
        if trainings and trainings[0].folder.name == f"{index:04d}":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("rejeu.lab.experiments.scheduler.Scheduler.ask_to_stop", killed)
        with pytest.raises(KeyboardInterrupt):
            run(study)
    assert facts(run(resumed(tmp_path / "study"))) == facts(undisturbed)


@pytest.mark.parametrize("line", only([1, 3, 10], range(25)))
def test_a_study_continues_from_every_line_of_its_journal(whole, journal, line):
    """Each line is written at once, so this is what a killed process leaves behind, without the files of its runs."""
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:line]))
    shutil.rmtree(journal.parent / "trials")
    assert facts(run(resumed(journal.parent))) == facts(whole)


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
    assert study.best_trial == whole.best
    assert study.trials == [*whole.trials]
    assert set(study.trials[0].intermediate_values) == {10, 20, 30, 40}


def test_two_processes_share_the_trials_of_a_study(tmp_path):
    studies_of_two = tuning.open_study(make_plan(trials=3), tmp_path / "study"), resumed(tmp_path / "study")
    trials = [studies_of_two[i % 2].take(RUN) for i in range(4)]
    assert [trial and trial.trial.number for trial in trials] == [0, 1, 2, None]
    for trial in trials[:3]:
        trial.lock.release()


def test_several_trials_at_once(tmp_path):
    result = run(tuning.open_study(make_plan(trials=6, final_seeds=0), tmp_path / "study"), workers=3)
    assert [trial.number for trial in result.trials] == list(range(6))
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
    assert [record["state"] for record in records(result)] == ["failed"] * 3
    reason = "failed with exit status 2: at step 20: the loss is NaN"
    assert all(record["reason"].endswith(reason) for record in records(result))
    assert (result.best, result.final, result.preset) == (None, None, None)
    again = run(resumed(tmp_path / "study"))
    assert facts(again) == facts(result)
    assert len(commands(tmp_path / "study")) == 3  # failed trials are not repeated


def test_a_trial_below_the_median_is_pruned(tmp_path):
    study = tuning.open_study(
        make_plan(trials=6, steps=200, evaluate_every=20, seed=2, final_seeds=0), tmp_path / "study"
    )
    result = run(study)
    pruned = [record for record in records(result) if record["state"] == "pruned"]
    assert pruned
    for record in pruned:
        assert record["index"] >= studies.STARTUP_TRIALS
        last = max(record["evaluations"])
        assert 200 // 3 <= last < 200
        assert record["value"] == record["evaluations"][last] < result.best.value


@pytest.mark.parametrize("pruner", ["halving", "none"])
def test_other_pruners(tmp_path, pruner):
    plan = make_plan(trials=6, steps=200, evaluate_every=20, seed=2, final_seeds=0, pruner=pruner)
    result = run(tuning.open_study(plan, tmp_path / "study"))
    assert (pruner == "halving") == any(record["state"] == "pruned" for record in records(result))


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
        f"winner (trial {result.best.number})",
    ]
    searched = {seed for trial in result.trials for seed in study.plan.seeds(trial.number)}
    assert not searched & set(study.plan.fresh_seeds())
    n = len(commands(tmp_path / "study"))
    assert run(resumed(tmp_path / "study")).final.difference == result.final.difference
    assert len(commands(tmp_path / "study")) == n  # nothing is repeated


def test_difference_says_whether_zero_is_in_the_interval():
    rng = np.random.default_rng(0)
    good, bad = rng.normal(10, 1, 20), rng.normal(0, 1, 20)
    value, low, high = final.difference([good, bad], 0)
    assert low < value < high
    assert low > 5
    value, low, high = final.difference([bad, bad[::-1]], 0)
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
    difference = (sum(interval) / 2, *interval)
    replaced = {"final_folders": {}, "difference": difference, "compare": None, "MIN_FINAL_SEEDS": 0}
    for name, value in replaced.items():
        monkeypatch.setattr(final, name, value if name.isupper() else lambda *_, value=value, **__: value)
    monkeypatch.setattr(final, "final_folders", lambda *_: {"winner": None, "default": None})
    monkeypatch.setattr(final, "finished", lambda *_: [])
    result = final.compared(SimpleNamespace(plan=make_plan()), None)
    assert (result.verdict, result.difference, result.measure) == (verdict, difference, "return")


def test_the_best_trial_is_a_complete_one_and_of_equals_the_first(tmp_path):
    study = tuning.open_study(make_plan(trials=6), tmp_path / "study")
    assert study.best() is None
    ends = [("FAIL", 9.0), ("RUNNING", 1.0), ("RUNNING", 2.0), ("PRUNED", 5.0), ("RUNNING", 2.0)]
    for state, value in ends:
        trial = study.take(RUN)
        trial.trial.report(value, 10)
        trial.evaluations = {10: value}
        if state != "RUNNING":
            trial.end(state)
        trial.finish(study.plan)
    running = study.take(RUN)
    assert study.best().number == 2
    assert study.best() == study.optuna_study.best_trial
    running.lock.release()


def test_trainings_are_those_of_the_plan_and_as_many_at_once_as_asked(tmp_path, monkeypatch):
    begun = []
    monkeypatch.setattr(tuning, "Search", lambda *given: begun.extend(given) or SimpleNamespace(run=print, scheduler=0))
    plan = make_plan(checkpoint_minutes=2.0, trial_seeds=2)
    study, stop = studies.open_study(StudyFolder(tmp_path), plan), Interrupt()
    with pytest.raises(AttributeError, match="left"):
        run(study, workers=3, stop=stop)
    assert begun == [study, dataclasses.replace(RUN, checkpoint_minutes=2.0), 3, stop]
    search = Search(*begun)
    assert search.scheduler.launcher.capacity == 6
    monkeypatch.setattr(search.study, "is_searched", lambda: True)
    search.turn(print)
    assert len(search.running) == 3
    first, preset = search.running[0].trainings[1], tmp_path / "trials" / "0000" / "preset.json"
    assert first.task().run == dataclasses.replace(begun[1], preset=str(preset), seed=plan.seeds(0)[1])
    for trial in search.running:
        trial.lock.release()


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
    assert resumed(tmp_path / "study").plan.trials == 5  # as rejeu resume opens it
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


def test_a_journal_larger_than_any_is_refused_before_it_is_read(journal, monkeypatch):
    monkeypatch.setattr(studies, "MAX_BYTES", 100)
    with pytest.raises(CheckpointError, match=r"journal\.log is damaged: Malformed: it has more than 100 bytes"):
        studies.open_study(StudyFolder(journal.parent))


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


def test_a_study_of_somebody_else_that_minimizes_is_refused(tmp_path):
    plans.folders.begin(tmp_path, plans.FILE, make_plan(), plans.read, plans.difference)
    backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / "journal.log"))
    optuna.create_study(storage=optuna.storages.JournalStorage(backend), study_name=studies.NAME)
    with pytest.raises(CheckpointError, match=r"journal\.log is damaged: .* it does not maximize one value"):
        resumed(tmp_path)


def test_trials_that_another_program_enqueued_are_left_alone(journal):
    study = resumed(journal.parent)
    study.optuna_study.enqueue_trial({"learning_rate": 2e-3})
    result = run(study)
    assert result.complete
    assert len(result.trials) == 4


def test_the_value_of_a_trial_must_be_finite(tmp_path):
    study = tuning.open_study(make_plan(), tmp_path / "study")
    trial = study.take(RUN)
    trial.evaluations[40] = math.nan
    trial.finish(study.plan)
    (record,) = map(study.record, study.trials())
    assert (record["state"], record["reason"]) == ("failed", "its last evaluation has the return nan")


def test_processes_are_ended_if_the_search_ends_by_an_error(tmp_path):
    study = tuning.open_study(make_plan(steps=4000), tmp_path / "study")
    search = Search(study, RUN, 1, Interrupt())
    begun = []

    def fail():
        begun.extend(attempt.handle for attempt in search.scheduler.running)
        if begun:
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        search.run(fail)
    assert begun
    assert [one.poll() for one in begun] == [143]


@pytest.mark.parametrize("n_seeds", [1, 4])
def test_a_comparison_of_too_few_seeds_is_refused(n_seeds):
    with pytest.raises(ValueError, match=f"final_seeds={n_seeds} cannot tell luck from a difference; give 5 or more"):
        make_plan(final_seeds=n_seeds)


def test_trainings_of_the_final_comparison_that_were_stopped_have_not_ended(tmp_path, monkeypatch):
    class Stopping:
        def __init__(self, launcher, stop, say, waits):
            self.stop, self.say = stop, say

        def add(self, works):
            for work, ending in zip(works, ("done", "failed", "stopped", "stopped"), strict=False):
                work.ending = ending

        def run(self):
            self.stop.signal = 2
            self.say("stopped")

    texts = []
    monkeypatch.setattr(final, "Scheduler", Stopping)
    monkeypatch.setattr(final, "is_default", lambda *_: False)
    study = tuning.open_study(make_plan(), tmp_path / "study")
    trial = study.take(RUN)
    trial.lock.release()
    assert final.compare_with_default(study, study.trials()[0], RUN, 1, Interrupt(), texts.append) is None
    assert texts[1] == "final comparison: 2 of 10 trainings have ended; stopped"


HOSTILE = [
    {"op_code": 4, "worker_id": "a", "study_id": 0, "datetime_start": None, "state": "os.system"},
    {"op_code": 4, "worker_id": "a", "study_id": 0, "datetime_start": "never", "state": 0},
    {"op_code": 4, "worker_id": "a", "study_id": 0, "datetime_start": "2026-01-01", "state": 1, "values": [1e9]},
    {"op_code": 4, "worker_id": "a", "study_id": 0, "datetime_start": "2026-01-01", "state": 0, "params": {"gamma": 1}},
    {"op_code": 6, "worker_id": "a", "trial_id": 0, "state": 1, "values": [1, 2], "datetime_complete": "2026-01-01"},
    {"op_code": 7, "worker_id": "a", "trial_id": 0, "step": 10, "intermediate_value": "__import__('os')"},
    {"op_code": 99, "worker_id": "a"},
    {"op_code": 6},
    ["posix", "system"],
]


@pytest.mark.parametrize("record", HOSTILE, ids=range(len(HOSTILE)))
def test_a_journal_of_somebody_else_is_refused_in_one_line(tmp_path, record):
    study = tuning.open_study(make_plan(trials=2), tmp_path / "study")
    study.take(RUN).lock.release()
    with study.folder.journal.open("a") as file:
        print(json.dumps(record), file=file)
    with pytest.raises(CheckpointError, match=r"journal\.log is damaged: ") as error:
        resumed(tmp_path / "study")
    assert "\n" not in str(error.value)
