"""The page ``docs/performance.md``, written from the file of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bench import machine, plan
from benchmarks.bench.pictures import NAMES, number
from benchmarks.bench.sections import files, memory, parking, per_step, replay, rollouts, startup
from benchmarks.bench.summary import Sample, best, disturbed, drift, peak, step_seconds
from benchmarks.bench.text import table, with_spread

DID_NOT_HELP = (
    "**A scan around a single gradient step** costs 20 to 30 us, so a turn with one update calls it without one.",
    "**Two threads for XLA** help only above batches of 256 through 256-256; a step of DDPG with batches of 128 through "
    "128-128 took half as long again with two.",
    "**Unrolled scans** compile much longer and run the same.",
    "**bfloat16** is slower on a CPU.",
    "**Both critics in one batched matrix product** were not faster than two products.",
    "**An actor in NumPy** for tiny networks is not bit-equal to XLA's, and was dropped.",
    "**Computing in the loop's own thread**, JAX's asynchronous dispatch switched off, made no difference that could be told.",
    "**Transposing block by block** for the gradients of weights changed nothing.",
    "**XLA's matrix products without its library YNN** take the same time at these sizes.",
    "**Less optimisation** (level 1) compiles an update in half the time and runs it a third slower, as does XLA's older "
    "way of writing kernels; only what runs once is compiled so.",
    "**Adam with one division an element** instead of three saves 0 to 2 % of an update.",
    "**One vector for PPO's weights, gradients and moments** leaves 99 kernels of 151 in a minibatch, and saves 5 % of it, "
    "which is 1 % of a step; it was not worth another shape of the same state.",
)
HELPED = (
    "**The state packed into few vectors** makes dispatch 2 to 3 times faster than a tree of arrays.",
    "**Donating the packed state** saves a copy of it.",
    "**One vector for all that the host sends**, and fewer NumPy calls in storing and drawing (numbers in place of arrays of "
    "one element, kinds of rows read once), save 15 us of a step of SAC while caches are warm, and a sixth in the loop.",
    "**Rows of the replay buffer sent whole**: a batch's columns are fields of the records that were drawn, and copying the "
    "records is several times faster than picking each column out of them; a batch of 256 with hindsight is packed in half "
    "the time, and drawn in five sixths of it with fewer NumPy calls.",
    "**Gradients of weights without a transposed left side**: XLA's fast products take none, so the transposition is done "
    "apart; at 128 by 128 such a product took 52 to 61 us where it had taken 78, and a whole update of SAC, DDPG, TD3, DQN, "
    "TQC or CrossQ 0.5 to 15 % less. Patches of images gain nothing by it, and are left as they were.",
    "**Random bits hashed once**: XLA repeats what is elementwise in every kernel that reads it, so the hash behind SAC's "
    "noise stood nine times in its update. As a reduction it is computed once: the main job's update compiles in 10.5 s of "
    "processor time instead of 23.",
    "**What runs once compiled with no optimisation**: the first state of SAC with 64-64 takes 1.3 s of processor time "
    "instead of 4.4.",
    "**An update in one thread**: whenever more than eight kernels wait, XLA gives half of them to another thread, also where "
    "it was asked for one, and the other core has none of the numbers in its caches. Targets and gradients as functions of "
    "their own, and an optimizer's step, the targets' moves, packing and unpacking as one kernel each "
    "(`compilation.outlined`, `compilation.one_kernel`), let an update of TD3 take 22 % less, DDPG 18, TQC 14, SAC 10 (with "
    "parking's layers 16), DQN 9, CrossQ 5; PPO gained nothing. QR-DQN's gradient was a function of its own as this page was "
    "measured, and slower by it by a fifth; without, and with its optimizer's step as one kernel, it takes a fifth less than "
    "before.",
    "**Quantile losses target by target**: XLA wrote the table of all pairs of quantiles and targets to memory several times "
    "over. A scan over the targets takes 0.5 ms instead of 8 for QR-DQN (batches of 32, 200 quantiles), and 0.2 instead of "
    "1.6 for TQC.",
)
IN_THE_WAY = (
    "**Products of small matrices are most of what DDPG and TD3 do.** One of 128 by 128 by 128 took 44 to 60 us by itself, as "
    "the machine's speed changed, and an update of DDPG has ten of them, one of TD3 eleven and a half: 60 to 65 % of its "
    "time. In the loop XLA's thread worked 679 of 707 us of a step with DDPG and 997 of 1,022 with TD3, so whatever else is "
    "made faster would not show. With SAC (64-64) it is the other way round: the loop's own thread worked 527 of 531 us, "
    "XLA's 413.",
    "**An environment empties the caches.** Sending a compiled function the observations of 16 environments takes 46 us where "
    "nothing else runs, and 102 to 126 us after their step: XLA's, JAX's and Python's own work. On EnvPool such a step of PPO "
    "took 64 us an environment: 35 in the environments, 9 in its share of the updates, 4 in storing, the rest in acting.",
    "**The parking job on highway-env is the environment.** Of rejeu's 72 s in the run before this one, "
    "5,000 steps of training at 10.1 ms were 50 and "
    "the evaluation, nearly all of it steps, 5 to 9; a job 1.8 times as short as Stable-Baselines3's would leave 3 s for "
    "imports, compiling and 4,000 updates.",
    "**PPO on Gymnasium's environments waits for them**: its table says behind each ratio what a program that does nothing "
    "else would reach, and with 16 environments that is less than 4.",
)
"""What was found by profiles on the machine of the page."""


def write(results: Mapping[str, Any], page: Path) -> None:
    """Writes the page, and its pictures into the folder ``images`` beside it."""
    samples = results["samples"]
    sections = [
        head(results),
        how_to_read(results),
        parking(samples),
        per_step(samples, page),
        rollouts(samples, page),
        replay(samples, page),
        memory(samples),
        startup(samples),
        files(samples),
        machine_limits(samples),
        tried(),
        conditions(results),
    ]
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n\n".join(filter(None, sections)) + "\n", encoding="utf-8")


def head(results: Mapping[str, Any]) -> str:
    described = results["machine"]
    memory_text = "" if described["memory_gib"] is None else f", {described['memory_gib']:g} GiB of memory"
    text = f"""# How fast it is

