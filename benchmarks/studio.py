"""Measures the studio: watching an agent, a table of many runs, a server that is killed while runs train, keys of games.

    python benchmarks/studio.py watching CartPole-v1 5
    python benchmarks/studio.py table 2000
    python benchmarks/studio.py busy 2 10
    python benchmarks/studio.py kills 10
    python benchmarks/studio.py memory MINUTES
    python benchmarks/studio.py keys CartPole-v1 FrozenLake-v1 parking-v0

Pages are opened in headless Chromium, which draws in software here. It has the least priority, so that its work is kept apart
as far as the system can do that; ``--browser-priority 0`` counts it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from rejeu.logs.tables import read_table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.lab.reporting.report.folders import CONFIG, write

LOADING, WHILE = 8, 15
"""Seconds until an agent is shown, and of each measurement."""
PAUSES = """window.longest = 0; let last = performance.now();
(function look(now) { window.longest = Math.max(window.longest, now - last); last = now; requestAnimationFrame(look); }
)(last)"""


KEYS = """() => { window.took = []; let pressed = null, awaited = 0;
const screen = document.querySelector(".screen");
addEventListener("keydown", (event) => {
  if (!event.repeat) [pressed, awaited] = [performance.now(), Number(screen.dataset.presses) + 1]; }, true);
new MutationObserver(() => {
  if (pressed === null || Number(screen.dataset.presses) < awaited) return;
  const began = pressed;
  pressed = null;
  requestAnimationFrame(() => window.took.push(performance.now() - began));
}).observe(screen, { attributes: true }); }"""
"""Milliseconds from a key to the animation frame after the picture that has taken it was drawn."""
PRESSES = 200


@contextmanager
def served(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Context of a server of the studio, with its address."""
    command = [sys.executable, "-m", "rejeu", "studio", str(folder), "--port", "0", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    assert process.stdout is not None
    try:
        yield process, process.stdout.readline().split()[0]
    finally:
        process.kill()
        process.wait()


@contextmanager
def opened(address: str, path: str, priority: int) -> Iterator[Page]:
    """Context of a page in Chromium."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        for line in subprocess.run(["ps", "-eo", "pid,comm"], capture_output=True, text=True).stdout.splitlines():
            if "chrom" in line and priority != before:
                os.setpriority(os.PRIO_PROCESS, int(line.split()[0]), priority)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(address.replace("/?", f"{path}{'&' if '?' in path else '?'}", 1))
        yield page
        browser.close()


def train(folder: Path, name: str, env: str, steps: int, *more: str) -> subprocess.Popen[str]:
    """Starts a run."""
    words = ["train", env, "--steps", str(steps), "--seed", "0", "--out", str(folder / name)]
    words += ["--no-report", "--no-video", "--json", "--evaluate-every", str(steps), *more]
    return subprocess.Popen(
        [sys.executable, "-m", "rejeu", *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def rate(process: subprocess.Popen[str]) -> float:
    """Returns the steps a second of a run, when it has ended."""
    return float(json.loads(process.communicate()[0])["steps_per_second"])


def counted(times: list[float], data: str | bytes) -> None:
    """Notes when a picture came."""
    if isinstance(data, bytes):
        times.append(time.monotonic())


def last_row(run: Path) -> tuple[float, float]:
    """Returns step and seconds of training of the last episode of a run."""
    table = read_table(run / "episodes.csv", ("step", "seconds"))
    return (float(table.column("step")[-1]), float(table.column("seconds")[-1])) if len(table) else (0.0, 0.0)


def cpu(pid: int) -> float:
    """Returns the processor time of a process in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def speed(run: Path, page: Page, pids: tuple[int, int]) -> tuple[float, float, float]:
    """Returns the steps of a run a second, those a second of its processor time, and the cores that the server takes.

    They are measured over a while, which begins after the agent of the page was loaded.
    """
    page.wait_for_timeout(1000 * LOADING)
    before, used, began = last_row(run), [cpu(pid) for pid in pids], time.monotonic()
    page.wait_for_timeout(1000 * WHILE)
    after, used_now, seconds = last_row(run), [cpu(pid) for pid in pids], time.monotonic() - began
    steps = after[0] - before[0]
    return steps / (after[1] - before[1]), steps / (used_now[0] - used[0]), (used_now[1] - used[1]) / seconds


def watching(env: str, pairs: int, priority: int) -> None:
    """Prints steps a second with and without somebody who watches, in turns of one run, and the frames a second."""
    ratios, processor_ratios, shares, frames = [], [], [], []
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as (server, address):
        process = train(Path(folder), "run", env, 100_000_000)
        run, times = Path(folder) / "run", []  # type: Path, list[float]
        while last_row(run)[1] < LOADING:
            time.sleep(0.5)
        with opened(address, "/run?run=run", priority) as page:
            page.on("websocket", lambda socket: socket.on("framereceived", partial(counted, times)))
            shown = page.url
            for i in range(pairs):
                speeds = {}
                for condition in ("alone", "watched") if i % 2 else ("watched", "alone"):
                    page.goto(shown if condition == "watched" else "about:blank")
                    times.clear()
                    speeds[condition] = speed(run, page, (process.pid, server.pid))
                    frames += [len(times[len(times) // 2 :]) / (times[-1] - times[len(times) // 2])] if times else []
                ratios.append(speeds["watched"][0] / speeds["alone"][0])
                processor_ratios.append(speeds["watched"][1] / speeds["alone"][1])
                shares.append(speeds["watched"][2])
                print(f"{ratios[-1]:.3f} of the speed, {processor_ratios[-1]:.3f} a second of processor time,", end=" ")
                print(f"the server takes {shares[-1]:.2f} cores, {frames[-1]:.1f} frames/s", flush=True)
        process.terminate()
        process.wait()
    for label, values in (
        ("speed", ratios),
        ("of processor time", processor_ratios),
        ("cores", shares),
        ("frames/s", frames),
    ):
        print(f"{label}: median {statistics.median(values):.3f}, {min(values):.3f} to {max(values):.3f}")


def table(n: int, priority: int) -> None:
    """Prints how long it takes until rows are there, and until one has changed, and the memory of the server."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for i in range(n):
            write(root / f"run_{i:03}", {**CONFIG, "seed": i}, videos=False, episodes=500)
        began = time.monotonic()
        with served(root) as (process, address):
            listening = time.monotonic() - began
            with opened(address, "/", priority) as page:
                asked = time.monotonic()
                page.wait_for_selector("tbody tr td .quiet", state="attached")
                first = time.monotonic() - asked
                page.wait_for_selector(f"text={n} runs")
                page.wait_for_function("!document.body.innerText.includes('not read yet')", timeout=600_000)
                whole = time.monotonic() - asked
                with (root / "run_000" / "episodes.csv").open("a") as file:
                    file.write("3999,0,7,7,1,40\n")
                changed = time.monotonic()
                page.wait_for_selector("text=3,999")
                follow = time.monotonic() - changed
                page.evaluate(PAUSES)
                page.get_by_label("filter").fill("run_000")
                page.wait_for_selector("text=run_000")
                longest = page.evaluate("window.longest")
            print(
                f"{n} runs: listening after {listening:.2f} s, first rows after {first:.2f} s, all after {whole:.2f} s"
            )
            print(
                f"a change is shown after {follow:.2f} s; the longest pause of the page while filtering is {longest:.0f} ms"
            )
            print(f"memory of the server: {memory(process.pid) / 1e6:.0f} MB")


def busy(n_runs: int, n_tabs: int, priority: int) -> None:
    """Prints how long pages take until they are there, while runs train and tabs show them live."""
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as (_, address):
        runs = [train(Path(folder), f"run_{i}", "CartPole-v1", 100_000_000) for i in range(n_runs)]
        while not all(last_row(Path(folder) / f"run_{i}")[1] > LOADING for i in range(n_runs)):
            time.sleep(0.5)
        with opened(address, "/", priority) as page:
            base = page.url
            assert page.context.browser is not None
            others = page.context.browser.new_context()
            for i in range(n_tabs):
                others.new_page().goto(address.replace("/?", f"/run?run=run_{i % n_runs}&", 1), wait_until="commit")
            for path, selector in (
                ("", "text=run_0"),
                ("run?run=run_0", "text=Environment steps"),
                ("new", "text=Start"),
                ("compare", ".plot.js-plotly-plot"),
            ):
                seconds = []
                for _ in range(3):
                    began = time.monotonic()
                    page.goto(base + path)
                    page.wait_for_selector(selector)
                    seconds.append(time.monotonic() - began)
                spread = f"{min(seconds):.2f} to {max(seconds):.2f} s"
                print(f"{path or 'runs'}: median {statistics.median(seconds):.2f} s, {spread}", flush=True)
        for run in runs:
            run.terminate()
            run.wait()


def keys(env: str, n_agents: int, priority: int) -> None:
    """Prints the time from a key to the picture that has taken it, alone or beside agents."""
    import rejeu

    with tempfile.TemporaryDirectory() as folder:
        names = [f"agent_{i}.safetensors" for i in range(n_agents)]
        for i, name in enumerate(names):
            rejeu.PPO("MlpPolicy", env, seed=i).save(Path(folder) / name)
        query = "".join(f"&agent={name}" for name in names)
        with served(Path(folder)) as (_, address), opened(address, f"/play?env={env}&seed=0{query}", priority) as page:
            page.wait_for_selector(".screen canvas", timeout=60_000)
            page.evaluate(KEYS)
            for _ in range(PRESSES):
                key = random.choice("ad")
                page.keyboard.down(key)
                page.wait_for_timeout(60)
                page.keyboard.up(key)
                page.wait_for_timeout(random.uniform(50, 250))
            took = sorted(page.evaluate("window.took"))
    p50, p95 = (took[round(share * (len(took) - 1))] for share in (0.5, 0.95))
    print(f"{env}, beside {n_agents} agents: {len(took)} keys, p50 {p50:.0f} ms, p95 {p95:.0f} ms", flush=True)


def memory(pid: int) -> int:
    """Returns the memory of a process in bytes."""
    text = Path(f"/proc/{pid}/status").read_text()
    return 1024 * next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmRSS"))


def kills(n: int) -> None:
    """Kills the server at other times while three runs train that it watches; compares their models with undisturbed ones."""
    with tempfile.TemporaryDirectory() as folder:
        alone, watched = Path(folder) / "alone", Path(folder) / "watched"
        digests = {}
        for room in (alone, watched):
            room.mkdir()
            runs = [
                train(room, f"run_{i}", "CartPole-v1", 40_000, "--set", f"learning_starts={200 + i}") for i in range(3)
            ]
            deaths = 0
            while room is watched and deaths < n:
                with served(room) as (process, address), opened(address, f"/run?run=run_{deaths % 3}", 19) as page:
                    page.wait_for_timeout(1000 + 1000 * random.random())
                    process.send_signal(signal.SIGKILL)
                deaths += 1
            statuses = [run.wait() for run in runs]
            digests[room] = {
                path.relative_to(room).as_posix(): digest(path) for path in sorted(room.glob("*/*.safetensors"))
            }
            print(f"{room.name}: exit statuses {statuses}, {deaths} kills", flush=True)
        same = digests[alone] == digests[watched]
        print(f"{len(digests[alone])} model files, {'all equal' if same else 'DIFFERENT'}")


def digest(path: Path) -> str:
    """Returns a digest of the arrays of a model, without the times in its header."""
    import rejeu

    agent = rejeu.load(path)
    parameters = agent.get_parameters()
    return hashlib.sha256(b"".join(key.encode() + parameters[key].tobytes() for key in sorted(parameters))).hexdigest()


def grows(minutes: float, priority: int) -> None:
    """Prints the memory of the server while it shows a run live."""
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as (process, address):
        run = train(Path(folder), "run", "CartPole-v1", 10_000_000)
        with opened(address, "/run?run=run", priority) as page:
            until, began = time.monotonic() + 60 * minutes, time.monotonic()
            while time.monotonic() < until:
                page.wait_for_timeout(60_000 if minutes > 5 else 15_000)
                print(f"{(time.monotonic() - began) / 60:.1f} min: {memory(process.pid) / 1e6:.0f} MB", flush=True)
        run.terminate()
        run.wait()


def main() -> None:
    """Runs one of the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["watching", "table", "busy", "kills", "memory", "keys"])
    parser.add_argument("values", nargs="*")
    parser.add_argument("--browser-priority", type=int, default=19)
    arguments = parser.parse_args()
    values: list[Any] = arguments.values
    if arguments.what == "watching":
        watching(values[0], int(values[1]), arguments.browser_priority)
    elif arguments.what == "table":
        table(int(values[0]), arguments.browser_priority)
    elif arguments.what == "busy":
        busy(int(values[0]), int(values[1]), arguments.browser_priority)
    elif arguments.what == "kills":
        kills(int(values[0]))
    elif arguments.what == "keys":
        for env in values:
            for n_agents in (0, 2) if env == values[0] else (0,):
                keys(env, n_agents, arguments.browser_priority)
    else:
        grows(float(values[0]), arguments.browser_priority)


if __name__ == "__main__":
    main()
