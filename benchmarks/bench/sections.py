"""Sections of the page with measured results. A section is empty if its case was not measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benchmarks.bench import plan
from benchmarks.bench.summary import (
    ByRound,
    Limit,
    Sample,
    best,
    by_round,
    gap,
    limit,
    ratio,
    shares,
    spread,
    step_seconds,
)
from benchmarks.bench.text import NAMES, number, percent, table, times, times_of_most, variant_of, with_spread


def parking(samples: Sequence[Sample]) -> str:
    jobs = [m for m in plan.parking(False) if best(samples, "parking", m.name, m.library)]
    if not jobs:
        return ""
    rows = []
    peer = best(samples, "parking", "highway-env", "sb3")
    for job in jobs:
        job_samples = best(samples, "parking", job.name, job.library)
        get = lambda key, job_samples=job_samples: by_round(job_samples, lambda s: s["result"][key])  # noqa: E731
        whole = by_round(job_samples, lambda s: s["wall_seconds"])
        versus = [times(ratio(by_round(peer, lambda s: s["wall_seconds"]), whole)) if peer else ""]
        speed = ratio(
            get("training_steps_per_second"), by_round(peer, lambda s: s["result"]["training_steps_per_second"])
        )
        outside = ratio(by_round(peer, lambda s: s["result"]["seconds_outside_env"]), get("seconds_outside_env"))
        is_peer = job.library == "sb3"
        rows.append(
            (
                f"{NAMES[job.library]}, {job.name}" + (f" ({variant_of(job_samples)})" if is_peer else ""),
                with_spread(whole),
                "" if is_peer else versus[0],
                with_spread(get("training_steps_per_second")),
                "" if is_peer else times(speed),
                with_spread(get("seconds_in_env"), 1e3),
                with_spread(get("seconds_outside_env"), 1e3),
                "" if is_peer else times(outside),
                with_spread(get("compile_seconds")),
                percent(spread(get("success_rate")).median),
            )
        )
    header = (
        "",
        "whole process, s",
        "ratio",
        "training steps/s",
        "ratio",
        "ms in the environment",
        "ms outside it",
        "ratio",
    )
    return f"""## Parking

SAC with HER on parking-v0 as a whole process: import, train for 5,000 steps, save model and buffer, load both, evaluate
10 episodes. The compilation cache is empty. Training is timed from the first update on, after compilation. "In the
environment" is the time of `step` and `reset`. 64-64 networks, batches of 64, one update for each step after step 1,000.

{table((*header, "compiling, s", "success"), rows)}

{share_table([(job.name, best(samples, "parking", job.name, "rejeu"), None) for job in jobs if job.library == "rejeu"])}"""


def share_table(cases: Sequence[tuple[str, Sequence[Sample], Mapping[str, float] | None]]) -> str:
    """Returns rejeu's time by part, and the difference from the limit if there is one."""
    rows = []
    beyond = any(gaps is not None for *_, gaps in cases)
    for name, rejeu_samples, gaps in cases:
        parts = shares(rejeu_samples)
        if parts is not None:
            cells = [number(1e6 * gaps[part_name]) if gaps else "" for part_name in parts] if beyond else []
            rows.append((name, *(percent(share) for share in parts.values()), *cells))
    if not rows:
        return ""
    text = (
        "rejeu's training time by part (`agent.seconds`). `update` is the time that the loop waits for the device, including "
        "acting\nand dispatch."
    )
    header: tuple[str, ...] = ("", "environment", "replay", "update", "rest")
    if beyond:
        header += ("beyond the bare environment, us", "replay, us", "update beyond its arithmetic, us", "rest, us")
        text += (
            " The right half is the difference to the limit in microseconds per step, which is negative\n"
            "where parts overlap."
        )
    return f"{text}\n\n{table(header, rows)}"


