"""Texts and tables of results for the pages: of training on the device, sweeps, remote environments and tuning.

Each function takes the content of a file in ``benchmarks/results`` and returns Markdown; see ``scripts/figures.py``.
"""

from __future__ import annotations

import textwrap
from typing import Any

from benchmarks import device, device_peers
from benchmarks.bench.text import table

WIDTH = 132
"""Characters in a line of a page."""
PEERS = {"rejeu": "rejeu, on the device", "rejax": "Rejax", "sb3": "Stable-Baselines3"}
REMOTE_WORKERS = (1, 8, 64)
"""Numbers of workers in the table of remote environments."""


def paragraph(text: str) -> str:
    """Returns text in lines as long as those of the pages."""
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def functional(data: dict[str, Any]) -> str:
    """Steps per second of the environments in JAX and of their counterparts."""
    names = ("program", "vector", "gymnasium", "envpool")
    rows = []
    for entry in data["results"]:
        rates = [entry["steps_per_second"].get(name) for name in names]
        cells = ("" if rate is None else f"{rate:,.0f}" for rate in rates)
        rows.append((f"`{entry['env']}`", f"{entry['n_envs']:,}", *cells, f"{entry['compile_seconds']:.1f} s"))
    header = ("environment", "`n_envs`", "in a program", "`make_vector`", "Gymnasium", "EnvPool", "compilation")
    machine = data["machine"]
    intro = (
        f"Environment steps per second with random actions, resets included (`{data['command']}`; {machine['device']}, "
        f"{machine['cores']} cores). `in a program` is one compiled loop, as in training on the device; "
        "the other columns step from Python."
    )
    return f"{paragraph(intro)}\n\n{table(header, rows)}"


def device_replay(data: dict[str, Any]) -> str:
    """Times of the host's loop with its replay buffer on the host and on the device."""
    rows = []
    for one in data["results"]:
        times, rounds = one["microseconds"], one["of_each_round"]
        cells = (f"{times[kind]:.0f} ({min(rounds[kind]):.0f} to {max(rounds[kind]):.0f})" for kind in times)
        rows.append((one["case"], *cells, f"{one['batch_by_numpy_microseconds']:.0f}"))
    intro = (
        f"Microseconds for each step, median and range of {len(next(iter(rounds.values())))} rounds (`{data['command']}`; "
        f"{data['machine']['device']}, {data['machine']['cores']} cores)."
    )
    return f"{paragraph(intro)}\n\n{table(('', *times, 'NumPy, for a batch alone'), rows)}"


def device_loops(data: dict[str, Any]) -> str:
    """Steps per second of the loop on the device, and of the host's loop with two kinds of environments."""
    rows = []
    for name, case in device.CASES.items():
        for n_envs in sorted({one["n_envs"] for one in data["results"] if one["case"] == name}):
            rates = {
                one["kind"]: one["steps_per_second"]
                for one in data["results"]
                if (one["case"], one["n_envs"], one["n_seeds"]) == (name, n_envs, 1) and "error" not in one
            }
            if "device" not in rates:
                continue
            compiling = next(
                one["compile_seconds"]
                for one in data["results"]
                if (one["case"], one["kind"], one["n_envs"], one["n_seeds"]) == (name, "device", n_envs, 1)
            )
            ratio = f"{rates['device'] / rates['host']:.1f}" if "host" in rates else ""
            cells = (f"{rates[kind]:,.0f}" if kind in rates else "" for kind in ("device", "host jax", "host"))
            rows.append((f"{name}: {case.env}", str(n_envs), *cells, ratio, f"{compiling:.1f} s"))
    intro = (
        f"Environment steps per second, updates included, after compilation (`{data['command']}`; {data['device']}, "
        f"{data['machine']['cores']} cores). The host's loop steps the environments in JAX, or Gymnasium's (EnvPool's with "
        "PPO and parking)."
    )
    header = (
        "case",
        "`n_envs`",
        "on the device",
        "host, in JAX",
        "host, its own environments",
        "device to the latter",
        "compiling",
    )
    return f"{paragraph(intro)}\n\n{table(header, rows)}"


def device_seeds(data: dict[str, Any]) -> str:
    """The time of several seeds in one program, as a multiple of that of one seed."""
    good = [one for one in data["results"] if "error" not in one]
    numbers = sorted({one["n_seeds"] for one in good} - {1})
    rows = []
    for name, case in device.CASES.items():
        for kind, where in (("device", "in JAX"), ("host", "on the host")):
            same = [one for one in good if (one["case"], one["kind"], one["n_envs"]) == (name, kind, case.n_envs)]
            rates = {one["n_seeds"]: one["steps_per_second"] for one in same}
            if 1 in rates and len(rates) > 1:
                cells = (f"{n * rates[1] / rates[n]:.1f}" if n in rates else "" for n in numbers)
                rows.append((f"{name}, {where}", *cells))
    header = ("time of several seeds, times that of one", *(f"{n} seeds" for n in numbers))
    return table(header, rows)


