"""Writes every figure of the README and the documentation from the measured data.

    python scripts/figures.py            # updates src/rejeu/presets/results.json and the marked blocks of the pages
    python scripts/figures.py --check    # changes nothing; exits with 1 if something is out of date

A marked block starts with ``<!-- figures: NAME ARGUMENTS -->`` and ends with ``<!-- end of figures -->``. The data is
in ``benchmarks/results`` and ``trials/results``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from gymnasium import spaces

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from benchmarks import tables  # noqa: E402
from benchmarks.bench.summary import best, by_round, ratio, step_seconds  # noqa: E402
from benchmarks.bench.text import table, times  # noqa: E402
from rejeu import presets, validation  # noqa: E402
from rejeu.agents import AGENTS  # noqa: E402
from rejeu.envs.masks import n_choices  # noqa: E402
from rejeu.presets.result import Result  # noqa: E402

DATA = ROOT / "benchmarks" / "results"
TRIALS = ROOT / "trials" / "results"
PRESET_RESULTS = ROOT / "src" / "rejeu" / "presets" / "results.json"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(<!-- figures: (.+?) -->\n).*?(<!-- end of figures -->)", re.DOTALL)
CURVE_WINDOW = 20
"""Episodes over which ``benchmarks/curves.py`` averages."""
JUDGED_BY_SUCCESS = ("FetchReach-v4", "parking-v0", "rejeu/Ball-v0")
"""Environments whose result is the success rate."""


def load(name: str, folder: Path = DATA) -> Any:
    """Returns the data of a file of results."""
    return json.loads((folder / name).read_text(encoding="utf-8"))


def measured() -> list[Result]:
    """Returns the results of all presets from ``benchmarks/results/learning``, with the unmodified preset first."""
    found = [
        result_of(json.loads(path.read_text(encoding="utf-8"))) for path in sorted((DATA / "learning").glob("*.json"))
    ]
    return sorted(found, key=lambda result: (result.env_id, result.algorithm, result.setting))


def result_of(data: dict[str, Any]) -> Result:
    """Returns the result in a file of ``benchmarks/learning.py`` or of ``rejeu train`` and ``evaluate``."""
    words = shlex.split(data["command"])
    runs = data["runs"]
    env_id, algorithm = (words[2], words[3]) if words[0] == "python" else (words[2], "SAC")
    options = {word: words[i + 1] for i, word in enumerate(words[:-1]) if word.startswith("--")}
    settings = ["best weights"] if "--best" in words else []
    settings += [f"sigma={v:g}" for k, v in json.loads(options.get("--env", "{}")).items() if k == "sigma"]
    is_success = env_id in JUDGED_BY_SUCCESS
    values = [run["success_rate" if is_success else "mean_return"] for run in runs]
    low, high = (min(values), max(values)) if is_success else data["summary"]["mean_return"]["interval"]
    minutes = options.get("--minutes")
    seconds = [run["seconds"] for run in runs]
    return Result(
        env_id=env_id,
        algorithm=algorithm,
        setting=", ".join(settings),
        measure="success rate" if is_success else "mean return",
        mean=round(sum(values) / len(values), 4),
        low=round(low, 4),
        high=round(high, 4),
        seeds=len(runs),
        episodes=runs[0]["episodes"],
        budget=f"{minutes} minute" if minutes else f"{runs[0]['steps']:,} steps",
        seconds=(min(seconds), max(seconds)),
        command=data["command"],
    )


def published(result: Result) -> str:
    """Returns the published return for the algorithm, environment and number of steps of a result, with its source."""
    for entry in load("published.json"):
        same = (entry["algorithm"], entry["env"], f"{entry['steps']:,} steps")
        if same == (result.algorithm, result.env_id, result.budget) and result.measure == "mean return":
            version = f" ({entry['version']})" if "version" in entry else ""
            return f"[{entry['return']:.1f}]({entry['source']}){version}"
    return ""


def results(*algorithms: str) -> str:
    """The results of some algorithms, one row for each environment and setting."""
    rows = []
    for result in measured():
        if result.algorithm in algorithms and result.env_id != "rejeu/Ball-v0":
            env = result.env_id + (f" ({result.algorithm})" if len(algorithms) > 1 else "")
            setting = f", {result.setting}" if result.setting else ""
            figures = f"{result.measure} {result.figures}"
            rows.append(
                (
                    env + setting,
                    result.budget,
                    figures,
                    published(result),
                    str(result.seeds),
                    time_of(result),
                    f"`{result.command}`",
                )
            )
    header = ("environment", "trained for", "result", "published", "seeds", "time for each seed", "command")
    return table(header, rows)


def curve(algorithm: str) -> str:
    """Return at the end of each recorded learning curve of an algorithm, mean and range over the seeds."""
    data = load(f"curves/{algorithm}.json")
    last = [values[-1] for values in data["returns"]]
    return (
        f"The last {CURVE_WINDOW} training episodes of the {len(last)} seeds have a mean return of "
        f"{sum(last) / len(last):.1f} ({min(last):.1f} to\n{max(last):.1f}) on {data['env'].removeprefix('rejeu/')} after "
        f"{data['steps'][-1]:,} steps (`{data['command']}`)."
    )


def hyperparameters(algorithm: str) -> str:
    """Every hyperparameter of an algorithm with its default and meaning, those of its own class first."""
    config = AGENTS[algorithm].algorithm.Config
    docs, defaults = validation.field_docs(config), validation.field_defaults(config)
    names = dict.fromkeys(name for owner in config.__mro__ for name in vars(owner).get("__annotations__", ()))
    rows = []
    for name in (name for name in names if name in defaults):
        default = "" if dataclasses.is_dataclass(defaults[name]) else f"`{defaults[name]!r}`"
        rows.append((f"`{name}`", default, docs[name].replace("``", "`").replace("|", "\\|")))
    return table(("hyperparameter", "default", "meaning"), rows)


def supported(algorithm: str) -> str:
    """The action and observation spaces for which an algorithm can be made, and the kinds of replay and policy."""
    agent = AGENTS[algorithm]
    config = agent.algorithm.Config()
    fields = validation.field_names(type(config))
    box = spaces.Box(-1, 1, (2,))
    actions = {
        "Box": box,
        "Box of integers": spaces.Box(0, 3, (2,), np.int32),
        "Discrete": spaces.Discrete(3),
        "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
        "MultiBinary": spaces.MultiBinary(3),
    }
    observations = {
        **actions,
        "images": spaces.Box(0, 255, (36, 36, 3), np.uint8),
        "Dict and Tuple": spaces.Dict({"a": spaces.Tuple([box, spaces.Discrete(2)]), "b": box}),
    }
    possible = [name for name, space in actions.items() if can_make(agent, config, box, space)]
    readable = [name for name, space in observations.items() if can_make(agent, config, space, actions[possible[0]])]
    is_off_policy = "replay_buffer_class" in fields
    rows = [
        ("actions", ", ".join(possible)),
        ("observations", ", ".join(readable)),
        ("several environments", "yes"),
        ("HER, prioritized replay, n-step returns", "yes" if is_off_policy else "no (on-policy)"),
        ("action masks", "yes" if agent.takes_masks else "no"),
        ("memory (LSTM, GRU)", "yes" if "cell" in validation.field_names(type(config.policy_kwargs)) else "no"),
        ("normalization, schedules", "yes"),
        ("custom modules as encoder, torso or head", "yes" if takes_modules(agent.algorithm.Config) else "no"),
    ]
    return table(("", "supported"), rows)


def takes_modules(config_class: Any) -> bool:
    """Returns whether the networks of an algorithm may contain modules of the user's own."""
    try:
        config_class(policy_kwargs={"torso": eqx.nn.Identity})
    except ValueError:
        return False
    return True


