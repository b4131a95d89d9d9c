"""Writes ``docs/reliability.md`` from the results of the trials.

python trials/report.py

Every section names the commit, the date and the command that its figures come from. Results that do not say their commit are
older; then the commit that recorded them stands in its place. Trials without results are left out.
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
"""Commands of older results, which do not say them."""
NOT_TESTED = """- **Other systems.** All trials were run on Linux, on local disks: not on macOS or Windows,
on no network file system (NFS, SMB)
  and on no GPU.
- **Other power cuts.** The power cuts are those of one file system, ext4, and of a model of POSIX. A disk that reports data as
  written which it holds in a volatile cache loses them whatever a program does. Log tables (CSV,
  TensorBoard) are not brought to
  disk row by row: a power cut may cost their last seconds, and a resumed run cuts them back to its checkpoint.
- **Damage on purpose.** Checksums are no signatures. Who changes a file and its checksums can make an agent act badly; what is
  tested is that no code of theirs runs and that no time or memory is spent on arrays that the model does not have.
- **Runs of days.** The longest trial took an hour. No run was killed more often than stands above.
- **Environments' own faults.** Environments that leak memory, or end the process that learns (`os._exit`), were not tried.
- **Other machines.** Equal results are promised, and were compared, on one machine with the same versions and number of
  threads."""


def read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def origins(name: str) -> list[tuple[str, str, str]]:
    """Returns commit, date and command of results, several if their parts were recorded apart."""
    found = read(name)
    parts = [found] if "command" in found or "date" in found else [p for p in found.values() if isinstance(p, dict)]
    recorded, day = git("log", "-1", "--format=%h %as", "--", f"trials/results/{name}.json").split() or ("", "")
    dates: dict[tuple[str, str], list[str]] = {}
    for part in parts:
        commit = f"`{part['commit']}`" if "commit" in part else f"recorded in `{recorded}`"
        command = re.sub(r" --only .*", "", part.get("command", COMMANDS.get(name, ""))).replace("SB3_PYTHON", "PATH")
        dates.setdefault((commit, f"`{command}`"), []).append(part.get("date", day))
    return [(commit, " and ".join(sorted({*days})), command) for (commit, command), days in dates.items()]


def origin(name: str) -> str:
    """Returns the same as a line of text."""
    return "; ".join(f"Commit {commit}, {date}, {command}" for commit, date, command in origins(name)) + "."


def table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def yes(value: bool) -> str:
    return "yes" if value else "NO"


def kills() -> str:
    found = read("kill")
    own = found["rejeu"]
    rows = [
        ("kills (SIGKILL)", f"{own['kills']:,}"),
        ("of these with a file half written", f"{own['while_a_file_was_written']:,}"),
        ("checkpoints that did not load afterwards", own["checkpoints_that_did_not_load"]),
        ("environment steps between two checkpoints", own["interval"]),
        ("most steps lost by a kill", own["most_steps_lost"]),
        ("steps lost on average", f"{own['mean_steps_lost']:.0f}"),
        (
            f"after {own['steps_in_all']:,} steps equal, bit for bit, to a run without kills",
            yes(own["equal_to_a_run_without_kills"]),
        ),
    ]
    return f"""## Killed at random moments

SAC on the ball, a checkpoint every {own["interval"]} steps. Each life of the run is a process that resumes from the newest
checkpoint, until `SIGKILL` ends it at a random moment; two lives of three are ended as soon as a file is being written.

{table(("", "rejeu"), rows)}

{peers(found)}{origin("kill")}
"""


def peers(found: dict[str, Any]) -> str:
    """Returns what became of the same with Stable-Baselines3, as it is used."""
    text = ""
    if used := found.get("stable_baselines3_callback"):
        text += f"""Stable-Baselines3 2.9.2 as most people save: SAC on Pendulum with
`CheckpointCallback(save_replay_buffer=True)` every
{used["interval"]} steps, which gives every checkpoint new names and keeps them all. Killed {used["kills"]}
times in the same way:
after {used["newest_checkpoint_not_whole"]} kills the newest checkpoint could not be loaded, after
{used["no_checkpoint_whole"]} none
could; with the newest that could, at most {used["most_steps_lost"]} steps were lost. Which one that is has to be found out by
loading, and what it continues is another run: optimizers and buffer are there, running episodes and random numbers are not.

