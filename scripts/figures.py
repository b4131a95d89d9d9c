"""Writes every figure of the README and the documentation from the measured data.

    python scripts/figures.py            # updates src/rejeu/agents/presets/results.json and the marked blocks of the pages
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
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from gymnasium import spaces

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from benchmarks.bench.summary import best, by_round, ratio, step_seconds  # noqa: E402
from benchmarks.bench.text import table, times  # noqa: E402
from rejeu.agents import AGENTS, presets  # noqa: E402
from rejeu.agents.presets import PresetResult  # noqa: E402
from rejeu.algorithms import dqn, ppo  # noqa: E402
from rejeu.algorithms.actor_critic import OnPolicyConfig  # noqa: E402
from rejeu.algorithms.config import OffPolicyConfig  # noqa: E402
from rejeu.algorithms.rollout_config import RolloutConfig  # noqa: E402
from rejeu.algorithms.sac import continuous as sac  # noqa: E402
from rejeu.algorithms.soft import EntropyConfig  # noqa: E402
from rejeu.core import schedules, validation  # noqa: E402
from rejeu.envs.masks import n_choices  # noqa: E402
from scripts import sb3_parity  # noqa: E402
from trials.provenance import half_interval  # noqa: E402

DATA = ROOT / "benchmarks" / "results"
PRESET_RESULTS = ROOT / "src" / "rejeu" / "agents" / "presets" / "results.json"
PAGES = [
    ROOT / "README.md",
    *(page for name in ("benchmarks", "docs", "trials") for page in sorted((ROOT / name).rglob("*.md"))),
]
BLOCK = re.compile(r"(<!-- figures: (.+?) -->\n).*?(<!-- end of figures -->)", re.DOTALL)
SHARED = (
    (ppo.Config, "PPO", "ppo.md#hyperparameters"),
    (sac.Config, "SAC", "sac.md#hyperparameters"),
    (EntropyConfig, "SAC", "sac.md#hyperparameters"),
    (dqn.QLearningConfig, "DQN", "dqn.md#hyperparameters"),
    (OffPolicyConfig, "all off-policy algorithms", "../hyperparameters.md#off-policy-algorithms"),
    (OnPolicyConfig, "all on-policy algorithms", "../hyperparameters.md#on-policy-algorithms"),
    (RolloutConfig, "all on-policy algorithms", "../hyperparameters.md#on-policy-algorithms"),
)
"""Configurations from which others are derived, and where their hyperparameters are explained: by whom, and the page."""
JUDGED_BY_SUCCESS = (
    "AntMaze_UMaze-v5",
    "FetchPickAndPlace-v4",
    "FetchPush-v4",
    "FetchReach-v4",
    "FetchSlide-v4",
    "PointMaze_Large-v3",
    "PointMaze_Medium-v3",
    "PointMaze_UMaze-v3",
    "parking-v0",
    "rejeu/Ball-v0",
    "rejeu/ParkingHard-v0",
)
"""Environments whose result is the success rate."""
TD3_RETURNS = {
    "HalfCheetah-v5": (-289.415, 10574.0),
    "Hopper-v5": (18.791, 3226.0),
    "Walker2d-v5": (2.791, 3946.0),
    "Ant-v5": (-70.288, 3942.0),
    "Humanoid-v5": (120.423, 5165.0),
}
"""Returns of random actions and of TD3 after a million steps, by MR.Q (Fujimoto et al. 2025, arXiv 2501.16142)."""
HIDDEN = "velocities hidden"
"""How results are named of environments of whose observations ``--shown`` leaves only some components."""


def load(name: str, folder: Path = DATA) -> Any:
    """Returns the data of a file of results."""
    return json.loads((folder / name).read_text(encoding="utf-8"))


def measured() -> list[PresetResult]:
    """Returns the results of all presets from ``benchmarks/results/learning``, with the unmodified preset first.

    Those in goal environments are in ``goals``, unless there is a file of the same name with another budget.
    """
    files = [*(DATA / "learning" / "goals").glob("*.json"), *(DATA / "learning").glob("*.json")]
    results = [result_of(load(path.name, path.parent)) for path in {path.name: path for path in files}.values()]
    return sorted(results, key=lambda result: (result.env_id, result.algorithm, result.setting))


def result_of(data: dict[str, Any], judged_by_success: tuple[str, ...] = JUDGED_BY_SUCCESS) -> PresetResult:
    """Returns the result in a file of ``benchmarks/learning.py`` or of ``rejeu train`` and ``evaluate``."""
    words = shlex.split(data["command"])
    runs = data["runs"]
    env_id, algorithm = (words[2], words[3]) if words[0] == "python" else (words[2], "SAC")
    twin, env_id = env_id, presets.TWINS.get(env_id, env_id)
    options = {word: words[i + 1] for i, word in enumerate(words[:-1]) if word.startswith("--")}
    settings = ["best weights"] if "--best" in words else []
    settings += [f"in {twin}"] if twin != env_id else []
    if "--shown" in words:
        size = data["hyperparameters"]["policy_kwargs"].get("lstm_hidden_size")
        settings += [HIDDEN, "without memory" if size is None else f"memory of {size}"]
    settings += [options["--name"].rsplit("-", 1)[-1]] if options.get("--name", "").startswith("parts-") else []
    settings += [f"sigma={v:g}" for k, v in json.loads(options.get("--env", "{}")).items() if k == "sigma"]
    is_success = env_id in judged_by_success
    values = [run["success_rate" if is_success else "mean_return"] for run in runs]
    interval = data["summary"]["mean_return"]["interval"] if not is_success else None
    low, high = interval or (min(values), max(values))
    minutes = None if "--steps" in options else options.get("--minutes")
    seconds = [run["seconds"] for run in runs]
    return PresetResult(
        env_id=env_id,
        algorithm=algorithm,
        preset=options.get("--preset", ""),
        setting=", ".join(settings),
        measure="success rate" if is_success else "mean return",
        mean=round(sum(values) / len(values), 4),
        low=round(low, 4),
        high=round(high, 4),
        seeds=len(runs),
        episodes=runs[0]["episodes"],
        budget=f"{minutes} minute{'s' * (minutes != '1')}" if minutes else f"{runs[0]['steps']:,} steps",
        seconds=(min(seconds), max(seconds)),
        command=data["command"],
    )


def code(text: str) -> str:
    """Formats a text as code, if there is any."""
    return f"`{text}`" * bool(text)


def learned(folder: str, length: str = "") -> str:
    """Every result of a folder of ``benchmarks/results``, beside all that is published; ``short`` leaves its origin out.

    The text above a short table says that the published returns are RL Zoo's or of CleanRL's defaults.
    """
    rows = []
    for path in sorted((DATA / folder).glob("*.json")):
        content = load(path.name, path.parent)
        result = result_of(content, JUDGED_BY_SUCCESS if folder == "learning" else ())
        others = []
        for entry in load("published.json"):
            steps = f"{entry['steps']:,} steps"
            if (entry["algorithm"], entry["env"]) == (result.algorithm, result.env_id) and HIDDEN not in result.setting:
                differs = [entry.get("version", ""), "" if steps == result.budget else steps]
                by = entry["by"].partition(",")[0].replace("RL Zoo", "") if length == "short" else entry["by"]
                notes = ", ".join(filter(None, [by, *differs]))
                others.append(f"[{entry['return']:.1f}]({entry['source']})" + f" ({notes})" * bool(notes))
        rows.append(
            (
                ", ".join(filter(None, (result.env_id, result.setting))),
                result.algorithm,
                result.budget.removesuffix(" steps"),
                result.figures,
                "; ".join(others),
                str(result.seeds),
                " to ".join(dict.fromkeys(f"{seconds:.0f}" for seconds in result.seconds)),
                content["commit"],
                code(
                    re.sub(r"^python benchmarks/learning\.py \S+ \S+ ?| --continue --out FOLDER$", "", result.command)
                ),
            )
        )
    header = (
        "environment",
        "algorithm",
        "steps",
        "rejeu",
        "published",
        "seeds",
        "seconds",
        "commit",
        "options",
    )
    shown = {"short": slice(0, 5), "own": [0, 1, 2, 3, 5, 6, 7]}.get(length, slice(None))
    columns = np.arange(len(header))[shown]
    return table([header[i] for i in columns], [[row[i] for i in columns] for row in rows])


def goals(folder: str = "") -> str:
    """Success in goal environments after so many steps: of presets, or of a folder of other runs in ``learning/goals``."""
    marks = (50_000, 100_000, 300_000)
    rows = []
    for path in sorted((DATA / "learning" / "goals" / folder).glob("*.json")):
        content = load(path.name, path.parent)
        words, runs = shlex.split(content["command"]), content["runs"]
        curves = [dict(run.get("success_curve", [])) for run in runs]
        minutes = [run["seconds"] / 60 for run in runs]
        options = " ".join(words[4:]).replace("--continue", "")
        rows.append(
            [
                words[2],
                words[3],
                *(success([curve[mark] for curve in curves if mark in curve]) for mark in marks),
                f"{success([run['success_rate'] for run in runs])} at {runs[0]['steps']:,}",
                success([run["reached_rate"] for run in runs if "reached_rate" in run]),
                " to ".join(dict.fromkeys(f"{value:.1f}" for value in (min(minutes), max(minutes)))),
                str(len(runs)),
                content["commit"],
                code(re.sub(r" *--(out|keep) \S+", "", options).strip()),
            ]
        )
    columns = ["environment", "algorithm", *(f"at {mark:,}" for mark in marks), "at the end", "reached once"]
    header = [*columns, "minutes", "seeds", "commit", "options"]
    filled = [i for i in range(len(header)) if any(row[i] for row in rows)]
    return table([header[i] for i in filled], [[row[i] for i in filled] for row in rows])


def other_goals() -> str:
    """Success of others in goal environments: as published, and of Stable-Baselines3 with the settings of the preset."""
    rows = []

    def add(env_id: str, learner: str, entry: dict[str, Any], minutes: float) -> None:
        rates = ", ".join(f"{100 * rate:.0f} % at {step:,}" for step, rate in dict(entry["success_curve"]).items())
        rows.append([env_id, learner, rates, f"{minutes:.0f}"])

    for entry in load("published.json"):
        if "success_curve" in entry:
            learner = f"[{entry['algorithm']} of {entry['by']}]({entry['source']})"
            add(entry["version"], learner, entry, entry["minutes"])
    original = load("goals_original.json")
    version = original.pop("version")
    for name, seeds in original.items():
        env_id, _, algorithm = name.rpartition("-")
        for seed, entry in seeds.items():
            add(env_id, f"{algorithm} of Stable-Baselines3 {version}, seed {seed}", entry, entry["seconds"] / 60)
    return table(["environment", "learner", "success", "minutes"], sorted(rows))


def success(rates: list[float]) -> str:
    """Formats the mean of success rates of seeds, with the 95 % interval of Student's t where there are three or more."""
    if not rates:
        return ""
    mean = 100 * float(np.mean(rates))
    if len(rates) < 3:
        return f"{mean:.3g} %"
    half = 100 * half_interval(rates)
    return f"{mean:.1f} % ({max(mean - half, 0):.0f} to {min(mean + half, 100):.0f})"


