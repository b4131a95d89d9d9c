"""Stands in for ``rejeu --task FILE``, as a script or in the process of a test: writes the files of a run whose return
grows with the steps taken.

It grows by 1 over the whole run with the learning rate 1e-3, and by 1 less for each order of magnitude away from it.
"""

import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

HEADER = "step,seconds,success_rate,mean_return,std_return,mean_length,episodes,best"


def stop_at_end():
    sys.stdin.read()  # until the supervisor closes it
    os._exit(143)


def rate_of(value):
    return float(value.removeprefix("lin_")) if isinstance(value, str) else value


def train(task: dict, say: Callable[[str], object] = print) -> Iterator[None]:
    """Trains, with a turn for each evaluation; returns the exit status."""
    is_new, path = not task["resume"], Path(task["folder"])
    if is_new:
        preset = json.loads(Path(task["run"]["preset"]).read_text())
        state = {"step": 0, "weight": 0.0, "seed": task["run"]["seed"], "preset": preset}
        state["rate"] = rate_of(preset["hyperparameters"].get("learning_rate", 1e-3))
    else:
        state = json.loads(max((path / "checkpoints").glob("run_*.safetensors")).read_text())
        preset = state["preset"]
    (path / "checkpoints").mkdir(parents=True, exist_ok=True)
    with (path.parent / "commands.txt").open("a") as file:
        print("train" if is_new else "resume", path.name, file=file)
    steps, every = preset["total_steps"], preset["evaluate_every"]
    config = {"env": preset["env_id"], "algorithm": preset["algorithm"], "seed": state["seed"], "steps": steps}
    (path / "config.json").write_text(json.dumps({**config, "hyperparameters": preset["hyperparameters"]}))
    table = path / "evaluations.csv"
    rows = table.read_text().splitlines()[1:] if table.exists() else []
    rows = [row for row in rows if int(row.split(",")[0]) <= state["step"]]
    table.write_text("\n".join([HEADER, *rows]) + "\n")
    while state["step"] < steps:
        if state["rate"] > 5e-3:
            say("rejeu: error: at step 20: the loss is NaN")
            return 2
        state["step"] += every
        state["weight"] += (1 - abs(math.log10(state["rate"]) + 3)) * every / steps
        value = state["weight"] + (state["seed"] % 7) / 100
        with table.open("a") as file:
            if str(state["step"]) != os.environ.get("NO_ROW_AT"):
                file.write(f"{state['step']},{state['step'] / 100},nan,{value},0,1,3,0\n")
        checkpoint = path / "checkpoints" / f"run_{state['step']:012d}.safetensors"
        checkpoint.with_suffix(".tmp").write_text(json.dumps(state))
        checkpoint.with_suffix(".tmp").replace(checkpoint)
        if is_new and str(state["step"]) == os.environ.get("KILLED_AT"):
            return -signal.SIGKILL
        yield
    episodes = [f"{step},0,{state['weight']},1,nan,{step / 100}" for step in range(1, state["step"] + 1)]
    (path / "episodes.csv").write_text("\n".join(["step,env,return,length,success,seconds", *episodes]) + "\n")
    (path / "agent.safetensors").write_text(json.dumps(state))
    return 0


class Pretended:
    """A process that the scheduler looks at: each look is a turn."""

    def __init__(self, task, log):
        self.turns, self.status = train(json.loads(task.read_text()), lambda text: log.write_text(text + "\n")), None

    def poll(self):
        if self.status is None:
            try:
                next(self.turns)
            except StopIteration as end:
                self.status = end.value
        return self.status

    def stop(self):
        self.status = 143 if self.status is None else self.status


def main(file):
    threading.Thread(target=stop_at_end, daemon=True).start()
    turns = train(json.loads(Path(file).read_text()))
    while True:
        try:
            next(turns)
        except StopIteration as end:
            sys.exit(end.value)
        time.sleep(0.02)


if __name__ == "__main__":
    main(sys.argv[1])
