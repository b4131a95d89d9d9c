"""The sections of the page on what was measured, each empty if its case was not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from benchmarks.bench import pictures, plan
from benchmarks.bench.pictures import NAMES, number
from benchmarks.bench.summary import (
    ByRound,
    Limit,
    Sample,
    Spread,
    best,
    by_round,
    gap,
    limit,
    ratio,
    shares,
    spread,
    step_seconds,
)
from benchmarks.bench.text import percent, table, times, times_of_most, variant_of, with_spread

PICTURES = {"steps": "speed-steps.png", "rollouts": "speed-rollouts.png", "replay": "speed-replay.png"}


def parking(samples: Sequence[Sample]) -> str:
    jobs = [m for m in plan.parking(False) if best(samples, "parking", m.name, m.library)]
    if not jobs:
        return ""
    rows = []
    peer = best(samples, "parking", "highway-env", "sb3")
    for job in jobs:
        found = best(samples, "parking", job.name, job.library)
        get = lambda key, found=found: by_round(found, lambda s: s["result"][key])  # noqa: E731
        whole = by_round(found, lambda s: s["wall_seconds"])
        versus = [times(ratio(by_round(peer, lambda s: s["wall_seconds"]), whole)) if peer else ""]
        speed = ratio(
            get("training_steps_per_second"), by_round(peer, lambda s: s["result"]["training_steps_per_second"])
        )
        outside = ratio(by_round(peer, lambda s: s["result"]["seconds_outside_env"]), get("seconds_outside_env"))
        is_peer = job.library == "sb3"
        rows.append(
            (
                f"{NAMES[job.library]}, {job.name}" + (f" ({variant_of(found)})" if is_peer else ""),
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
        "whole job, s",
        "ratio",
        "training steps/s",
        "ratio",
        "ms in the environment",
        "ms outside it",
        "ratio",
    )
    return f"""## The parking job

SAC with hindsight replay on parking-v0 from the start of the process to its end: import, train for 5,000 steps, save model
and buffer, load both, evaluate 10 episodes. The compilation cache is empty. Training is timed from the first update on, when
all is compiled; "in the environment" are its `step` and `reset`, by the same wrapper in either library. 64-64, batches of
64, one update a step from step 1,000 on. Success after so few steps is that of a policy that has hardly learnt.

{table((*header, "compiling, s", "success"), rows)}

{share_table([(job.name, best(samples, "parking", job.name, "rejeu"), None) for job in jobs if job.library == "rejeu"])}"""


def share_table(cases: Sequence[tuple[str, Sequence[Sample], Mapping[str, float] | None]]) -> str:
    """Returns what rejeu's time went into, case by case, and by how much that is beyond the limit where there is one."""
    rows = []
    beyond = any(gaps is not None for *_, gaps in cases)
    for name, found, gaps in cases:
        parts = shares(found)
        if parts is not None:
            cells = [number(1e6 * gaps[part]) if gaps else "" for part in parts] if beyond else []
            rows.append((name, *(percent(share) for share in parts.values()), *cells))
    if not rows:
        return ""
    text = (
        "Where rejeu's time went while training (`agent.seconds`). `update` is the time that the loop waited for the device, "
        "acting and\ndispatch included."
    )
    header: tuple[str, ...] = ("", "environment", "replay", "update", "rest")
    if beyond:
        header += ("beyond the bare environment, us", "replay, us", "update beyond its arithmetic, us", "rest, us")
        text += (
            " The right half is what stands between rejeu and the limit, in microseconds of a step; a number is\nnegative "
            "where something is done while something else is waited for."
        )
    return f"{text}\n\n{table(header, rows)}"


