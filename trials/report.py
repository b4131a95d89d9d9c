"""Writes ``docs/reliability.md`` from the results of the trials.

python trials/report.py
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
COMMANDS = """python trials/kill.py --kills 200 --sb3-python PATH
python trials/resume.py --sb3-python PATH
python trials/signals.py --signals 48
python trials/hostile.py --sb3-python PATH
python trials/fuzz.py --seconds 300
python trials/fuzz.py --seconds 600 --target run
python trials/fuzz.py --seconds 600 --target rows
python trials/soak.py --minutes 60
python trials/transitions.py
python trials/report.py"""


def read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def kills() -> str:
    found = read("kill")
    own, peer = found["rejeu"], found.get("stable_baselines3")
    rows = [
        ("kills (SIGKILL)", f"{own['kills']:,}"),
        ("of these with a file half written", f"{own['while_a_file_was_written']:,}"),
        ("checkpoints that did not load afterwards", own["checkpoints_that_did_not_load"]),
        ("environment steps between two checkpoints", own["interval"]),
        ("most steps lost by a kill", own["most_steps_lost"]),
        ("steps lost on average", f"{own['mean_steps_lost']:.0f}"),
        (
            f"after {own['steps_in_all']:,} steps equal, bit for bit, to a run without kills",
            "yes" if own["equal_to_a_run_without_kills"] else "NO",
        ),
    ]
    text = f"""## Killed at random moments

SAC on the ball, a checkpoint every {own["interval"]} steps. Each life of the run is a process that goes on from the newest
checkpoint, until `SIGKILL` ends it at a random moment; two lives out of three are ended as soon as a file is being written.

{table(("", "rejeu"), rows)}
"""
    if peer:
        text += f"""
Stable-Baselines3 2.9.2, saving model and replay buffer over and over under the same names, as a run that keeps its newest
model does, killed {peer["kills"]} times: {peer["models_lost"]} models and {peer["replay_buffers_lost"]} replay buffers could
not be loaded afterwards ({"; ".join(f"`{error}`" for error in peer["errors"]) or "no errors"}).
"""
    return text


def resumed() -> str:
    found = read("resume")
    cases = found["cases"]
    exact, others = [c for c in cases if c["exact"]], [c for c in cases if not c["exact"]]
    env_ids = list(dict.fromkeys(c["env"] for c in exact))
    rows = []
    for algorithm in dict.fromkeys(c["algorithm"] for c in exact):
        said = {c["env"]: "equal" if c["equal_at_the_end"] else "DIFFERS" for c in exact if c["algorithm"] == algorithm}
        rows.append((algorithm, *(said.get(env_id, "") for env_id in env_ids)))
    equal = sum(c["equal_at_the_end"] for c in exact)
    kept = sum(c["equal_at_the_break"] for c in others)
    where = ", ".join(f"{c['env']} ({c['backend']}, {c['algorithm']})" for c in others)
    text = f"""## Resumed

{found["steps"]:,} steps, cut off at a random one and gone on with, against the same without a break: parameters, optimizers,
replay buffer or rollout, episodes, counters and rows of statistics. {equal} of {len(exact)} are equal, bit for bit.

{table(("", *env_ids), rows)}

Where the state of the environment cannot be carried, what was learnt and the buffer must be those of the moment of the break,
and new episodes begin: {kept} of {len(others)} are so ({where}).
"""
    if peer := found.get("stable_baselines3"):
        rows = [
            (
                one["algorithm"],
                one["env"],
                f"{one['difference_of_two_unbroken_runs']:.3g}",
                f"{one['difference_of_the_resumed_run']:.3g}",
            )
            for one in peer
        ]
        head = ("Stable-Baselines3", "environment", "two unbroken runs differ by", "the resumed run differs by")
        text += f"""
The same with what Stable-Baselines3 2.9.2 offers (model and replay buffer saved and loaded; largest difference of a weight at
the end):

{table(head, rows)}
"""
    return text


def signaled() -> str:
    found = read("signals")
    phases = found["by_phase"]
    early = found["before_rejeu"]
    counted = found["signals"] - len(early)
    rows = [(name, n) for name, n in phases.items()]
    resumed = found["left"].get("resumed", 0)
    folders = counted - found["left"].get("no folder", 0)
    return f"""## Ctrl-C and SIGTERM

`{found["command"]}`, {found["date"]}, commit {found["commit"]}. `rejeu train` (SAC on the ball, {
        found["seconds_of_a_run"]:.0f} s on a busy
machine) got a signal at a random moment of its life, {found["sent_twice"]} times two in a row:

{table(("sent during", "signals"), rows)}

{len(early)} came before Python had begun to import rejeu, and ended it in Python's own way. Of the other {counted} ({
        found["SIGINT"]
    } Ctrl-C, {found["SIGTERM"]} SIGTERM):

- exit status 130 or 143 as it should be: {found["right_status"]} of {counted};
- one line on standard error at most, and no traceback: {found["one_line_at_most"]} of {counted};
- both models load, and the run resumes from its checkpoint and trains on: {resumed} of {folders} that had begun;
- ended after {found["most_seconds_until_the_end"]:.0f} s at most.
"""


def hostile() -> str:
    found = read("hostile")
    rows = []
    for kind, parts in found.items():
        if not isinstance(parts, dict) or "cut short at every byte" not in parts:
            continue
        corpus = parts.get("hostile", {})
        refused = sum(part.get("refused", 0) for part in corpus.values())
        harmless = sum(part.get("read", 0) for part in corpus.values())
        cut, flipped = parts["cut short at every byte"], parts["every bit flipped"]
        rows.append(
            (
                kind,
                f"{cut['refused']:,} of {cut['refused'] + cut.get('read', 0):,}",
                f"{flipped['refused']:,} of {flipped['refused'] + flipped.get('read', 0):,}",
                f"{refused:,} of {refused + harmless:,}" if corpus else "",
            )
        )
    code = [(key, value) for key, value in found.items() if "code" in key or "stable" in key.lower()]
    text = f"""## Hostile and damaged files