Written by `scripts/bench`; every figure is from one run on one machine, and all samples are in
`benchmarks/results/bench.json`.

**The machine:** {described["processor"]}, {described["cores"]} cores{memory_text}, {described["system"]}.

To measure again, on a machine that does nothing else, from a clone of the repository:

```
pip install -c constraints.txt -e ".[all,box2d]"
scripts/bench
```

That makes a virtual environment for each peer first, with pip; `--sb3-python` and `--sbx-python` take ready ones, and
`--help` tells the rest. This page is of the command

```
{results["command"]}
```"""
    if results["settings"]["quick"]:
        text += "\n\n**This was a smoke run (`--quick`): its figures mean nothing.**"
    return text


def how_to_read(results: Mapping[str, Any]) -> str:
    versions = []
    for library, found in results["versions"].items():
        listed = ", ".join(f"{name} {version}" for name, version in found.items() if version is not None)
        versions.append(f"- {NAMES[library]}: {listed}")
    return f"""## How to read it

- Every measurement runs in a fresh process. The libraries take turns, {results["settings"]["rounds"]} round(s) of all cases;
  a figure is the median over the rounds, in brackets the least and the greatest.
- A ratio is taken in each round, between measurements minutes apart, and its median is shown. Above 1, rejeu is faster.
  Read ratios rather than times: another processor has other times.
- The clock starts once everything is compiled and warm, except where whole processes are timed.
- Peers run with one thread and with all, in the first round; the faster setting is measured on and shown. rejeu chooses its
  number of threads itself. Stable-Baselines3 and SBX step Gymnasium environments in the process (`DummyVecEnv`): neither
  takes EnvPool's as they are.