def per_step(samples: Sequence[Sample], page: Path) -> str:
    names = [name for name in (*plan.STEPS, plan.POOL) if best(samples, "steps", name, "rejeu")]
    if not names:
        return ""
    rows, limits, drawn = [], {}, {}
    for name in names:
        by = {library: step_seconds(samples, "steps", name, library) for library in plan.LIBRARIES}
        limits[name] = limit(samples, "steps", name, env_of(name))
        drawn[name] = {library: spread(numbers) for library, numbers in by.items() if numbers}
        rows.append((name, *compared(samples, name, by, limits[name]), *limit_cells(limits[name], 1e3)))
    picture = page.parent / "images" / PICTURES["steps"]
    one = {name: by for name, by in drawn.items() if name != plan.POOL} or drawn
    pictures.draw_steps(one, limits, picture, "A step with one update, one environment")
    measured = [
        (name, best(samples, "steps", name, "rejeu"), gap_to(samples, "steps", name, limits[name])) for name in names
    ]
    header = ("", "rejeu, ms", "Stable-Baselines3, ms", "ratio", "SBX, ms", "ratio", *LIMIT_HEADER)
    settings = "; ".join(
        f"{name}: {'-'.join(map(str, s['policy_kwargs']['net_arch']))}, batches of {s['batch_size']}, {env}"
        for name, (_, env, s) in plan.STEPS.items()
        if name in names
    )
    return f"""## A step with one update

Milliseconds of an environment step with one gradient step, one Gymnasium environment; in the last row eight environments on
EnvPool and eight updates a turn, which is again one a step. {settings}.

{table(header, rows)}

![Milliseconds of a step](images/{PICTURES["steps"]})

{share_table(measured)}"""


LIMIT_HEADER = ("limit", "of it environment", "of it arithmetic", "of the limit")


def compared(samples: Sequence[Sample], name: str, by: Mapping[str, ByRound], found: Limit | None) -> tuple[str, ...]:
    """Returns the cells of a row of :func:`per_step`: rejeu's time, then each peer's with its setting and the ratio."""
    cells = [with_spread(by["rejeu"], 1e3)]
    for library in ("sb3", "sbx"):
        setting = variant_of(best(samples, "steps", name, library))
        cells.append(with_spread(by[library], 1e3) + (f", {setting}" if setting else ""))
        cells.append(times_of_most(by[library], by["rejeu"], found))
    return tuple(cells)


def limit_cells(found: Limit | None, scale: float) -> tuple[str, ...]:
    """Returns the cells of a limit."""
    if found is None:
        return ("",) * len(LIMIT_HEADER)
    numbers = (number(scale * value) for value in (found.seconds, found.env, found.arithmetic))
    return (*numbers, percent(found.share_reached))


def gap_to(samples: Sequence[Sample], case: str, name: str, found: Limit | None) -> dict[str, float] | None:
    """Returns what a step takes beyond a limit, None where there is no limit."""
    return None if found is None else gap(samples, case, name, found)


def env_of(name: str) -> str:
    """Returns the name of the bare environment of a case of :func:`per_step`."""
    if name == plan.POOL:
        return plan.env_name(plan.STEPS["SAC"][1], 8, "envpool")
    return plan.env_name(plan.STEPS[name][1], 1, "gymnasium")