def peers(data: dict[str, Any]) -> str:
    """Training on the device next to Rejax and Stable-Baselines3."""
    rows = []
    for one in data["results"]:
        case = device_peers.CASES[one["case"]]
        ratio = f"{one['rejeu_to_this']:.2f}" if "rejeu_to_this" in one else ""
        threads = f", {one['threads']}" if one["threads"] else ""
        spread = f"{one['steps_per_second']:,.0f} ({one['least']:,.0f} to {one['most']:,.0f})"
        compiling = f"{one['compile_seconds']:.1f} s" if one["compile_seconds"] else ""
        rows.append((f"{case.algorithm}, {case.env}", f"{PEERS[one['library']]}{threads}", spread, ratio, compiling))
    versions = data["versions"]
    names = [
        f"{PEERS[library]} {versions[library][package]}"
        for library, package in (("rejax", "rejax"), ("sb3", "stable-baselines3"))
        if library in versions
    ]
    intro = (
        f"Next to {' and '.join(names)}, with the same settings (`{data['command']}`; {data['device']}, "
        f"{data['machine']['cores']} cores): environment steps per second after compilation, the median of "
        f"{data['results'][0]['rounds']} rounds with minimum and maximum. The networks are 64-64. PPO has 16 environments, "
        "rollouts of 128 steps and batches of 256; DQN and SAC have one environment, and a gradient step on 256 transitions "
        "for every step."
    )
    shown = [
        text if case == "all" else f"{case.upper()}: {text}"
        for case in ("all", *device_peers.CASES)
        for text in data["differences"][case]
    ]
    notes = "\n".join(
        textwrap.fill(text, WIDTH, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False)
        for text in shown
    )
    header = ("", "", "steps/s", "rejeu to this", "compiling")
    return f"{paragraph(intro)}\n\n{table(header, rows)}\n\nWhat differs all the same:\n\n{notes}"


def percent(rate: float, interval: list[float]) -> str:
    return f"{100 * rate:.1f} % ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"


def transfer(data: dict[str, Any]) -> str:
    """Success rates of policies for parking on the device and in highway-env."""
    rows = []
    for name, run in [*((f"seed {run['seed']}", run) for run in data["runs"]), ("all", data["all"])]:
        rates = (
            percent(run[where]["success_rate"], run[where]["success_interval"]) for where in ("device", "highway_env")
        )
        low, high = (100 * bound for bound in run["interval"])
        seconds = f"{run['training_seconds']:.0f} s" if "training_seconds" in run else ""
        rows.append((name, seconds, *rates, f"{100 * run['difference']:+.1f} ({low:+.1f} to {high:+.1f})"))
    version = data["versions"]["highway-env"]
    intro = (
        f"Policies for parking that were trained on the device, {data['runs'][0]['steps']:,} steps with the preset, in "
        f"{data['runs'][0]['device']['episodes']} new episodes there and as many of highway-env {version} "
        f"(`{data['command']}`), with 95 % intervals:"
    )
    header = ("", "training", "success on the device", "success in highway-env", "difference, percentage points")
    return f"{paragraph(intro)}\n\n{table(header, rows)}"


def sweep(data: dict[str, Any]) -> str:
    """How close a sweep comes to the ideal."""
    lines = []
    for kind, name in (("local", "`rejeu sweep`"), ("ray", "the same on a Ray cluster of this machine")):
        if kind in data:
            share, own = (
                100 * data[kind][key] for key in ("share_of_ideal_of_one_core", "share_of_the_times_of_its_processes")
            )
            lines.append(
                f"{name} takes {data[kind]['seconds']:.0f} s, {share:.0f} % of the ideal (its runs {own:.0f} %)"
            )
    text = (
        f"With {data['runs']} runs of {data['steps']:,} steps and {data['workers']} workers on {data['cores']} cores "
        f"(`{data['command']}`) {'; '.join(lines)}. The ideal is the time of a run that has a core to itself, times the "
        "runs, divided by the workers; in brackets is the same with the times that the runs of the sweep took."
    )
    return paragraph(text)