def can_make(agent: Any, config: Any, observation_space: spaces.Space, action_space: spaces.Space) -> bool:
    """Returns whether an algorithm accepts these spaces."""
    try:
        if agent.takes_masks:
            n_choices(action_space, "")
        agent.algorithm.make(config, observation_space, action_space)
    except ValueError:
        return False
    return True


def training_times() -> str:
    """The presets with their budgets and results, in the order of ``rejeu list``."""
    found = {(result.env_id, result.algorithm): result for result in reversed(measured())}
    rows = []
    for preset in presets.ALL:
        result = found.get((preset.env_id, preset.algorithm))
        budget = f"{preset.total_steps:,}"
        measure = f"{result.measure} {result.figures}" if result else ""
        rows.append((preset.env_id, preset.algorithm, budget, measure, time_of(result) if result else ""))
    return table(("environment", "algorithm", "steps of the preset", "result", "time for each seed"), rows)


def bit_flipping() -> str:
    """Success rates of DQN with and without HER, by the number of bits."""
    data = load("bit_flipping.json")
    rates = data["success_rate"]
    rows = [
        (name, *(f"{100 * sum(values) / len(values):.0f} %" for values in by_bits.values()))
        for name, by_bits in rates.items()
    ]
    header = f"success rate, mean of {len(data['seeds'])} seeds"
    return table((header, *(f"{n} bits" for n in next(iter(rates.values())))), rows)


