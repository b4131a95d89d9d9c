"""Writes ``docs/reliability.md`` from the results of the trials.

python trials/report.py

Every section names the commit, the date and the command of its results. Older results do not contain their commit. For
these, the commit that recorded them is shown. Trials without results are omitted.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from provenance import git

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
COMMANDS = {
    "kill": "python trials/kill.py --kills 200 --sb3-python PATH",
    "resume": "python trials/resume.py --sb3-python PATH",
    "hostile": "python trials/hostile.py --sb3-python PATH",
    "fuzz": "python trials/fuzz.py --seconds 300 (600 for run and rows)",
}
"""Commands of older results, which do not contain them."""
PARTS = {"sweep_kills": ("sweep_kills", "sweep_kills_ray")}
"""Sections that show several files of results."""
NOT_TESTED = """- **Other systems.** All trials were run on Linux with local disks: not on macOS or Windows, on
network file
  systems or on a GPU.
- **Other power cuts.** Power cuts were tested on ext4 and on a model of POSIX. A disk that reports data as written
while it is in a
  volatile cache loses it. Rows of log tables (CSV, TensorBoard) are not synced: a power cut may lose the last
  seconds of them.
- **Deliberate changes.** Checksums are not signatures. Someone who changes a file and its checksums can make an
agent act badly.
  Tested is that loading executes no code and needs bounded time and memory.
- **Searches.** Processes of `rejeu tune` and `rejeu pbt` are killed in the test suite, not at hundreds of random
moments.
- **Several machines.** The nodes of the Ray cluster were processes of one machine.
- **Runs of days.** The longest trial took an hour.
- **Faults of environments.** Environments that leak memory or end the main process (`os._exit`) were not tested.
- **Other machines.** Equal results were compared on one machine, with the same versions and number of threads."""


def files(section: str) -> list[str]:
    """Returns the names of the results that a section shows and that exist."""
    return [name for name in PARTS.get(section, (section,)) if (RESULTS / f"{name}.json").exists()]


def read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def origins(name: str) -> list[tuple[str, str, str]]:
    """Returns the commit, date and command of results; several if parts were recorded separately."""
    found = read(name)
    nested = [part for part in found.values() if isinstance(part, dict)]
    is_one = "command" in found or "date" in found
    parts = [found, *(part for part in nested if "recorded" in part)] if is_one else nested
    recorded, day = git("log", "-1", "--format=%h %as", "--", f"trials/results/{name}.json").split() or ("", "")
    dates: dict[tuple[str, str], list[str]] = {}
    for part in parts:
        commit = f"`{part['commit']}`" if "commit" in part else f"recorded in `{part.get('recorded', recorded)}`"
        command = re.sub(r' --only ".*', "", part.get("command", COMMANDS.get(name, ""))).replace("SB3_PYTHON", "PATH")
        dates.setdefault((commit, f"`{command}`"), []).append(part.get("date", day))
    return [(commit, " and ".join(sorted({*days})), command) for (commit, command), days in dates.items()]


def origin(name: str) -> str:
    """Returns the origin of results as text."""
    return "; ".join(f"Commit {commit}, {date}, {command}" for commit, date, command in origins(name)) + "."


def table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def yes_or_no(value: bool) -> str:
    return "yes" if value else "NO"


def kills() -> str:
    found = read("kill")
    own = found["rejeu"]
    rows = [
        ("kills (SIGKILL)", f"{own['kills']:,}"),
        ("of these during a write", f"{own['while_a_file_was_written']:,}"),
        ("checkpoints that could not be loaded", own["checkpoints_that_did_not_load"]),
        ("environment steps between checkpoints", own["interval"]),
        ("maximum number of lost steps", own["most_steps_lost"]),
        ("mean number of lost steps", f"{own['mean_steps_lost']:.0f}"),
        (
            f"after {own['steps_in_all']:,} steps bit-equal to a run without kills",
            yes_or_no(own["equal_to_a_run_without_kills"]),
        ),
    ]
    return f"""## SIGKILL at random moments