def curve(algorithm: str) -> str:
    """Return at the end of each recorded learning curve of an algorithm, mean and range over the seeds."""
    data = load(f"curves/{algorithm}.json")
    last = [values[-1] for values in data["returns"]]
    return (
        f"{data['env'].removeprefix('rejeu/')}, {len(last)} seeds: at the end a mean return of {sum(last) / len(last):.1f} "
        f"({min(last):.1f} to {max(last):.1f}) in training."
    )


def hyperparameters(algorithm: str) -> str:
    """The hyperparameters of an algorithm with defaults and meanings; of those that it shares, the defaults that differ."""
    config = AGENTS[algorithm].algorithm.Config
    docs, defaults = validation.field_docs(config), validation.field_defaults(config)
    shared_names: set[str] = set()
    shared = []
    for base, owner, link in SHARED:
        if issubclass(config, base) and config is not base and owner != algorithm:
            explained = validation.field_docs(base)
            usual = validation.field_defaults(AGENTS[owner].algorithm.Config if owner in AGENTS else base)
            names = [name for name in docs if name not in shared_names and docs[name] == explained.get(name)]
            differ = {name: shown(defaults[name]) for name in names if shown(defaults[name]) != shown(usual[name])}
            shared += [differences(f"[of {owner}]({link})", differ, [*(explained.keys() - docs.keys())])] * bool(names)
            shared_names.update(names)
    declared = [name for owner in config.__mro__ for name in vars(owner).get("__annotations__", ()) if name in docs]
    own_names = [name for name in dict.fromkeys(declared) if name not in shared_names]
    return "\n\n".join([meanings(own_names, docs, defaults)] * bool(own_names) + shared)