def time_of(result: Result) -> str:
    """Returns the range of the training times over the seeds of a result."""
    low, high = (round(seconds) for seconds in result.seconds)
    return f"{low} s" if low == high else f"{low} to {high} s"


def ball() -> str:
    """The success rates on Ball-v0, one row for each ``sigma``."""
    found = [result for result in measured() if result.env_id == "rejeu/Ball-v0"]
    algorithms = ("TD3", "DDPG", "SAC")
    rows = []
    for setting in sorted({result.setting for result in found}):
        cells = {result.algorithm: result.figures for result in found if result.setting == setting}
        rows.append((setting.removeprefix("sigma="), *(cells[name] for name in algorithms)))
    return table(("`sigma`", *algorithms), rows)


def parking() -> str:
    """Time and results of ``rejeu train parking-v0``."""
    result = next(result for result in measured() if result.env_id == "parking-v0")
    low, high = (100 * share for share in (result.low, result.high))
    return (
        f"Training takes {time_of(result)} on two CPU cores, compilation included ({result.seeds} seeds). The trained models "
        f"succeed in\n{low:g} to {high:g} % of {result.episodes} episodes of highway-env's `parking-v0`."
    )


def speed() -> str:
    """Speed compared with Stable-Baselines3 and SBX, starting with equal environments."""
    samples = load("bench.json")["samples"]

    def row(text: str, case: str, name: str, peer_name: str = "") -> tuple[str, ...]:
        own = step_seconds(samples, case, name, "rejeu")
        peers = [step_seconds(samples, case, peer_name or name, library) for library in ("sb3", "sbx")]
        return (text, *(f"{times(ratio(peer, own))}x" if peer else "" for peer in peers))

    def parking_row(text: str, name: str) -> tuple[str, ...]:
        own, peer = (
            by_round(best(samples, "parking", n, library), lambda sample: sample["result"]["training_steps_per_second"])
            for n, library in ((name, "rejeu"), ("highway-env", "sb3"))
        )
        return (text, f"{times(ratio(own, peer))}x", "")

    rows = [
        row("SAC, Pendulum-v1, 64-64, batches of 64", "steps", "SAC"),
        row("SAC, Pendulum-v1, 256-256, batches of 256", "steps", "SAC, 256-256"),
        row("TD3, Pendulum-v1, 128-128, batches of 128", "steps", "TD3"),
        row("DQN, MountainCar-v0, 128-128, batches of 128", "steps", "DQN"),
        row("PPO, LunarLanderContinuous-v3, 16 environments", "rollouts", "PPO, 16 on gymnasium"),
        parking_row("SAC with HER, parking-v0 (Python simulator)", "highway-env"),
        row("PPO, 16 environments; rejeu on EnvPool", "rollouts", "PPO, 16 on envpool", "PPO, 16 on gymnasium"),
        row("PPO, 64 environments; rejeu on EnvPool", "rollouts", "PPO, 64 on envpool", "PPO, 64 on gymnasium"),
        parking_row("SAC with HER, parking-v0; rejeu on EnvPool, 8 environments", "EnvPool, 8 environments"),
    ]
    return table(("training steps per second", "vs. Stable-Baselines3", "vs. SBX"), rows)