SAC on Ball-v0, a checkpoint every {own["interval"]} steps. Each process resumes from the newest checkpoint until
`SIGKILL` ends it at
a random moment. Two of three processes are killed while a file is being written.

{table(("", "rejeu"), rows)}

{peers(found)}{origin("kill")}
"""


def peers(found: dict[str, Any]) -> str:
    """Returns the results of the same trial with Stable-Baselines3."""
    text = ""
    if used := found.get("stable_baselines3_callback"):
        text += f"""Stable-Baselines3 2.9.2 as it is usually used: SAC on Pendulum with
`CheckpointCallback(save_replay_buffer=True)` every
{used["interval"]} steps, which keeps all checkpoints. Killed {used["kills"]}
times:
after {used["newest_checkpoint_not_whole"]} kills the newest checkpoint could not be loaded, after
{used["no_checkpoint_whole"]} none
could; with the newest that could, at most {used["most_steps_lost"]} steps were lost. The resumed run differs:
checkpoints contain
optimizers and buffer, but neither running episodes nor random state.

"""
    if peer := found.get("stable_baselines3"):
        text += f"""The same with Stable-Baselines3 2.9.2, by a program that saves model and replay buffer
repeatedly under the same names, without a pause, so that kills often hit a write.
Killed {peer["kills"]} times: {peer["models_lost"]} models and
{peer["replay_buffers_lost"]} replay buffers could not be loaded afterwards
({"; ".join(f"`{error}`" for error in peer["errors"]) or "no errors"}). Only a file that is being overwritten can be lost.

"""
    return text


def processes() -> str:
    found = read("kill_processes")
    rows = [
        (
            name,
            f"{one['env_id']}, {one['n_envs']} x {one['backend']}",
            one["kills"],
            one["resumed_after_step_0"],
            f"{one['arrays'] - len(one['arrays_that_differ'])} of {one['arrays']}",
            f"{one['seconds_of_training_without_kills']:.0f} s",
            f"{max(one['seconds_of_replaying'], default=0.0):.1f} s",
        )
        for name, one in found.items()
    ]
    head = ("run", "environments", "kills", "resumed after step 0", "arrays equal", "training", "longest replay")
    return f"""## SIGKILL, and resuming in a new process

Runs of many kinds are killed at random moments and resumed in a new process, as by `rejeu resume`. At the end
learned state,
buffers, history, random state and best weights are compared bit for bit with a run without kills. The last two
columns are the
training time without kills and the longest time to replay EnvPool's actions.

{table(head, rows)}

{origin("kill_processes")}
"""


def sweeps() -> str:
    rows = []
    for found in map(read, files("sweep_kills")):
        for where, title in (("local", "processes"), ("ray", "Ray, two nodes")):
            if one := found.get(where):
                kinds = {key.removeprefix("kills_of_a_"): n for key, n in one.items() if key.startswith("kills_of_a_")}
                rows.append(
                    (
                        title,
                        f"{one['kills']} ({', '.join(f'{n} of a {kind}' for kind, n in kinds.items())})",
                        f"{one['sweeps'] - one['sweeps_that_failed']} of {one['sweeps']}",
                        f"{one['runs'] - len(one['models_that_differ'])} of {one['runs']}",
                        f"{one['most_seconds_of_training_lost']:.1f} of {found['checkpoint_interval_seconds']:.0f} s",
                        f"{one['most_seconds_until_no_process_was_left']:.1f} s",
                    )
                )
    head = (
        "sweep", "SIGKILLs", "sweeps completed", "models equal", "most training lost, of the interval",
        "until no process was left",
    )  # fmt: skip
    return f"""## SIGKILL of runs, workers, nodes and sweeps

Sweeps of eight runs, two at a time, are disturbed by `SIGKILL` at random moments: of runs, of the process `rejeu
sweep`, of Ray workers, and of all processes of a Ray node. The final models are compared bit for bit with those of an
undisturbed sweep. The loss is the training time since the newest checkpoint of a run that was killed.