def sweep_kills(data: dict[str, Any]) -> str:
    """What killing runs, workers and nodes costs, and whether the models are the same."""
    rows = []
    for kind, name in (("local", "local processes"), ("ray", "Ray")):
        if kind in data:
            one = data[kind]
            parts = ", ".join(
                f"{number} of a {key.removeprefix('kills_of_a_')}"
                for key, number in one.items()
                if key.startswith("kills_of_a_")
            )
            equal = f"{one['runs'] - len(one['models_that_differ'])} of {one['runs']}"
            rows.append((name, f"{one['kills']}: {parts}", equal, f"{one['most_seconds_of_training_lost']:.1f} s"))
    intro = (
        f"Runs, workers, nodes and sweeps were killed at random moments (`{data['command']}`), with a checkpoint every "
        f"{data['checkpoint_interval_seconds']:g} s. The final models are compared bit for bit with those of an undisturbed "
        "sweep:"
    )
    header = ("", "kills", "equal models", "most training lost by the kill of a run")
    return f"{paragraph(intro)}\n\n{table(header, rows)}"


def pqn(data: dict[str, Any]) -> str:
    """How long PQN takes in one program until the greedy policy reaches a return."""
    reached = [run["reached"] for run in data["runs"] if run["reached"]]
    seconds, steps = [one["seconds"] for one in reached], [one["steps"] for one in reached]
    compiling = max(run["whole_run"]["compile_seconds"] for run in data["runs"])
    text = (
        f"In `{data['env']}`, in one program, the greedy policy has a mean return of {data['target']:g} in "
        f"{data['episodes']} episodes after {min(seconds):.1f} to {max(seconds):.1f} s and {min(steps):,} to {max(steps):,} "
        f"steps ({len(reached)} of {len(data['runs'])} seeds; `{data['command']}`, {data['machine']['cores']} cores). "
        f"Compiling, which is not counted, takes up to {compiling:.1f} s with a filled compilation cache."
    )
    return paragraph(text)


def remote(data: dict[str, Any]) -> str:
    """Shares of the ideal number of steps, in lockstep and with the first results."""
    rows = []
    for one in data["results"]:
        if one["workers"] in REMOTE_WORKERS:
            shares = (f"{100 * one[way]['share']:.0f} %" for way in ("lockstep", "first_k"))
            step = f"{1000 * one['step_seconds']:g} ms"
            rows.append((step, f"`{one['backend']}`", str(one["workers"]), *shares, str(one["k"])))
    intro = (
        f"Environments that sleep in every step, on one machine with {data['machine']['cores']} cores (`{data['command']}`), "
        "as a share of the ideal number of steps, which is the number of workers divided by the time of a step:"
    )
    header = ("a step", "backend", "environments", "lockstep", "first k", "k")
    return f"{paragraph(intro)}\n\n{table(header, rows)}"


def first_of_n(data: dict[str, Any]) -> str:
    """SAC with the first results, next to lockstep."""
    found, seeds = data["summary"], len(data["runs"]["lockstep"])

    def told(one: dict[str, float]) -> str:
        return f"{one['mean']:.1f} ({one['low']:.1f} to {one['high']:.1f})"

    one, other, difference = (found[way]["mean_return"] for way in ("first_4_of_8", "lockstep", "difference"))
    text = (
        f"SAC on Pendulum-v1, with steps of random times, has a mean return of {told(one)} with the first 4 of 8 results "
        f"and of {told(other)} in lockstep; the difference is {told(difference)} (`{data['command']}`, {seeds} seeds, "
        f"{data['steps']:,} steps, 95 % intervals)."
    )
    return paragraph(text)


def tune(data: dict[str, Any]) -> str:
    """What two studies found, and whether interruptions changed trials."""
    rows = []
    for one in data["studies"]:
        default, winner = ({**row} for row in sorted(one["comparison"], key=lambda row: row["group"] != "default"))
        scores = (f"{row['iqm']:.1f} ({row['iqm_low']:.1f} to {row['iqm_high']:.1f})" for row in (default, winner))
        low, high = one["difference"][1:]
        trials = ", ".join(f"{number} {state}" for state, number in one["trials"].items() if number)
        difference = f"{one['difference'][0]:.1f} ({low:.1f} to {high:.1f})"
        rows.append((default["env"], trials, f"{one['minutes']:.1f}", *scores, difference, one["verdict"]))
    before, unchanged = (
        sum(part[key] for one in data["studies"] for part in one["interruptions"])
        for key in ("ended_before", "of_them_unchanged")
    )
    seeds = data["studies"][0]["comparison"][0]["runs"]
    intro = (
        f"Two studies on {data['cores']} cores (`{data['command']}`), each stopped once by Ctrl-C and once by SIGKILL and "
        f"resumed: {unchanged} of the {before} trials that had ended before an interruption were unchanged at the end. The "
        f"returns are interquartile means over {seeds} fresh seeds with 95 % intervals."
    )
    header = ("environment", "trials", "minutes", "default", "winner", "difference", "verdict")
    return f"{paragraph(intro)}\n\n{table(header, rows)}"