"""
    if peer := found.get("stable_baselines3"):
        text += f"""The same saving model and replay buffer over and over under the same names, as a run does
that keeps only its newest
model, and without a pause, so that kills often hit a write. Killed {peer["kills"]} times: {peer["models_lost"]} models and
{peer["replay_buffers_lost"]} replay buffers could not be loaded afterwards
({"; ".join(f"`{error}`" for error in peer["errors"]) or "no errors"}). Only a file that is being overwritten can be lost so.

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
    return f"""## Killed, and resumed in a new process

Runs of many kinds, each life of them a process of its own as `rejeu resume` is, killed at random moments. At the end
everything learned, buffers, history, random numbers and best weights are compared bit for bit with a run without kills. The
last two columns say how long the run trains without kills, and how long a resume took at most to replay EnvPool's actions.

{table(head, rows)}

{origin("kill_processes")}
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
        "run", "file operations", "states in which more than an interval is lost", "most steps lost",
        "without fsync of files", "without fsync of folders",
    )  # fmt: skip
    text = f"""## Power cuts

On paper: the file operations of a run with a checkpoint every {paper["interval"]} steps are recorded, and every state is made
that POSIX allows a power cut to leave between any two of them: contents as of the last `fsync`, with nothing, a part, zeros or
all of what was written since, and names as of the folder's last `fsync`, with any of the changes since made
or not. In each the
run is resumed. The last two columns are samples in which the calls of `fsync` are taken not to have happened; they show that
the trial sees a loss where there is one.

{table(head, rows)}
"""
    if "ext4" in found:
        kinds = [("with fsync", found["ext4"]), ("without, for comparison", found["ext4 without fsync"])]
        rows = [
            (
                title,
                one["cuts"],
                one["while_a_file_was_written"],
                one["runs_that_could_not_be_resumed"],
                max(one["most_steps_lost"], 0) or "",
                f"{yes(one['equal_to_a_run_without_cuts'])}, after {one['steps_in_all']:,} steps"
                if "steps_in_all" in one
                else "",
            )
            for title, one in kinds
        ]
        head = (
            "",
            "cuts",
            "while a file was written",
            "could not be resumed",
            "most steps lost",
            "equal to a run without",
        )
        text += f"""
For real: SAC on the ball with a checkpoint every {found["ext4"]["interval"]} steps on an ext4 file system
that is shut down under
the process at a random moment, its journal not flushed, then mounted again.

{table(head, rows)}
"""
    return text + f"\n{origin('power_loss')}\n"


def signals() -> str:
    found = read("signals")
    counted = found["signals"] - len(found["before_rejeu"])
    left = ", ".join(f"{what} {n}" for what, n in found["left"].items())
    return f"""## Ctrl-C and SIGTERM

`rejeu train` got a signal, or two in a row, at {found["signals"]} random moments of its whole life: {
        ", ".join(f"{phase} {n}" for phase, n in found["by_phase"].items())
    }. Of the {counted} after Python had begun to import rejeu,
{found["right_status"]} ended with the right exit status (130, 143) and {
        found["one_line_at_most"]
    } said one line at most. What was left:
{left}. The longest end took {found["most_seconds_until_the_end"]:.1f} s.

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
    text = f"""## Resumed

{found["steps"]:,} steps, stopped at a random one and resumed, against the same without a break: parameters, optimizers,
replay buffer or rollout, episodes, counters and rows of statistics. {equal} of {len(exact)} are equal, bit
for bit. Both halves run
in one process, with one or two environments and networks of 32-32.

{table(("", *env_ids), rows)}

Where the state of the environment cannot be saved, what was learned and the buffer must be those of the moment of the break,
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
the end). It does not promise exact resumption.

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

What is refused, by our own error alone, within bounded time and memory: files cut short at every byte; files with one bit
flipped, for every bit; the corpus of `tests/hostile_files.py` (headers that lie about sizes, overlapping and out-of-range
places, names given twice, nesting without end, hyper-parameters that are not numbers, unknown classes, spaces of another
agent, values of checkpoints ...); and sparse files that claim 6 GiB (the longest took {longest:.2f} s). What
is not refused was read:
files of schema 1 have no checksums, and some values of a checkpoint may be others; such a run was then trained for
some steps. Cuts and flips go through the reader that
all loaders share; the corpus goes through the loaders.

{table(("file", "cut short", "one bit flipped", "corpus", "sparse"), rows)}
"""
    for key, value in code:
        text += f"\n{key}: {said(value)}.\n"
    return f"{text}\n{origin('hostile')}\n"