{table(head, rows)}

{" ".join(map(origin, files("sweep_kills")))}
"""


def power() -> str:
    found = read("power_loss")
    paper = found["on paper"]
    cells = lambda one: f"{one['lost']:,} of {one['states']:,}"  # noqa: E731
    rows = [
        (
            name,
            one["operations"],
            cells(one),
            one["most steps lost"],
            cells(one["without fsync of files"]),
            cells(one["without fsync of folders"]),
        )
        for name, one in paper.items()
        if name != "interval"
    ]
    head = (
        "run", "file operations", "states that lose more than an interval", "maximum of lost steps",
        "without fsync of files", "without fsync of folders",
    )  # fmt: skip
    text = f"""## Power cuts

**Simulated.** The file operations of a run with a checkpoint every {paper["interval"]} steps are recorded. From them
every state is
generated that POSIX allows after a power cut: file contents as of the last `fsync` with nothing, a part, zeros or
all of the later
writes, and names as of the last `fsync` of the folder with any of the later changes. The run is resumed from each
state. The last two
columns ignore calls of `fsync`, and show that the trial detects losses.

{table(head, rows)}
"""
    if "ext4" in found:
        kinds = [("with `fsync`", found["ext4"]), ("without, for comparison", found["ext4 without fsync"])]
        rows = [
            (
                title,
                one["cuts"],
                one["while_a_file_was_written"],
                one["runs_that_could_not_be_resumed"],
                max(one["most_steps_lost"], 0) or "",
                f"{yes_or_no(one['equal_to_a_run_without_cuts'])}, after {one['steps_in_all']:,} steps"
                if "steps_in_all" in one
                else "",
            )
            for title, one in kinds
        ]
        head = (
            "",
            "cuts",
            "during a write",
            "not resumable",
            "maximum of lost steps",
            "bit-equal to a run without cuts",
        )
        text += f"""
**Real.** SAC on Ball-v0 with a checkpoint every {found["ext4"]["interval"]} steps on an ext4 file system that is
shut down at a
random moment without flushing its journal, and mounted again.

{table(head, rows)}
"""
    return text + f"\n{origin('power_loss')}\n"


def signals() -> str:
    found = read("signals")
    counted = found["signals"] - len(found["before_rejeu"])
    left = ", ".join(f"{what} {n}" for what, n in found["left"].items())
    status = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}
    kinds = ", ".join(f"{value} for {name}" for name, value in status.items() if name in found)
    return f"""## Signals

`rejeu train` received one or two signals (expected exit status: {kinds}) at {found["signals"]} random moments: {
        ", ".join(f"{phase} {n}" for phase, n in found["by_phase"].items())
    }. Of the {counted} runs in which the import of rejeu had begun,
{found["right_status"]} ended with the right exit status and {
        found["one_line_at_most"]
    } printed at most one line. Result:
{left}. The longest shutdown took {found["most_seconds_until_the_end"]:.1f} s.

{origin("signals")}
"""


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
    text = f"""## Resuming

Runs of {found["steps"]:,} steps are stopped at a random step and resumed, and compared with uninterrupted ones:
parameters,
optimizers, replay buffer or rollout, episodes, counters and metrics. {equal} of {len(exact)} are bit-equal. Both
parts run in one
process, with one or two environments and 32-32 networks.

{table(("", *env_ids), rows)}

If the state of the environment cannot be saved, learned state and buffer must be those of the interruption, and new
episodes begin.
This holds for {kept} of {len(others)} ({where}).
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
        head = (
            "Stable-Baselines3",
            "environment",
            "difference of two uninterrupted runs",
            "difference of the resumed run",
        )
        text += f"""
The same with Stable-Baselines3 2.9.2, which does not promise exact resume (model and replay buffer saved and loaded;
largest
difference of a weight at the end).

{table(head, rows)}
"""
    return f"{text}\n{origin('resume')}\n"


