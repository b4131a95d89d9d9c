"""Stands in for ``rejeu train``: writes the files of a run whose return depends on the learning rate and the seed."""

import json
import math
import os
import sys
import threading
import time
from pathlib import Path

HEADER = "step,seconds,success_rate,mean_return,std_return,mean_length,episodes,best"


def stop_at_end():
    sys.stdin.read()  # until the supervisor closes it
    os._exit(143)


def main(words):
    threading.Thread(target=stop_at_end, daemon=True).start()
    command = words[0]
    path = Path(words[1] if command == "resume" else words[words.index("--out") + 1])
    source = path / "preset.json" if command == "resume" else Path(words[words.index("--preset") + 1])
    preset = json.loads(source.read_text())
    path.mkdir(parents=True, exist_ok=True)
    (path / "preset.json").write_text(json.dumps(preset))
    (path / "checkpoints").mkdir(exist_ok=True)
    (path / "checkpoints" / "newest").write_text("")
    with (path.parent / "commands.txt").open("a") as file:
        print(command, path.name, file=file)
    seed = int(path.name.removeprefix("seed_"))
    steps, every = preset["total_steps"], preset["evaluate_every"]
    rate = preset["hyperparameters"].get("learning_rate", 1e-3)
    config = {"env": preset["env_id"], "algorithm": preset["algorithm"], "seed": seed, "steps": steps, "n_envs": 1}
    config["hyperparameters"] = preset["hyperparameters"]
    (path / "config.json").write_text(json.dumps(config))
    table = path / "evaluations.csv"
    rows = table.read_text().splitlines()[1:] if table.exists() else []
    done = int(rows[-1].split(",")[0]) if rows else 0
    if not rows:
        table.write_text(HEADER + "\n")
    for step in range(done + every, steps + 1, every):
        value = step / steps - abs(math.log10(rate) + 3) + (seed % 7) / 100
        if rate > 5e-3:
            print("rejeu: error: at step 20: the loss is NaN", flush=True)
            sys.exit(2)
        with table.open("a") as file:
            file.write(f"{step},{step / 100},nan,{value},0,1,3,0\n")
        time.sleep(0.02)
    episodes = [f"{step},0,{value},1,nan,{step / 100}" for step in range(1, steps + 1)]
    (path / "episodes.csv").write_text("\n".join(["step,env,return,length,success,seconds", *episodes]) + "\n")
    (path / "agent.safetensors").write_bytes(b"")


main(sys.argv[1:])