def per_step(samples: Sequence[Sample]) -> str:
    names = [name for name in (*plan.STEPS, plan.POOL) if best(samples, "steps", name, "rejeu")]
    if not names:
        return ""
    rows, limits = [], {}
    for name in names:
        by = {library: step_seconds(samples, "steps", name, library) for library in plan.LIBRARIES}
        limits[name] = limit(samples, "steps", name, env_of(name))
        rows.append((name, *compared(samples, name, by, limits[name]), *limit_cells(limits[name], 1e3)))
    measured = [
        (name, best(samples, "steps", name, "rejeu"), gap_to(samples, "steps", name, limits[name])) for name in names
    ]
    header = ("", "rejeu, ms", "Stable-Baselines3, ms", "ratio", "SBX, ms", "ratio", *LIMIT_HEADER)
    settings = "; ".join(
        f"{name}: {'-'.join(map(str, s['policy_kwargs']['net_arch']))}, batches of {s['batch_size']}, {env}"
        for name, (_, env, s) in plan.STEPS.items()
        if name in names
    )
    return f"""## Off-policy: a step with one update

Milliseconds per environment step with one gradient step, with one Gymnasium environment; in the last row with eight
environments on EnvPool and eight updates at once. {settings}.

{table(header, rows)}

{share_table(measured)}"""


LIMIT_HEADER = ("limit", "environment part", "arithmetic part", "of the limit")


def compared(
    samples: Sequence[Sample], name: str, by: Mapping[str, ByRound], case_limit: Limit | None
) -> tuple[str, ...]:
    """Returns a row of :func:`per_step`: rejeu's time, then time, setting and ratio of each other library."""
    cells = [with_spread(by["rejeu"], 1e3)]
    for library in ("sb3", "sbx"):
        setting = variant_of(best(samples, "steps", name, library))
        cells.append(with_spread(by[library], 1e3) + (f", {setting}" if setting else ""))
        cells.append(times_of_most(by[library], by["rejeu"], case_limit))
    return tuple(cells)


def limit_cells(case_limit: Limit | None, scale: float) -> tuple[str, ...]:
    """Returns the cells that describe a limit."""
    if case_limit is None:
        return ("",) * len(LIMIT_HEADER)
    numbers = (number(scale * value) for value in (case_limit.seconds, case_limit.env, case_limit.arithmetic))
    return (*numbers, percent(case_limit.share_reached))


def gap_to(samples: Sequence[Sample], case: str, name: str, case_limit: Limit | None) -> dict[str, float] | None:
    """Returns the time per step in excess of a limit, or None without a limit."""
    return None if case_limit is None else gap(samples, case, name, case_limit)


def env_of(name: str) -> str:
    """Returns the environment of a case of :func:`per_step` as named in the measurements without an agent."""
    if name == plan.POOL:
        return plan.env_name(plan.STEPS["SAC"][1], 8, "envpool")
    return plan.env_name(plan.STEPS[name][1], 1, "gymnasium")


def rollouts(samples: Sequence[Sample]) -> str:
    tables, measured = [], []
    for algorithm in ("PPO", "A2C"):
        rows = []
        for n in plan.N_ENVS:
            for backend in plan.BACKENDS:
                name, home = f"{algorithm}, {n} on {backend}", f"{algorithm}, {n} on gymnasium"
                rejeu_seconds = step_seconds(samples, "rollouts", name, "rejeu")
                if not rejeu_seconds:
                    continue
                peers = {library: step_seconds(samples, "rollouts", home, library) for library in ("sb3", "sbx")}
                case_limit = limit(samples, "rollouts", name, plan.env_name(plan.LANDER, n, backend), counted_as=home)
                measured.append(
                    (name, best(samples, "rollouts", name, "rejeu"), gap_to(samples, "rollouts", name, case_limit))
                )
                cells = [str(n), {"gymnasium": "Gymnasium", "envpool": "EnvPool"}[backend], rate_text(rejeu_seconds)]
                for library, numbers in peers.items():
                    if library == "sbx" and algorithm == "A2C":
                        continue
                    setting = variant_of(best(samples, "rollouts", home, library))
                    cells += [rate_text(numbers) + (f", {setting}" if setting else "")]
                    cells.append(times_of_most(numbers, rejeu_seconds, case_limit))
                rows.append((*cells, *limit_cells(case_limit, 1e6)))
        if rows:
            header = ["environments", "rejeu on", "rejeu", "Stable-Baselines3", "ratio"]
            header += ["SBX", "ratio"] if algorithm == "PPO" else []
            limit_header = ("limit, us per step", "environment part", "arithmetic part", "of the limit")
            tables.append(f"### {algorithm}\n\n{table((*header, *limit_header), rows)}")
    if not tables:
        return ""
    return f"""## On-policy: PPO and A2C by number of environments

Environment steps per second on {plan.LANDER}, 64-64 networks, updates included. PPO: rollouts of {plan.ROLLOUT:,} steps
in total, batches of 64, 5 epochs. A2C: rollouts of 5 steps of each environment. The other libraries step Gymnasium
environments in the process, so their figures are the same in both rows. SBX has no A2C.

{(chr(10) * 2).join(tables)}

{share_table(measured)}"""