def rollouts(samples: Sequence[Sample], page: Path) -> str:
    tables, drawn, limits, measured = [], {}, {}, []
    for algorithm in ("PPO", "A2C"):
        rows = []
        lines: dict[str, dict[int, Spread]] = {}
        at: dict[str, dict[int, float]] = {}
        for n in plan.N_ENVS:
            for backend in plan.BACKENDS:
                name, home = f"{algorithm}, {n} on {backend}", f"{algorithm}, {n} on gymnasium"
                own = step_seconds(samples, "rollouts", name, "rejeu")
                if not own:
                    continue
                peers = {library: step_seconds(samples, "rollouts", home, library) for library in ("sb3", "sbx")}
                found = limit(samples, "rollouts", name, plan.env_name(plan.LANDER, n, backend), counted_as=home)
                measured.append(
                    (name, best(samples, "rollouts", name, "rejeu"), gap_to(samples, "rollouts", name, found))
                )
                line = "rejeu" if backend == "gymnasium" else "rejeu, EnvPool"
                lines.setdefault(line, {})[n] = rate_of(own)
                if found is not None:
                    at.setdefault(line, {})[n] = 1.0 / found.seconds
                for library, numbers in peers.items():
                    if numbers:
                        lines.setdefault(library, {})[n] = rate_of(numbers)
                cells = [str(n), {"gymnasium": "Gymnasium", "envpool": "EnvPool"}[backend], rate_text(own)]
                for library, numbers in peers.items():
                    if library == "sbx" and algorithm == "A2C":
                        continue
                    setting = variant_of(best(samples, "rollouts", home, library))
                    cells += [rate_text(numbers) + (f", {setting}" if setting else "")]
                    cells.append(times_of_most(numbers, own, found))
                rows.append((*cells, *limit_cells(found, 1e6)))
        if rows:
            header = ["environments", "rejeu's on", "rejeu", "Stable-Baselines3", "ratio"]
            header += ["SBX", "ratio"] if algorithm == "PPO" else []
            limit_header = ("limit, us a step", "of it environment", "of it arithmetic", "of the limit")
            tables.append(f"### {algorithm}\n\n{table((*header, *limit_header), rows)}")
            drawn[algorithm], limits[algorithm] = lines, at
    if not tables:
        return ""
    picture = page.parent / "images" / PICTURES["rollouts"]
    pictures.draw_rollouts(drawn, limits, picture, f"{plan.LANDER}: steps a second")
    return f"""## PPO and A2C against the number of environments

Environment steps a second on {plan.LANDER}, 64-64, updates included. PPO: rollouts of {plan.ROLLOUT:,} steps in all, batches
of 64, 5 epochs; A2C: rollouts of 5 steps of each environment. Peers step Gymnasium environments in the process, and are the
same in both rows of a number of environments. SBX has no A2C. Where rejeu's batch is an environment's single observation,
what remains is the cost of calling compiled code once a step.

{(chr(10) * 2).join(tables)}

![Steps a second against the number of environments](images/{PICTURES["rollouts"]})

{share_table(measured)}"""


def rate_of(seconds: ByRound) -> Spread:
    """Returns steps per second from seconds of a step."""
    return spread({turn: 1.0 / value for turn, value in seconds.items()})


def rate_text(seconds: ByRound) -> str:
    """Returns steps per second with their spread."""
    return with_spread({turn: 1.0 / value for turn, value in seconds.items()})


def replay(samples: Sequence[Sample], page: Path) -> str:
    lines: dict[str, dict[int, ByRound]] = {}
    for library, what in (("rejeu", "hindsight"), ("sb3", "hindsight"), ("rejeu", "priority")):
        for row in best(samples, "replay", what, library):
            for size, seconds in row["result"]["seconds_per_batch"].items():
                lines.setdefault(f"{library}, {what}", {}).setdefault(int(size), {})[row["round"]] = seconds
    if not lines:
        return ""
    sizes = sorted({size for by in lines.values() for size in by})
    cells: Callable[[str, int], str] = lambda line, size: with_spread(lines.get(line, {}).get(size, {}), 1e6)  # noqa: E731
    rows = []
    for size in sizes:
        own, peer = (lines.get(f"{library}, hindsight", {}).get(size, {}) for library in ("rejeu", "sb3"))
        row = (cells("rejeu, hindsight", size), cells("sb3, hindsight", size), times(ratio(peer, own)))
        rows.append((f"{size:,}", *row, cells("rejeu, priority", size)))
    drawn = {line: {size: spread(by[size]) for size in sizes if size in by} for line, by in lines.items()}
    pictures.draw_replay(drawn, page.parent / "images" / PICTURES["replay"], "Drawing a batch from a full buffer")
    header = ("transitions", "rejeu, hindsight", "Stable-Baselines3, hindsight", "ratio", "rejeu, by priority")
    return f"""## Drawing batches

Microseconds of a batch of 256 from a buffer that is full of episodes of 100 steps. Hindsight: parking's observations, four
goals in five by the strategy `future`, rewards by highway-env's own `compute_reward` in either library; rejeu's batch is of
NumPy arrays, Stable-Baselines3's of tensors, as each hands them on. By priority: Pendulum's observations, the draw and the
new priorities of the batch before; Stable-Baselines3 has no such buffer.

{table(header, rows)}

![Microseconds a batch against the size of the buffer](images/{PICTURES["replay"]})"""