def hostile() -> str:
    found = read("hostile")
    rows = []
    for kind, parts in found.items():
        if not isinstance(parts, dict) or "bytes" not in parts:
            continue
        counts = list(parts.get("hostile", {}).values())
        cells = [
            refused_of([parts[key]] if key in parts else [])
            for key in ("cut short at every byte", "every bit flipped", "six GiB in a hole")
        ]
        rows.append((kind, cells[0], cells[1], refused_of(counts), cells[2]))
    holes = [
        parts["six GiB in a hole"]
        for parts in found.values()
        if isinstance(parts, dict) and "six GiB in a hole" in parts
    ]
    longest = max((part["longest seconds"] for part in holes), default=0.0)
    code = [(key, value) for key, value in found.items() if "code" in key]
    text = f"""## Hostile and damaged files

Number of files that are refused by a `CheckpointError` within bounded time and memory: files truncated at every
byte; files with one
bit flipped, for every bit; the corpus of `tests/hostile_files.py` (wrong sizes, overlapping and out-of-range
offsets, duplicate names,
deep nesting, invalid hyperparameters, unknown classes, other spaces, invalid values of checkpoints); and sparse
files that claim 6 GiB
(at most {longest:.2f} s). The other files were read:
files of schema 1 have no checksums, and some changed values of a checkpoint are
valid; such a run was trained for some steps. Truncated and flipped files go through the reader that all loaders
share, the corpus
through the loaders.

{table(("file", "truncated", "one bit flipped", "corpus", "sparse"), rows)}
"""
    for key, value in code:
        text += f"\n{key}: {said(value)}.\n"
    return f"{text}\n{origin('hostile')}\n"


def refused_of(counts: list[dict[str, Any]]) -> str:
    """Returns the number of rejected files, and other outcomes."""
    outcomes: dict[str, int] = {}
    for count in counts:
        for outcome, n in count.items():
            if outcome != "longest seconds":
                outcomes[outcome] = outcomes.get(outcome, 0) + n
    if not outcomes:
        return ""
    others = "".join(f"; {n} {outcome}" for outcome, n in outcomes.items() if outcome not in ("refused", "read"))
    return f"{outcomes.get('refused', 0):,} of {sum(outcomes.values()):,}{others}"


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
    most = max(found, key=lambda target: found[target]["executions"])
    share = found[most]["executions"] / executions
    return f"""## Fuzzing

The loaders were run by a coverage-guided fuzzer (atheris), whose mutations sometimes keep lengths and checksums valid:
{executions:,} executions in {hours:.1f} hours, {share:.0%} of them of the fastest loader, `{most}`. A finding is
another exception than
`CheckpointError`, a load that takes too long, or one that changes an existing object. For `run` and `rows`, the
files of a checkpoint,
the resumed run must also train and save checkpoints that can be read.

{table(("loader", "executions", "minutes", "branches", "findings"), rows)}

{origin("fuzz")}
"""


def transitions() -> str:
    found = read("transitions")
    return f"""## Replayed transitions

Every transition that a replay buffer returns is compared with a model in plain Python that keeps whole episodes, with
one and several environments, n-step returns, priorities, hindsight and stacked frames: {
        found["transitions"]:,} transitions in {len(found["cases"])} cases, of which {
        found["relabeled"]:,} were relabeled and {found["terminal"]:,} were terminal. Differences: {found["differ"]}.

{origin("transitions")}
"""


def environments() -> str:
    found = read("environments")
    parts = ("in this process", "in worker processes")
    rows = [
        (
            where,
            found[where]["kinds"],
            found[where]["runs"],
            found[where]["as they must be"],
            ", ".join(f"{outcome}: {n}" for outcome, n in found[where]["outcomes"].items()),
            found[where]["longest seconds"],
        )
        for where in parts
    ]
    wrong = [one for where in parts for one in found[where]["not as they must be"]]
    faults = "".join(f"- {one['kind']} ({one.get('algorithm', 'SAC')}): {'; '.join(one['wrong'])}\n" for one in wrong)
    again = found["restarted workers"]
    return f"""## Environments

PPO and SAC are trained for 240 steps in the environments of `trials/environment_kinds.py`: all kinds of spaces and
episode ends,
invalid return values, and environments that raise, exit, hang or are killed. The expected outcome of each is known:
all steps and
finite weights, an error of rejeu that names the environment, an error of the environment, or a refusal when the
agent is made. After
an error there must be a checkpoint of that step with finite weights (after `sys.exit`, Ctrl-C and `NonFiniteError`
the last scheduled
one), and no worker process.

{table(("where", "kinds", "runs", "as expected", "outcomes", "longest, seconds"), rows)}

{faults}{again["workers started again"]} workers that killed themselves were restarted: {again["steps taken"]} of
{again["steps asked for"]} steps were taken.

{origin("environments")}
"""