def backends() -> str:
    """Steps per second of each backend."""
    names = ("envpool", "gymnasium", "gymnasium-async")
    rows = []
    for entry in load("backends.json")["results"]:
        rates = [entry["steps_per_second"].get(name) for name in names]
        rows.append(
            (f"`{entry['env']}`", str(entry["n_envs"]), *("" if rate is None else f"{rate:,.0f}" for rate in rates))
        )
    return table(("environment", "`n_envs`", *(f"`{name}`" for name in names)), rows)


def functional_equality() -> str:
    """Largest differences between the environments in JAX and those that they reproduce."""
    rows = []
    for row in load("functional_equality.json")["results"]:
        double, single = row["float64"], row["float32"]
        cells = (
            f"{found[key]:.0e}" if found[key] else "0" for found in (double, single) for key in ("state", "reward")
        )
        wrong = double["n_terminated"] + single["n_terminated"]
        rows.append(
            (f"`{row['env']}`", row["peer"], f"{row['steps']:,}", f"{row['n_terminated']:,}", *cells, str(wrong))
        )
    header = (
        "environment",
        "compared with",
        "steps",
        "terminal",
        "state, float64",
        "reward, float64",
        "state, float32",
        "reward, float32",
        "wrong ends",
    )
    return table(header, rows)


def functional_unstable() -> str:
    """The steps of parking that are left out of the comparison."""
    row = next(row for row in load("functional_equality.json")["results"] if "unstable" in row)
    found = row["unstable"]
    return (
        f"{found['n']} of the {row['n_crashes']:,} steps with a crash, in which the final position differs by up to "
        f"{found['position']:.1f} m and\nthe reward by up to {found['reward']:.2f}."
    )


def overlap() -> str:
    """Learning with and without the overlap of environments and updates."""
    rows = []
    for case, settings in load("overlap.json").items():
        if isinstance(settings, dict):
            cells = (
                f"{found['mean_return']:.1f} ({found['interval'][0]:.1f} to {found['interval'][1]:.1f})"
                for found in settings.values()
            )
            rows.append((case, *cells))
    return table(("mean return (95 % CI), 5 seeds", "`overlap=True`", "`overlap=False`"), rows)


def mountain_car() -> str:
    """The exercise on MountainCar, one row for each seed."""
    rows = [
        (
            str(run["seed"]),
            f"{run['seconds']:.1f}",
            f"{100 * run['reached']:.1f} %",
            f"{100 * run['reached_in_last_100']:.0f} %",
            f"{run['greedy_return']:.1f}",
        )
        for run in load("mountain_car_document.json")["runs"]
    ]
    header = (
        "seed",
        "seconds",
        "training episodes that reach the flag",
        "of the last 100",
        "greedy return, 50 episodes",
    )
    return table(header, rows)


def lunar_lander() -> str:
    """Ten iterations on LunarLander, one row for each set of hyperparameters, means over the seeds."""
    rows = []
    for name, runs in load("lunar_lander_document.json")["runs"].items():
        keys = ("steps", "seconds", "last_training_return", "mean_return", "success_rate")
        steps, seconds, training, deterministic, success = (sum(run[key] for run in runs) / len(runs) for key in keys)
        cells = (f"{steps:,.0f}", f"{seconds:.1f}", f"{training:.0f}", f"{deterministic:.0f}", f"{100 * success:.0f} %")
        rows.append((name, str(len(runs)), *cells))
    header = (
        "hyperparameters",
        "seeds",
        "steps",
        "seconds",
        "last training return",
        "deterministic return",
        "success rate",
    )
    return table(header, rows)