- All libraries get the same networks, batches, rollouts and numbers of updates, and compute on the CPU.
- **The limit** is a bare step of the same environment (random actions, resets included, through the same vector of
  environments) plus the floating-point operations of acting and updating at the rate of the fastest matrix product that
  this machine computes with as many threads as rejeu uses. No program that does the two one after the other can be faster.
  rejeu's off-policy loop does them at the same time, where there is a core to spare; and no real update is one large
  product. "Of the limit" is the limit divided by the measured time: 100 % would be a loop and an update without any loss.
  Behind a ratio, after "of", stands the ratio that a program at the limit would have, on the same environments.
- Operations are counted by XLA (`cost_analysis` of the compiled update). XLA counts the body of a loop once and of a
  conditional the costlier branch, so the count adds XLA's count of each body for its further runs, and takes of a
  conditional its share: a delayed actor counts as often as it is updated.

Versions:

{chr(10).join(versions)}"""


def machine_limits(samples: Sequence[Sample]) -> str:
    rows = []
    for threads, label in ((1, plan.ONE), (0, plan.ALL)):
        rate = peak(samples, threads)
        if rate is not None:
            rows.append((f"fastest float32 matrix product, {label}", f"{rate / 1e9:,.0f} GFLOP/s"))
    for measurement in plan.limits(1.0):
        if measurement.arguments["what"] == "env":
            numbers = step_seconds(samples, "limits", measurement.name, "rejeu")
            if numbers:
                rows.append((f"bare step: {measurement.name}", f"{with_spread(numbers, 1e6)} us"))
    counted = [("steps", name, f"one update: {name}") for name in (*plan.STEPS, plan.POOL)]
    for n in plan.N_ENVS:
        for algorithm in ("PPO", "A2C"):
            text = f"updates for one step: {algorithm}, {n} environments"
            counted.append(("rollouts", f"{algorithm}, {n} on gymnasium", text))
    for case, name, text in counted:
        flops = next((row["result"].get("update_flops") for row in best(samples, case, name, "rejeu")), None)
        if flops is not None:
            rows.append((text, f"{number(flops / 1e6)} MFLOP"))
    if not rows:
        return ""
    return f"""## What the limits are made of

The products are of square matrices from 128 to 2,048, by NumPy and by XLA; the fastest counts. For SAC with 64-64 and batches
of 64 the matrix products alone are {sac_by_hand() / 1e6:.2f} MFLOP by a formula on paper (`sac_by_hand` in
`benchmarks/bench/work/flops.py`); what XLA counts on top is elementwise: activations, losses, Adam, targets.

{table(("", ""), rows)}"""


def sac_by_hand() -> int:
    """Returns the formula's count for the case ``SAC``."""
    from benchmarks.bench.work import flops

    return flops.sac_by_hand(3, 1, (64, 64), 64)


def tried() -> str:
    helped, not_helped, in_the_way = (
        "\n".join(f"- {fact}" for fact in facts) for facts in (HELPED, DID_NOT_HELP, IN_THE_WAY)
    )
    return f"""## What was tried and did not help

{not_helped}

What did help, measured on the way:

{helped}

## What stands between this and the limit

{in_the_way}"""


def conditions(results: Mapping[str, Any]) -> str:
    samples = results["samples"]
    calibrated, busy = drift(samples), disturbed(samples, machine.BUSY)
    lines = [f"- Load average before the run: {results['machine']['load_before']}."]
    if calibrated is not None:
        lines.append(
            f"- A fixed matrix product around every measurement took {number(calibrated.median)} ms (least "
            f"{number(calibrated.low)}, greatest {number(calibrated.high)}): if it differs, the machine's speed did."
        )
    seconds = sum(sample["wall_seconds"] for sample in samples)
    lines.append(f"- {len(samples)} measurements, {seconds / 60:.0f} minutes in all.")
    if busy:
        lines.append(
            f"- **Other programs used more than {machine.BUSY} cores before {len(busy)} of the measurements: figures of those "
            "are not to be trusted.**"
        )
    failed = sorted({sample["key"] for sample in samples if "error" in sample})
    if failed:
        lines.append(f"- **Failed: {', '.join(failed)}.**")
    lines.append(
        "- Settings called `1 thread` set "
        + ", ".join(f"`{name}={v}`" for name, v in plan.VARIANTS[plan.ONE].items())
        + "."
    )
    return "## Under which conditions\n\n" + "\n".join(lines)