def soaked() -> str:
    found = read("soak")
    minutes = found["minutes_suspended"]
    suspended = f", {minutes:.0f} of which the process was suspended for other work on the machine" if minutes else ""
    rows = [
        ("resident memory, MiB", f"{found['mib_after_warm_up']:.1f}", f"{found['mib_at_the_end']:.1f}"),
        ("open files", f"{found['files_after_warm_up']:.1f}", f"{found['files_at_the_end']:.1f}"),
        ("threads", f"{found['threads_after_warm_up']:.1f}", f"{found['threads_at_the_end']:.1f}"),
    ]
    before, after = found["files_before_and_after"]
    return f"""## One hour with all features

{found["minutes"]:.0f} minutes{suspended}: {found["steps"]:,} steps of SAC with HER on parking-v0, {
        found["evaluations"]
    }
evaluations, {found["films"]} videos, checkpoints every minute, {
        found["episodes"]:,} episodes. Between the first tenth after the
warm-up (a quarter of the time) and the last tenth:

{table(("", "after the warm-up", "at the end"), rows)}

Memory increased by {found["growth_percent"]:.2f} %, {
        found["mib_per_hour"]:.1f} MiB an hour. Open files before and after the run: {before} and {
        after
    }; remaining processes: {found["processes_left"]}.

![Memory, files, threads and processes against time](images/soak.png)

{origin("soak")}
"""


def wrapped(page: str) -> str:
    """Returns a page with its paragraphs and list items wrapped."""
    blocks = []
    for block in re.split(r"\n{2,}", page.strip()):
        if block.startswith("- "):
            items = block[2:].split("\n- ")
            blocks.append("\n".join(fill(f"- {item}", subsequent_indent="  ") for item in items))
        else:
            blocks.append(block if block[0] in "|#!" else fill(block))
    return "\n\n".join(blocks) + "\n"


def fill(text: str, **settings: str) -> str:
    return textwrap.fill(" ".join(text.split()), 120, break_long_words=False, break_on_hyphens=False, **settings)


SECTIONS: dict[str, Callable[[], str]] = {
    "kill": kills,
    "kill_processes": processes,
    "sweep_kills": sweeps,
    "power_loss": power,
    "signals": signals,
    "resume": resumed,
    "hostile": hostile,
    "fuzz": fuzzed,
    "environments": environments,
    "transitions": transitions,
    "soak": soaked,
}
"""The trials in the order of the page, by the names of their results."""


def main() -> None:
    found = [name for name in SECTIONS if files(name)]
    rows = [(f"`{file}`", *one) for name in found for file in files(name) for one in origins(file)]
    sections = "\n".join(SECTIONS[name]() for name in found)
    page = f"""# Reliability

Tests of crashes, power loss, invalid files and long runs, which are too slow for the test suite. This page is
written by
`trials/report.py` from the data in `trials/results`. Each trial names its commit and command, to which its figures
apply; PATH is an
interpreter with Stable-Baselines3 2.9.2 for comparisons. All were run on Linux.

{table(("trial", "commit", "date", "command"), rows)}

See also [resuming runs](resume.md) and [file format](file-format.md).

{sections}
## What was not tested

{NOT_TESTED}
"""
    PAGE.write_text(wrapped(page), encoding="utf-8")


if __name__ == "__main__":
    main()
