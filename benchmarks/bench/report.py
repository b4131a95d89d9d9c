"""Writes ``benchmarks/performance.md`` from the results file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bench import machine, plan
from benchmarks.bench.sections import memory, parking, per_step, rollouts, startup
from benchmarks.bench.summary import Sample, best, disturbed, drift, peak, step_seconds
from benchmarks.bench.text import NAMES, number, table, with_spread


def write(results: Mapping[str, Any], page: Path) -> None:
    """Writes the page."""
    samples = results["samples"]
    sections = [
        head(results),
        how_to_read(results),
        parking(samples),
        per_step(samples),
        rollouts(samples),
        memory(samples),
        startup(samples),
        machine_limits(samples),
        conditions(results),
    ]
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n\n".join(filter(None, sections)) + "\n", encoding="utf-8")


def head(results: Mapping[str, Any]) -> str:
    described = results["machine"]
    memory_text = "" if described["memory_gib"] is None else f", {described['memory_gib']:g} GiB of memory"
    text = f"""# Performance

This page is written by `scripts/bench` from one run on one machine. All samples are in `benchmarks/results/bench.json`.
[Notes](notes.md) say what made rejeu faster, what did not, and what limits it.

**The machine:** {described["processor"]}, {described["cores"]} cores{memory_text}, {described["system"]}.

To repeat the measurements, on an idle machine, from a clone of the repository:

```
pip install -c constraints.txt -e ".[all,box2d]"
scripts/bench
```

This creates a virtual environment for each of the other libraries; `--sb3-python` and `--sbx-python` use existing ones.
This page is the result of

```
{results["command"]}
```"""
    if results["settings"]["quick"]:
        text += "\n\n**This was a smoke test (`--quick`): its figures have no meaning.**"
    return text


def how_to_read(results: Mapping[str, Any]) -> str:
    versions = []
    for library, packages in results["versions"].items():
        listed = ", ".join(f"{name} {version}" for name, version in packages.items() if version is not None)
        versions.append(f"- {NAMES[library]}: {listed}")
    return f"""## Method

- Every measurement runs in a new process. The libraries alternate, {results["settings"]["rounds"]} round(s) of all cases.
  A figure is the median over the rounds, with the minimum and maximum in brackets.
- A ratio is computed in each round, and its median is shown. Above 1, rejeu is faster. Compare ratios rather than times.
- Timing starts after compilation and warm-up, except for whole processes.
- The other libraries run with one thread and with all threads in the first round, and with the faster setting from then
  on. rejeu selects its number of threads. Stable-Baselines3 and SBX step Gymnasium environments in the process
  (`DummyVecEnv`); neither supports EnvPool directly.
- All libraries have the same networks, batch sizes, rollouts and numbers of updates, and use the CPU.
- **The limit** is a bare step of the same environments (random actions, resets included) plus the floating-point
  operations of acting and updating at the rate of the fastest matrix product on this machine, with rejeu's number of
  threads. No program that does both in sequence can be faster. rejeu's off-policy loop does both at the same time if
  there is a free core. "Of the limit" is the limit divided by the measured time. A ratio "x of y" is x, where a program
  at the limit would have y.
- Operations are counted by XLA (`cost_analysis` of the compiled update). XLA counts the body of a loop once, and the more
  expensive branch of a conditional. The counts are corrected for the number of iterations and the frequency of delayed
  actor updates.

Versions:

{chr(10).join(versions)}"""


def machine_limits(samples: Sequence[Sample]) -> str:
    rows = []
    for threads, label in ((1, plan.ONE), (0, plan.ALL)):
        rate = peak(samples, threads)
        if rate is not None:
            rows.append((f"fastest float32 matrix product, {label}", f"{rate / 1e9:,.0f} GFLOP/s"))
    for measurement in plan.limits(1.0):
        if measurement.arguments["quantity"] == "env":
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
    return f"""## Components of the limits

The matrix products are of square matrices from 128 to 2,048, by NumPy and XLA; the fastest is used. For SAC with 64-64
networks and batches of 64 the matrix products are {sac_by_hand() / 1e6:.2f} MFLOP by a formula (`sac_by_hand` in
`benchmarks/bench/work/flops.py`). The others are elementwise: activations, losses, Adam, target networks.

{table(("", ""), rows)}"""


def sac_by_hand() -> int:
    """Returns the operation count of the case ``SAC`` by the formula."""
    from benchmarks.bench.work import flops

    return flops.sac_by_hand(3, 1, (64, 64), 64)


def conditions(results: Mapping[str, Any]) -> str:
    samples = results["samples"]
    calibrated, busy = drift(samples), disturbed(samples, machine.BUSY)
    lines = [f"- Load average before the run: {results['machine']['load_before']}."]
    if calibrated is not None:
        lines.append(
            f"- A fixed matrix product around every measurement took {number(calibrated.median)} ms ("
            f"{number(calibrated.low)} to {number(calibrated.high)}), which shows changes of the machine's speed."
        )
    seconds = sum(sample["wall_seconds"] for sample in samples)
    lines.append(f"- {len(samples)} measurements, {seconds / 60:.0f} minutes in total.")
    if busy:
        lines.append(
            f"- **Other programs used more than {machine.BUSY} cores before {len(busy)} of the measurements: "
            "those figures are unreliable.**"
        )
    failed = sorted({sample["key"] for sample in samples if "error" in sample})
    if failed:
        lines.append(f"- **Failed: {', '.join(failed)}.**")
    lines.append(
        "- Settings called `1 thread` set "
        + ", ".join(f"`{name}={v}`" for name, v in plan.VARIANTS[plan.ONE].items())
        + "."
    )
    return "## Conditions\n\n" + "\n".join(lines)
