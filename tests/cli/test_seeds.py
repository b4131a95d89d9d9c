"""``rejeu train --seeds``."""

import json
import subprocess
import sys

import pytest

from rejeu import cli, xla
from rejeu.cli import seeds
from rejeu.cli.commands import Train
from rejeu.interrupt import Interrupt
from tests.reporting.test_comparison import write_run

PROGRAM = "import sys; print('the seed is', sys.argv[1]); sys.exit(2 * (sys.argv[1] == '1'))"
SLEEP = (
    "import signal, sys, time; signal.signal(signal.SIGINT, lambda *_: sys.exit(130)); "
    "print('on', flush=True); time.sleep(60)"
)


def start(program):
    """Returns a replacement of ``Job.start`` that runs another program."""

    def run(job, arguments, environ):
        with job.log.open("wb") as log:
            job.process = subprocess.Popen(
                [sys.executable, "-c", program, str(job.seed)], stdout=log, stderr=log, env=environ
            )
        write_run(job.path, seed=job.seed, level=10.0 + job.seed)

    return run


def test_a_seed_that_fails_keeps_its_log_and_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(seeds.Job, "start", start(PROGRAM))
    out = tmp_path / "out"
    assert cli.main(["train", "CartPole-v1", "--seeds", "4", "--jobs", "2", "--seed", "0", "--out", str(out)]) == 2
    printed = capsys.readouterr().out
    assert "seed 1 failed with exit status 2: the seed is 1" in printed
    assert "DQN on CartPole-v1: IQM" in printed
    assert "4 runs" in printed
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == [f"seed_{seed}" for seed in range(4)]
    for seed in range(4):
        assert (out / f"seed_{seed}.log").read_text(encoding="utf-8").strip() == f"the seed is {seed}"


def test_result_as_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(seeds.Job, "start", start(PROGRAM))
    assert (
        cli.main(["train", "CartPole-v1", "--seeds", "2", "--seed", "2", "--json", "--out", str(tmp_path / "a")]) == 0
    )
    content = json.loads(capsys.readouterr().out)
    assert [(row["seed"], row["exit_status"]) for row in content["runs"]] == [(2, 0), (3, 0)]
    assert content["comparison"][0]["runs"] == 2


@pytest.mark.skipif(sys.platform == "win32", reason="the console sends Ctrl-C to all processes")
def test_ctrl_c_stops_all_processes_and_starts_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(seeds.Job, "start", start(SLEEP))
    jobs = [seeds.Job(seed, tmp_path) for seed in range(3)]
    stop = Interrupt()
    monkeypatch.setattr(seeds.time, "sleep", lambda _: stop_when_on(jobs, stop))
    seeds.train(jobs, Train("CartPole-v1"), 2, stop)
    assert [job.status for job in jobs] == [130, 130, None]


def stop_when_on(jobs, stop):
    if all("on" in job.log.read_text(encoding="utf-8") for job in jobs[:2]):
        stop.signal = 2


def test_options_are_passed_on():
    arguments = Train(
        "CartPole-v1",
        algo="DQN",
        steps=500,
        seeds=3,
        seed=1,
        checkpoint_minutes=0.5,
        imports=("my_module",),
        assignments=(("gamma=0.9", "tau=1"),),
    )
    words = seeds.options(arguments)
    assert words == [
        *("--import", "my_module", "--algo", "DQN", "--steps", "500"),
        *("--set", "gamma=0.9", "tau=1", "--checkpoint-minutes", "0.5"),
    ]


def test_each_process_gets_its_share_of_the_cores(monkeypatch):
    monkeypatch.setattr(xla, "cores", lambda: 8)
    for name in (*seeds.THREADS, xla.THREADS):
        monkeypatch.delenv(name, raising=False)
    assert seeds.environment(2)["OMP_NUM_THREADS"] == "4"
    assert seeds.environment(8)[xla.THREADS] == "1"


def test_jobs_without_seeds(capsys):
    assert cli.main(["train", "CartPole-v1", "--jobs", "2"]) == 2
    assert "--jobs is for several seeds" in capsys.readouterr().err


@pytest.mark.exhaustive  # starts three processes that train, half a minute
def test_two_seeds_are_trained_and_compared(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["--algo", "DQN", "--steps", "600", "--seeds", "2", "--seed", "3", "--no-report", "--out", str(out)]
    assert cli.main(["train", "CartPole-v1", *arguments]) == 0
    assert "2 runs" in capsys.readouterr().out
    assert (out / "seed_4" / "agent.safetensors").is_file()