def differences(where: str, defaults: dict[str, str], missing: list[str]) -> str:
    """A sentence on hyperparameters that are explained elsewhere: the defaults that differ, and those that are not there."""
    listed = ", ".join(f"`{name}={value}`" if value else f"`{name}`" for name, value in defaults.items())
    without = ", ".join(f"`{name}`" for name in sorted(missing))
    text = f"Those {where}" + f", without {without}" * bool(without)
    return textwrap.fill(
        f"{text}, with the same defaults{f' but {listed}' * bool(listed)}.", 135, break_on_hyphens=False
    )


def shared_hyperparameters(family: str) -> str:
    """The hyperparameters that all off-policy or all on-policy algorithms have; the latter without those of both kinds."""
    config, other_config = (OffPolicyConfig, None) if family == "off-policy" else (OnPolicyConfig, OffPolicyConfig)
    docs, other_docs = validation.field_docs(config), validation.field_docs(other_config) if other_config else {}
    names = [name for name in docs if other_docs.get(name) != docs[name]]
    return meanings(names, docs, validation.field_defaults(config))


def meanings(names: list[str], docs: dict[str, str], defaults: dict[str, Any]) -> str:
    """A table of hyperparameters with their defaults."""
    cells = {name: docs[name].replace("``", "`").replace("|", "\\|") for name in names}
    rows = [
        (f"`{name}`", f"`{shown(defaults[name])}`" * bool(shown(defaults[name])), text) for name, text in cells.items()
    ]
    return table(("hyperparameter", "default", "meaning"), rows)