What is refused, by our own error alone, within bounded time and memory: files cut short at every byte, files with one bit
flipped, for every bit, and the corpus of `tests/hostile_files.py` (headers that lie about sizes, overlapping and
out-of-range places, names given twice, nesting without end, hyper-parameters that are no numbers, unknown classes ...).
Files of schema 1 had no checksums yet.

{table(("file", "cut short", "one bit flipped", "corpus"), rows)}
"""
    for key, value in code:
        text += f"\n{key}: {said(value)}.\n"
    return text


def said(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {said(part)}" for key, part in value.items())
    return {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)


def fuzzed() -> str:
    found = read("fuzz")
    rows = [
        (target, f"{one['executions']:,}", f"{one['seconds'] / 60:.0f}", one["coverage"], one["findings"])
        for target, one in found.items()
    ]
    hours = sum(one["seconds"] for one in found.values()) / 3600
    executions = sum(one["executions"] for one in found.values())
    return f"""## Fuzzed

The loaders under a coverage-guided fuzzer (atheris) whose mutations keep lengths and checksums right part of the time:
{executions:,} executions in {hours:.1f} hours. A finding is anything but our own error, a load of more than a bounded time, or
one that changes what it should not. `run` and `rows` are the two kinds of file that a checkpoint of a whole run has: what is
resumed from them must learn on and save checkpoints, and these must be read again, or that is a finding as well.

{table(("loader", "executions", "minutes", "branches reached", "findings"), rows)}
"""


def soaked() -> str:
    found = read("soak")
    minutes = found["minutes_suspended"]
    suspended = f", {minutes:.0f} of which the process was suspended for other work on the machine" if minutes else ""
    return f"""## An hour with everything on

{found["minutes"]:.0f} minutes{suspended}: {found["steps"]:,} steps of SAC with hindsight on parking-v0, {
        found["evaluations"]
    } evaluations, {found["films"]} films,
checkpoints every minute, {
        found["episodes"]:,} episodes. Between the first tenth after the warm-up (a quarter of the time) and the
last tenth:

{
        table(
            ("", "after the warm-up", "at the end"),
            [
                ("resident memory, MiB", f"{found['mib_after_warm_up']:.1f}", f"{found['mib_at_the_end']:.1f}"),
                ("open files", f"{found['files_after_warm_up']:.1f}", f"{found['files_at_the_end']:.1f}"),
                ("threads", f"{found['threads_after_warm_up']:.1f}", f"{found['threads_at_the_end']:.1f}"),
            ],
        )
    }

Memory grew by {found["growth_percent"]:.2f} %, {
        found["mib_per_hour"]:.1f} MiB an hour. Open files before and after the run:
{found["files_before_and_after"][0]} and {found["files_before_and_after"][1]}; processes left: {
        found["processes_left"]
    }.

![Memory, files, threads and processes against time](images/soak.png)
"""


def replayed() -> str:
    found = read("transitions")
    kinds: dict[str, list[Any]] = {"steps": [], "goals": [], "frames": []}
    for case in found["cases"]:
        kinds["frames" if case["frames"] else "steps" if case["strategy"] is None else "goals"].append(case)
    names = {
        "steps": "uniform and prioritized, 1 and 3 steps",
        "goals": "the same with hindsight: future, final, episode, random, with and without `compute_terminated`",
        "frames": "uniform and prioritized, 1 and 3 steps, stacks of 4 frames",
    }
    rows = [
        (
            names[kind],
            len(cases),
            *(f"{sum(case[key] for case in cases):,}" for key in ("transitions", "terminal", "differ")),
        )
        for kind, cases in kinds.items()
    ]
    wrapped = [case["times_wrapped"] for case in found["cases"]]
    return f"""## Replayed transitions

Transitions drawn from replay buffers in use, each compared with what the environments wrote down: observation, action, n-step
reward, discount, next observation, goal, priority, importance weight, and how often each step is drawn. 1 and 3 environments,
ends by terminal states and time limits, calls of `learn` that end within an episode, buffers that were filled
{min(wrapped):g} to {max(wrapped):g} times over. {found["transitions"]:,} transitions, {found["differ"]} differ (commit
{found["commit"]}, {found["date"]}).

{table(("replay", "cases", "transitions", "into a terminal state", "differ"), rows)}
"""


def main() -> None:
    parts = [kills(), resumed(), signaled(), hostile(), fuzzed(), soaked(), replayed()]
    PAGE.write_text(
        f"""# Reliability

What was tried to break runs and files, and to find wrong transitions, how often, and what came out. This page is written by
`trials/report.py` from the results under `trials/results`; the commands, on Linux, with an interpreter that has
Stable-Baselines3 2.9.2 for the comparisons:

```
{COMMANDS}
```

How runs go on is described under [going on](resume.md), the files under [files](files.md).

{"".join(part + chr(10) for part in parts).rstrip()}
""",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