def refused_of(counts: list[dict[str, Any]]) -> str:
    """Returns how many of how many files were refused, and what was raised instead, if anything was."""
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
    return f"""## Fuzzed

The loaders under a coverage-guided fuzzer (atheris) whose mutations keep lengths and checksums right part of the time:
{executions:,} executions in {hours:.1f} hours, {share:.0%} of them of the quickest loader, `{most}`. A
finding is anything but our own
error, a load of more than a bounded time, or one that changes what it should not. `run` and `rows` are the two kinds of file
that a checkpoint of a whole run has: what is resumed from them must train on and save checkpoints, and these must be read
again, or that is a finding as well.

{table(("loader", "executions", "minutes", "branches reached", "findings"), rows)}

{origin("fuzz")}
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
    return f"""## Environments of every kind

PPO and SAC trained for 240 steps in environments of every kind of `trials/environment_kinds.py`: spaces of all kinds, episodes
that end in all ways, one fault each in what they answer, and such as raise, exit, hang or are killed. What must come of a run
is known beforehand: all its steps and finite weights; our own error, which names the environment; the environment's own; or
a refusal when the agent is made. After an error there must be a checkpoint of that step, which loads with finite weights
(not after `sys.exit`, Ctrl-C and `NonFiniteError`, which leave the last one on schedule), and no worker process may be left.

{table(("where", "kinds", "runs", "as they must be", "outcomes", "longest, seconds"), rows)}

{faults}{again["workers started again"]} workers that killed themselves were started again: {again["steps taken"]} of
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
    return f"""## An hour with everything on

{found["minutes"]:.0f} minutes{suspended}: {found["steps"]:,} steps of SAC with hindsight on parking-v0, {
        found["evaluations"]
    }
evaluations, {found["films"]} films, checkpoints every minute, {
        found["episodes"]:,} episodes. Between the first tenth after the
warm-up (a quarter of the time) and the last tenth:

{table(("", "after the warm-up", "at the end"), rows)}

Memory grew by {found["growth_percent"]:.2f} %, {
        found["mib_per_hour"]:.1f} MiB an hour. Open files before and after the run: {before} and {
        after
    }; processes left: {found["processes_left"]}.

![Memory, files, threads and processes against time](images/soak.png)

{origin("soak")}
"""


def wrapped(page: str) -> str:
    """Returns a page whose paragraphs and list items are filled; tables, headings and pictures stay."""
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
    "power_loss": power,
    "signals": signals,
    "resume": resumed,
    "hostile": hostile,
    "fuzz": fuzzed,
    "environments": environments,
    "soak": soaked,
}
"""The trials in the order of the page, by the name of their results."""


def main() -> None:
    found = [name for name in SECTIONS if (RESULTS / f"{name}.json").exists()]
    rows = [(f"`{name}`", *one) for name in found for one in origins(name)]
    sections = "\n".join(SECTIONS[name]() for name in found)
    page = f"""# Reliability

What was tried to break runs and files, how often, and what came out. This page is written by `trials/report.py` from the
results under `trials/results`. Each trial was run on Linux, on the commit and with the command that stand below it; PATH is an
interpreter that has Stable-Baselines3 2.9.2, for the comparisons. A figure says what was measured on that commit, not on later
ones.

{table(("trial", "commit", "date", "command"), rows)}

How runs resume is described under [resume](resume.md), the files under [file format](file-format.md).

{sections}
## What was not tested

{NOT_TESTED}
"""
    PAGE.write_text(wrapped(page), encoding="utf-8")


if __name__ == "__main__":
    main()