def shown(default: Any) -> str:
    """A default value; nothing for settings that are a configuration of their own, such as those of networks."""
    return repr(default) if isinstance(default, schedules.Linear) or not dataclasses.is_dataclass(default) else ""


def supported() -> str:
    """The action spaces for which each algorithm can be made, and the kinds of replay and policy that it has."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for page in sorted((ROOT / "docs" / "algorithms").glob("*.md")):
        title = page.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        row = options_of(AGENTS[title.replace("-", "").replace("+", "")])
        rows.setdefault(row, []).append(f"[{title}](algorithms/{page.name})")
    header = ("", "actions", "HER, prioritized, n-step", "masks", "memory", "modules")
    return table(header, [(", ".join(names), *row) for row, names in sorted(rows.items())])


def options_of(agent: Any) -> tuple[str, ...]:
    """Returns the actions, replay, masks, memory and modules of an algorithm; raises if it does not take all observations."""
    config = agent.algorithm.Config()
    box = spaces.Box(-1, 1, (2,))
    actions = {
        "Box": box,
        "Box of integers": spaces.Box(0, 3, (2,), np.int32),
        "Discrete": spaces.Discrete(3),
        "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
        "MultiBinary": spaces.MultiBinary(3),
        "Dict and Tuple": spaces.Dict({"a": spaces.Tuple([box, spaces.Discrete(2)]), "b": box}),
    }
    observations = {**actions, "images": spaces.Box(0, 255, (36, 36, 3), np.uint8)}
    possible = [name for name, space in actions.items() if can_make(agent, config, box, space)]
    for name, space in observations.items():
        if not can_make(agent, config, space, actions[possible[0]]):
            raise ValueError(
                f"{agent.__name__} does not take observations of the kind {name}; correct docs/choosing.md"
            )
    maskable = [name for name in possible if name in ("Discrete", "MultiDiscrete", "MultiBinary")]
    remembers = getattr(config, "can_remember", "cell" in vars(config.policy_kwargs))
    has_replay = "replay_buffer_class" in validation.field_names(type(config))
    masks = "" if not (config.can_mask and maskable) else "Discrete" if maskable == ["Discrete"] else "yes"
    yes = (masks, "yes" * remembers, "yes" * takes_modules(agent.algorithm.Config))
    return (", ".join(possible), "yes" * has_replay, *yes)


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
        if config.action_masks:
            n_choices(action_space, "")
        agent.algorithm.make(config, observation_space, action_space)
    except ValueError:
        return False
    return True


def training_times() -> str:
    """The preset of each environment that takes the least time, in the order of ``rejeu list``."""
    trained = (result for result in reversed(measured()) if "--curve" not in result.command)  # which evaluates as well
    results = {(result.env_id, result.algorithm): result for result in trained}
    rows: dict[str, tuple[float, tuple[str, ...]]] = {}
    for preset in presets.ALL:
        result = results.get((preset.env_id, preset.algorithm))
        if result and result.seconds[1] < rows.get(preset.env_id, (float("inf"),))[0]:
            row = (preset.env_id, preset.algorithm, result.budget.removesuffix(" steps"), time_of(result))
            rows[preset.env_id] = result.seconds[1], row
    return table(("environment", "algorithm", "steps", "time for each seed"), [row for _, row in rows.values()])


def time_of(result: PresetResult) -> str:
    """Returns the range of the training times over the seeds of a result."""
    low, high = (round(seconds) for seconds in result.seconds)
    return f"{low} s" if low == high else f"{low} to {high} s"


def parking() -> str:
    """Time and results of the preset of parking-v0."""
    result = next(result for result in measured() if result.env_id == "parking-v0")
    low, high = (100 * share for share in (result.low, result.high))
    return (
        f"Training takes {time_of(result)} on two CPU cores, compilation included ({result.seeds} seeds); evaluations and "
        f"the video come on top.\nThe trained models succeed in {low:g} to {high:g} % of {result.episodes} episodes of "
        "highway-env's `parking-v0`."
    )


def speed(length: str = "") -> str:
    """Speed compared with Stable-Baselines3 and SBX, starting with equal environments; ``short`` leaves rows out."""
    samples = load("bench.json")["samples"]

    def row(text: str, case: str, name: str, peer_name: str = "") -> tuple[str, ...]:
        rejeu_seconds = step_seconds(samples, case, name, "rejeu")
        peers = [step_seconds(samples, case, peer_name or name, library) for library in ("sb3", "sbx")]
        return (text, *(f"{times(ratio(peer, rejeu_seconds))}x" if peer else "" for peer in peers))

    def parking_row(text: str, name: str) -> tuple[str, ...]:
        rejeu_rates, peer = (
            by_round(best(samples, "parking", n, library), lambda sample: sample["result"]["training_steps_per_second"])
            for n, library in ((name, "rejeu"), ("highway-env", "sb3"))
        )
        return (text, f"{times(ratio(rejeu_rates, peer))}x", "")

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
    rows = [rows[i] for i in (0, 1, 4, 8)] if length == "short" else rows
    return table(("training steps per second", "vs. Stable-Baselines3", "vs. SBX"), rows)


EQUAL_TIME = {
    "FlashSAC 64/32": "minutes/{}-FlashSAC{}.json",
    "FlashSAC 128/64": "minutes/{}-FlashSAC-128-64{}.json",
    "XQC 64/32": "minutes/{}-XQC-64-32{}.json",
    "XQC 128/64": "minutes/{}-XQC{}.json",
    "SAC": "minutes/{}-SAC{}.json",
    "FlashSAC `full`, GPU": "h200/{}-FlashSAC{}.json",
}
"""Learners, with the widths of critics and actor, and their files below ``learning`` for an environment and its options."""


def equal_time_runs(env_id: str, options: str = "") -> dict[str, list[dict[str, Any]]]:
    """Returns the runs of the learners of :data:`EQUAL_TIME` that have any, with a row for each seed."""
    paths = {name: DATA / "learning" / file.format(env_id, options) for name, file in EQUAL_TIME.items()}
    return {name: load(path.name, path.parent)["runs"] for name, path in paths.items() if path.exists()}


def equal_time() -> str:
    """Returns on MuJoCo after equal time and at full size on a GPU, and as shares of TD3's return after a million steps."""
    shares: dict[str, list[float]] = {name: [] for name in EQUAL_TIME}
    rows: list[tuple[str, ...]] = []
    for env_id, options in [*((env_id, "") for env_id in TD3_RETURNS), ("Ant-v5", "-without-contact-forces")]:
        runs_by_method, (least, td3) = equal_time_runs(env_id, options), TD3_RETURNS[env_id]
        cells = dict.fromkeys(EQUAL_TIME, "")
        for name, runs in runs_by_method.items():
            returns = [run["mean_return"] for run in runs]
            share = float((np.mean(returns) - least) / (td3 - least))
            shares[name] += [] if options else [share]
            seeds = f"; {' and '.join(f'{value:,.0f}' for value in returns)}" if len(runs) > 1 else ""
            steps = np.mean([run["steps"] for run in runs])
            cells[name] = f"{np.mean(returns):,.0f} ({share:.2f}{seeds}), {steps:,.0f} steps"
        rows.append((env_id + options.replace("-", " "), *cells.values()))
    means = (
        f"({np.mean(method_shares):.2f})" if len(method_shares) == len(TD3_RETURNS) else ""
        for method_shares in shares.values()
    )
    rows.append(("mean of the five", *means))
    return table(("environment", *EQUAL_TIME), rows)


