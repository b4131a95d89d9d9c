"""Ctrl-C, SIGTERM and SIGHUP: requests while training, the end of the command everywhere else."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

import rejeu
from rejeu.core import interrupt
from rejeu.core.interrupt import Interrupt
from rejeu.lab import cli
from tests.lab.cli.test_cli import TINY
from tests.sharing import shared_learners

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")
SOURCE = Path(interrupt.__file__)


@pytest.fixture(autouse=True, scope="module")
def as_under_nohup():
    """The tests must pass where SIGHUP is ignored, as under ``nohup`` and in some CI systems."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(autouse=True)
def hangups_act(as_under_nohup):
    """Each test, and the processes that it starts, handle SIGHUP as in a terminal."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


def raise_signal(number=signal.SIGTERM):
    os.kill(os.getpid(), number)


def test_an_interrupt_within_another_tells_it_and_the_second_signal_acts_at_once():
    with Interrupt() as outer, Interrupt() as inner:
        raise_signal()
        assert (inner.signal, outer.signal) == (signal.SIGTERM, signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            raise_signal(signal.SIGINT)
    assert (inner.signal, outer.signal) == (signal.SIGTERM, signal.SIGTERM)


def test_handlers_are_put_back():
    before = signal.getsignal(signal.SIGTERM)
    with Interrupt(), interrupt.leaving():
        assert signal.getsignal(signal.SIGTERM) != before
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(("number", "status"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_within_a_callback_of_the_garbage_collector_is_not_swallowed(number, status):
    script = f"""if True:
        import gc, importlib.util, os, signal
        spec = importlib.util.spec_from_file_location("interrupt", {str(SOURCE)!r})
        interrupt = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(interrupt)
        with interrupt.leaving("stopped"):
            gc.callbacks.append(lambda phase, info: os.kill(os.getpid(), signal.{number}))
            gc.collect()
            print("swallowed")
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", "rejeu: stopped\n")


def test_output_to_a_closed_terminal_is_no_error():
    script = """if True:
        import os, pty, sys, time
        from rejeu.core.interrupt import Interrupt
        pid, terminal = pty.fork()
        if pid:
            os.read(terminal, 5)
            os.close(terminal)
            sys.exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
        with Interrupt() as stop:
            print("ready", flush=True)
            while not stop.requested:
                time.sleep(0.02)
            print("stopped", flush=True)
        os._exit(stop.signal)
    """
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == signal.SIGHUP


def test_under_nohup_a_closed_terminal_is_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt() as stop, interrupt.leaving():
            raise_signal(signal.SIGHUP)
        assert stop.signal is None
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_while_a_file_is_written_leaves_the_old_file_and_no_other(tmp_path):
    (tmp_path / "page.html").write_text("old")
    script = f"""if True:
        import os, pathlib, signal
        from rejeu.core import interrupt
        from rejeu.core import atomic
        with interrupt.leaving("stopped"), atomic.replacing(pathlib.Path({str(tmp_path / "page.html")!r})) as file:
            file.write(b"half of the new")
            os.kill(os.getpid(), signal.SIGTERM)
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (143, "rejeu: stopped\n")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert (tmp_path / "page.html").read_text() == "old"


def test_a_stop_within_an_action_that_ends_at_once_has_its_line():
    script = """if True:
        import os, signal
        from rejeu.core import interrupt
        with interrupt.leaving("the models are saved"), interrupt.Interrupt() as stop:  # as while a video is recorded
            os.kill(os.getpid(), signal.SIGINT)
            stop.check()
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "rejeu: the models are saved\n")


@pytest.mark.parametrize("module", ["jax", "tomllib"])  # the second is the first that rejeu imports
@pytest.mark.parametrize(("number", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_during_imports_is_one_line(number, status, module, tmp_path):
    (tmp_path / f"{module}.py").write_text(
        f"import os, signal\nos.kill(os.getpid(), signal.{number})\nprint('went on')\n"
    )
    path = os.pathsep.join([str(tmp_path), str(SOURCE.parents[2])])
    command = [sys.executable, "-m", "rejeu", "evaluate", "run"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", "rejeu: interrupted\n")


def test_importing_the_package_elsewhere_leaves_signals_alone():
    assert not interrupt.is_command()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("program", "is_command"),
    [
        ("/usr/bin/rejeu", True),
        ("Scripts/rejeu.exe", True),
        (str(SOURCE.parents[1] / "__main__.py"), True),  # python -m rejeu, once it runs
        ("train.py", False),
        ("other/__main__.py", False),
    ],
)
def test_the_command_is_known_by_the_program_that_runs(program, is_command, monkeypatch):
    monkeypatch.setattr(sys, "argv", [program, "list"])
    assert interrupt.is_command() == is_command


def test_a_signal_after_training_ends_the_command_and_keeps_the_models(tmp_path, monkeypatch):
    ends, out = [], tmp_path / "run"

    @contextmanager
    def leaving(text):  # which ends the process at once
        ends.append(text)
        yield

    def record_video(*arguments):
        raise SystemExit(143)

    monkeypatch.setattr("rejeu.lab.runs.session.leaving", leaving)
    monkeypatch.setattr("rejeu.logs.video.record_video", record_video)
    argv = ["train", "rejeu/Ball-v0", "--algo", "SAC", "--steps", "60", "--evaluate-episodes", "1"]
    with shared_learners(), pytest.raises(SystemExit):
        cli.main([*argv, "--out", str(out), "--set", *TINY])
    assert ends == [f"interrupted after training; the models are saved in {out}"]
    files = {path.name for path in out.iterdir()}
    assert {"agent.safetensors", "best.safetensors", "checkpoints", "curve.png", "episodes.csv"} <= files


class Still:
    """Does nothing, and sends a signal at its third action."""

    def __init__(self):
        self.calls = 0

    def predict(self, obs, state=None, deterministic=True):
        self.calls += 1
        if self.calls == 3:
            raise_signal()
        return 0, None


def test_a_signal_while_filming_leaves_nothing_of_the_file(tmp_path):
    with pytest.raises(interrupt.Stopped) as stopped:
        rejeu.record_video(Still(), tmp_path / "video.mp4", "CartPole-v1", episodes=1)
    assert stopped.value.signal == signal.SIGTERM
    assert not [*tmp_path.iterdir()]


def test_a_film_made_while_training_is_completed_after_a_signal(tmp_path):
    with Interrupt() as training:
        path = rejeu.record_video(Still(), tmp_path / "video.mp4", "CartPole-v1", episodes=1)
    assert training.requested
    assert [*tmp_path.iterdir()] == [path]


def test_a_command_that_a_signal_ended_ignores_further_ones(monkeypatch):
    """While Python shuts down it restores the default handlers, so a second signal would change the exit status."""
    monkeypatch.setattr(interrupt, "is_command", lambda: True)
    monkeypatch.setattr(cli, "run_command", lambda argv: argv[0])
    before = {number: signal.getsignal(number) for number in interrupt.NAMES}
    try:
        for status in (0, 2):
            assert cli.main([status]) == status
            assert all(signal.getsignal(number) is not signal.SIG_IGN for number in before)
        assert cli.main([143]) == 143
        assert all(signal.getsignal(number) is signal.SIG_IGN for number in before)
    finally:
        interrupt.restore(before)