def size() -> str:
    """The structure of the package before its restructuring and now, from ``scripts/structure.py --json``."""
    before, after = load("structure/before.json"), load("structure/after.json")
    names = {
        "lines": "lines in `src`",
        "files": "files",
        "top_level_modules": "modules at the top level",
        "files_in_agents": "files in `agents/`",
        "cycles": "modules in import cycles",
        "private_accesses": "accesses to private attributes of other objects",
        "layering_violations": "imports against the order of the layers",
        "repeated_share_in_algorithms": "lines of `algorithms/` that occur in three or more files, %",
        "longest_function": "lines of the longest function",
    }

    def count(value: Any) -> str:
        if isinstance(value, list):
            value = sum(len(entry) if isinstance(entry, list) else 1 for entry in value)
        return f"{value:,}"

    rows = [(text, count(before[key]), count(after[key])) for key, text in names.items()]
    # The layers are in the order of the new layout.
    rows = [(text, "" if "layers" in text else b, a) for text, b, a in rows]
    packages = sorted(before["lines_by_package"].keys() | after["lines_by_package"].keys())
    for package in packages:
        lines = (data["lines_by_package"].get(package) for data in (before, after))
        rows.append((f"lines in {package}", *("" if n is None else f"{n:,}" for n in lines)))
    return table(("", "before", "now"), rows)


BLOCKS: dict[str, Callable[..., str]] = {
    "results": results,
    "curve": curve,
    "hyperparameters": hyperparameters,
    "supported": supported,
    "presets": training_times,
    "bit-flipping": bit_flipping,
    "ball": ball,
    "parking": parking,
    "speed": speed,
    "backends": backends,
    "functional": lambda: tables.functional(load("functional.json")),
    "functional-equality": functional_equality,
    "functional-unstable": functional_unstable,
    "mountain-car": mountain_car,
    "overlap": overlap,
    "lunar-lander": lunar_lander,
    "size": size,
    "device": lambda name="device": tables.device_loops(load(f"{name}.json")),
    "device-seeds": lambda name="device": tables.device_seeds(load(f"{name}.json")),
    "device-peers": lambda: tables.peers(load("device_peers.json")),
    "device-replay": lambda: tables.device_replay(load("device_replay.json")),
    "parking-transfer": lambda: tables.transfer(load("parking_transfer.json")),
    "sweep": lambda: tables.sweep(load("sweep.json")),
    "sweep-kills": lambda name="sweep_kills": tables.sweep_kills(load(f"{name}.json", TRIALS)),
    "pqn": lambda: tables.pqn(load("pqn.json")),
    "remote": lambda: tables.remote(load("remote.json")),
    "first-of-n": lambda: tables.first_of_n(load("first_of_n.json")),
    "tune": lambda: tables.tune(load("tune.json")),
}


def render(text: str) -> str:
    """Returns a page with every marked block regenerated; a block whose data does not exist yet is empty."""

    def block(match: re.Match[str]) -> str:
        name, *arguments = match[2].split()
        try:
            return f"{match[1]}{BLOCKS[name](*arguments)}\n{match[3]}"
        except FileNotFoundError:
            return match[1] + match[3]

    return BLOCK.sub(block, text)


def rendered() -> Iterator[tuple[Path, str]]:
    """Yields each file with generated figures, and the expected text."""
    entries = [result.__dict__ for result in measured()]
    yield PRESET_RESULTS, json.dumps(entries, indent=1) + "\n"
    for page in PAGES:
        yield page, render(page.read_text(encoding="utf-8"))


def main() -> int:
    """Runs the command and returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing, and exit with 1 if a file is out of date")
    check = parser.parse_args().check
    outdated = []
    for path, text in rendered():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            outdated.append(path.relative_to(ROOT))
            if not check:
                path.write_text(text, encoding="utf-8")
    for path in outdated:
        print(f"{path} is out of date; run: python scripts/figures.py" if check else f"wrote {path}")
    return int(check and bool(outdated))


if __name__ == "__main__":
    sys.exit(main())