def data(path: str, key: str, *columns: str) -> str:
    """A part of a file of results as it is, with its commit, date and command: a table of rows, or of names and values.

    Args:
        path: the file, from the root of the repository.
        key: the part, such as ``results`` or ``rejeu/summary``; ``-`` for the whole file.
        columns: the values of each row to show, in the same way; all numbers and words if there are none.
    """
    content = load(path, ROOT)
    section = within(content, key)
    is_table = isinstance(section, list) or bool(columns)
    if is_table:
        named_rows = [("", row) for row in section] if isinstance(section, list) else [*section.items()]
        rows = [(name, row) for name, row in named_rows if isinstance(row, dict)]
        name_column = [("",)] if any(name for name, _ in rows) else []
        header = [*(("",) if name_column else ()), *(column.split("/")[-1].replace("_", " ") for column in columns)]
        cells = [
            [*((name,) if name_column else ()), *(cell(within(row, column)) for column in columns)]
            for name, row in rows
        ]
    else:
        header, cells = (
            ["", ""],
            [[name.replace("_", " "), cell(value)] for name, value in section.items() if is_plain(value)],
        )
    origin = [
        content.get("commit", "")[:7],
        content.get("date", ""),
        f"`{content['command']}`" if "command" in content else "",
    ]
    text = ", ".join(filter(None, origin))
    return f"{textwrap.fill(text, 135, break_on_hyphens=False)}\n\n{table(header, cells)}".strip()