def rate_text(seconds: ByRound) -> str:
    """Returns steps per second and their range as text."""
    return with_spread({turn: 1.0 / value for turn, value in seconds.items()})


def memory(samples: Sequence[Sample]) -> str:
    rows = []
    for task, text in (("parking", "parking-v0: Dict of 3 times 6"), ("pendulum", "Pendulum-v1: Box of 3")):
        for library, name in (("rejeu", task), ("sb3", task), ("sb3", f"{task}, optimize_memory_usage")):
            for row in best(samples, "memory", name, library)[:1]:
                measured = row["result"]
                label = NAMES[library] + (" with `optimize_memory_usage`" if "," in name else "")
                per = lambda value, n=measured["n"]: "" if value is None else number(value / n)  # noqa: E731
                resident = measured["resident"]
                rows.append(
                    (
                        text,
                        label,
                        per(measured["necessary"]),
                        per(measured["nbytes"]),
                        f"{measured['nbytes'] / measured['necessary']:.2f}",
                        per(resident),
                        "" if resident is None else f"{resident / measured['necessary']:.2f}",
                    )
                )
    if not rows:
        return ""
    header = ("observations", "", "necessary", "arrays", "times", "process growth", "times")
    return f"""## Memory of a full buffer

Bytes per transition, with a million transitions. The necessary bytes are one observation, the action, the reward and a
flag: `4 (observation + action + 1) + 1` with 4-byte numbers. For HER rejeu adds 4 bytes for the distance to the end of
the episode, and one row for the final observation of each episode (here one in 101). highway-env declares float64
observations, which rejeu stores as float32.

{table(header, rows)}"""


def startup(samples: Sequence[Sample]) -> str:
    samples_by_library = {library: best(samples, "startup", "processes", library) for library in plan.LIBRARIES}
    samples_by_library = {library: rows for library, rows in samples_by_library.items() if rows}
    if not samples_by_library:
        return ""
    names = list(dict.fromkeys(name for rows in samples_by_library.values() for name in rows[0]["result"]["seconds"]))
    labels = {
        "python": "`python -c pass`",
        "import": "import",
        "first update, cold": "SAC on Pendulum-v1 until the first update, compilation cache empty",
        "first update, warm": "the same with the compilation cache",
        "command line, --help": "`rejeu --help`",
    }

    def cell(rows: Sequence[Sample], name: str) -> str:
        return with_spread(
            by_round([r for r in rows if name in r["result"]["seconds"]], lambda s: s["result"]["seconds"][name])
        )

    rows = [(labels[name], *(cell(of, name) for of in samples_by_library.values())) for name in names]
    return f"""## Startup

Seconds of whole processes. SBX has a compilation cache too, which it does not enable by itself; Stable-Baselines3 does
not compile.

{table(("", *(NAMES[library] for library in samples_by_library)), rows)}"""
