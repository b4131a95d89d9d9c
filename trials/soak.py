"""Trains for an hour with all features enabled and monitors memory, open files, threads and processes.

    python trials/soak.py --minutes 60

The run is SAC with hindsight experience replay on parking-v0 in 8 EnvPool environments. It has an evaluation every
20,000 steps, a checkpoint every minute, a video every 100,000 steps, tables and a progress bar. Before the end of the
warm-up the replay buffer is full and every feature has run more than once. After the warm-up no resource may grow.
``trials/results/soak.json`` contains the measurements, one every ten seconds, and ``trials/images/soak.png`` shows them.
Requires psutil.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
from provenance import provenance, write

RESULT = Path(__file__).parent / "results" / "soak.json"
PICTURE = Path(__file__).parent / "images" / "soak.png"
EVERY_SECONDS = 10.0
WARM_UP = 0.25
"""Fraction of the run after which no resource may grow."""


class Watch(threading.Thread):
    """Records the resources of the process every ten seconds."""

    def __init__(self, began: float) -> None:
        super().__init__(daemon=True)
        self.began, self.rows, self.steps = began, [], 0
        self._over = threading.Event()
        self._process = psutil.Process()

    def look(self) -> dict[str, float]:
        with self._process.oneshot():
            memory, threads = self._process.memory_info().rss, self._process.num_threads()
        return {
            "seconds": round(time.perf_counter() - self.began, 1),
            "steps": self.steps,
            "mib": round(memory / 2**20, 2),
            "files": self._process.num_fds(),
            "threads": threads,
            "processes": len(self._process.children(recursive=True)),
        }

    def run(self) -> None:
        while not self._over.wait(EVERY_SECONDS):
            self.rows.append(self.look())

    def end(self) -> None:
        self._over.set()
        self.join()


def train(minutes: float, folder: Path, watch: Watch) -> dict[str, object]:
    import rejeu
    from rejeu.callbacks import Checkpoint, Evaluate, RecordVideo
    from rejeu.reporting.logging import CsvFile

    env = rejeu.make_vector("parking-v0", 8, "envpool", seed=0)
    agent = rejeu.SAC(
        "MultiInputPolicy",
        env,
        seed=0,
        buffer_size=50_000,
        batch_size=128,
        learning_rate=1e-3,
        gamma=0.95,
        replay_buffer_class=rejeu.HerReplayBuffer,
        policy_kwargs={"net_arch": [64, 64]},
    )
    evaluate = Evaluate("parking-v0", every=20_000, episodes=16, best_path=folder / "best", seed=1)
    film = RecordVideo(folder / "films", every=100_000, max_steps=60, seed=0)
    metrics = CsvFile(folder / "metrics.csv")

    def note(agent: rejeu.SAC, turn: object) -> None:
        watch.steps = agent.num_timesteps

    agent.learn(
        callback=[evaluate, film, Checkpoint(folder / "checkpoints", minutes=1), note],
        minutes=minutes,
        log_interval=100,
        sinks=[metrics],
        progress_bar=True,
    )
    result = {
        "evaluations": len(evaluate.results),
        "films": len(film.paths),
        "checkpoint_files": len(list((folder / "checkpoints").iterdir())),
        "episodes": len(agent.history),
        "success_of_the_best": evaluate.best.evaluation.success_rate if evaluate.best else None,
    }
    metrics.close()
    evaluate.close()
    env.close()
    return result


def judge(rows: list[dict[str, float]], minutes: float) -> dict[str, float]:
    """Compares the last tenth of the run with the first tenth after the warm-up."""
    late = [row for row in rows if row["seconds"] >= WARM_UP * 60 * minutes]
    tenth = max(len(late) // 10, 1)
    first, last = late[:tenth], late[-tenth:]
    mean = lambda part, key: float(np.mean([row[key] for row in part]))  # noqa: E731
    gaps = np.diff([row["seconds"] for row in rows]) - EVERY_SECONDS
    slope = np.polyfit([row["seconds"] / 3600 for row in late], [row["mib"] for row in late], 1)[0]
    return {
        "minutes": minutes,
        "minutes_suspended": float(gaps[gaps > EVERY_SECONDS].sum() / 60),  # by another program on the machine
        "mib_after_warm_up": mean(first, "mib"),
        "mib_at_the_end": mean(last, "mib"),
        "growth_percent": 100 * (mean(last, "mib") / mean(first, "mib") - 1),
        "mib_per_hour": float(slope),
        "files_after_warm_up": mean(first, "files"),
        "files_at_the_end": mean(last, "files"),
        "threads_after_warm_up": mean(first, "threads"),
        "threads_at_the_end": mean(last, "threads"),
    }


def draw(rows: list[dict[str, float]], minutes: float, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure((8, 4.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    time_axis = [row["seconds"] / 60 for row in rows]
    upper.plot(time_axis, [row["mib"] for row in rows], color="tab:blue")
    upper.set(ylabel="resident memory, MiB", ylim=(0, None), title="An hour of training with everything switched on")
    upper.axvspan(0, WARM_UP * minutes, color="0.92", label="warm-up")
    upper.legend(loc="lower right", frameon=False)
    lower.plot(time_axis, [row["files"] for row in rows], label="open files", color="tab:green")
    lower.plot(time_axis, [row["threads"] for row in rows], label="threads", color="tab:orange")
    lower.plot(time_axis, [row["processes"] for row in rows], label="child processes", color="tab:red")
    lower.set(xlabel="minutes", ylim=(0, None))
    lower.legend(loc="upper right", frameon=False, ncols=3, fontsize="small")
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    arguments = parser.parse_args()
    watch = Watch(time.perf_counter())
    before = watch.look()
    watch.start()
    with tempfile.TemporaryDirectory() as folder:
        result = train(arguments.minutes, Path(folder), watch)
    watch.end()
    after = watch.look()
    content = {
        **provenance(),
        **judge(watch.rows, arguments.minutes),
        **result,
        "steps": watch.rows[-1]["steps"],
        "processes_left": after["processes"] + len(multiprocessing.active_children()),
        "files_before_and_after": [before["files"], after["files"]],
        "seen": watch.rows,
    }
    write(RESULT, content, rows="seen")
    del content["seen"]
    draw(watch.rows, arguments.minutes, PICTURE)
    print(json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