def within(content: Any, key: str) -> Any:
    """Returns the value under a path of keys, None if there is none."""
    for name in key.split("/") if key != "-" else ():
        content = content.get(name) if isinstance(content, dict) else None
    return content


def is_plain(value: Any) -> bool:
    """Returns whether a value fits into a cell: a number, a word, or a short list of them."""
    return not isinstance(value, dict | list) or (
        isinstance(value, list) and len(value) <= 3 and all(map(is_plain, value))
    )


def cell(value: Any) -> str:
    """Formats a value of a file of results."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {cell(item)}" for name, item in value.items())
    if isinstance(value, list):
        return " to ".join(map(cell, value))
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


BLOCKS: dict[str, Callable[..., str]] = {
    "data": data,
    "curve": curve,
    "equal-time": equal_time,
    "goals": goals,
    "other-goals": other_goals,
    "learned": learned,
    "hyperparameters": hyperparameters,
    "shared-hyperparameters": shared_hyperparameters,
    "supported": supported,
    "presets": training_times,
    "parking": parking,
    "speed": speed,
    "sb3-names": sb3_parity.text,
    "sb3-guide": sb3_parity.guide,
    "sb3-suite": sb3_parity.suite,
    "sb3-scripts": sb3_parity.same_scripts,
}


def render(text: str) -> str:
    """Returns a page with every marked block regenerated; a block whose data does not exist yet is empty."""

    def block(match: re.Match[str]) -> str:
        name, *arguments = shlex.split(match[2])
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