def memory(samples: Sequence[Sample]) -> str:
    rows = []
    for kind, text in (("parking", "parking-v0: Dict of 3 times 6"), ("pendulum", "Pendulum-v1: Box of 3")):
        for library, name in (("rejeu", kind), ("sb3", kind), ("sb3", f"{kind}, optimize_memory_usage")):
            for row in best(samples, "memory", name, library)[:1]:
                found = row["result"]
                label = NAMES[library] + (" with `optimize_memory_usage`" if "," in name else "")
                per = lambda value, n=found["n"]: "" if value is None else number(value / n)  # noqa: E731
                resident = found["resident"]
                rows.append(
                    (
                        text,
                        label,
                        per(found["necessary"]),
                        per(found["nbytes"]),
                        f"{found['nbytes'] / found['necessary']:.2f}",
                        per(resident),
                        "" if resident is None else f"{resident / found['necessary']:.2f}",
                    )
                )
    if not rows:
        return ""
    header = ("observations", "", "necessary", "arrays", "times", "process grew by", "times")
    return f"""## Memory of a full buffer

Bytes a transition, of a million transitions, every byte of them written. A transition must take its observation once (the
next observation is the next transition's own), its action, its reward and a flag for its end: `4 (observation + action + 1)
+ 1` bytes with numbers of four bytes. For hindsight, rejeu adds how far off the end of the episode is, a number of four bytes;
of its rows one for each episode holds the last observation (here one in 101; they count as transitions);
highway-env declares its observations as float64, which Stable-Baselines3 keeps and rejeu halves.

{table(header, rows)}"""


def startup(samples: Sequence[Sample]) -> str:
    found = {library: best(samples, "startup", "processes", library) for library in plan.LIBRARIES}
    found = {library: rows for library, rows in found.items() if rows}
    if not found:
        return ""
    names = list(dict.fromkeys(name for rows in found.values() for name in rows[0]["result"]["seconds"]))
    labels = {
        "python": "`python -c pass`",
        "import": "import",
        "first update, cold": "SAC on Pendulum-v1 to its first update, compilation cache empty",
        "first update, warm": "the same, started a second time",
        "command line, --help": "`rejeu --help`",
    }

    def cell(rows: Sequence[Sample], name: str) -> str:
        return with_spread(
            by_round([r for r in rows if name in r["result"]["seconds"]], lambda s: s["result"]["seconds"][name])
        )

    rows = [(labels[name], *(cell(of, name) for of in found.values())) for name in names]
    return f"""## Starting

Seconds of whole processes, from the command to its end. SBX gets a compilation cache as well, which it does not turn on by
itself; Stable-Baselines3 compiles nothing.

{table(("", *(NAMES[library] for library in found)), rows)}"""


def files(samples: Sequence[Sample]) -> str:
    found = {library: best(samples, "files", "SAC", library) for library in ("rejeu", "sb3")}
    if not all(found.values()):
        found = {library: rows for library, rows in found.items() if rows}
    if not found:
        return ""
    rows = []
    for name in ("save model", "load model", "save buffer", "load buffer"):
        numbers = {library: by_round(of, lambda s, n=name: s["result"]["seconds"][n]) for library, of in found.items()}
        both = times(ratio(numbers["sb3"], numbers["rejeu"])) if len(numbers) == 2 else ""
        rows.append((f"{name}, ms", *(with_spread(by, 1e3) for by in numbers.values()), both))
    for name in ("model", "buffer"):
        sizes = {
            library: spread(by_round(of, lambda s, n=name: s["result"]["bytes"][n])).median
            for library, of in found.items()
        }
        both = times(Spread(*[sizes["sb3"] / sizes["rejeu"]] * 3)) if len(sizes) == 2 else ""
        rows.append((f"{name}, MB", *(number(size / 1e6) for size in sizes.values()), both))
    return f"""## Files

A model of SAC (256-256) for parking's observations after some updates, and a full buffer of 100,000 of its transitions.
Either library's model file holds networks, targets and optimizers. Loading a model makes an agent ready to act.

{table(("", *(NAMES[library] for library in found), "ratio"), rows)}"""
