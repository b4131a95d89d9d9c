"""Population-based training: a folder of members, which are trained round by round, selected, copied and perturbed.

Source: Jaderberg et al. 2017, "Population Based Training of Neural Networks" (arXiv 1711.09846). After each round the worst
quarter copies networks, optimizers, replay buffer and hyperparameters of the best quarter (truncation selection), and then
each copied hyperparameter is perturbed. ::

    population.json         the settings
    rounds/0003.json        what was decided after round 3
    history.csv             a row for each member and round
    members/02/run/         the run folder of a member
    members/02/copied.json  the last round after which the member copied another
    best.safetensors        the best member at the end

Training is resumed from checkpoints, so the result of a population does not depend on interruptions.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from filelock import FileLock
from msgspec import Meta

from rejeu import presets
from rejeu.agents.run_files import copy_run
from rejeu.algorithms.search import FIXED_AT_START, Choice, Dimension, NearOne, SearchSpace, Uniform, plain
from rejeu.errors import CheckpointError, RunInUseError
from rejeu.experiments import space as spaces, study_plan as plans
from rejeu.experiments.process import LocalLauncher, hold
from rejeu.experiments.scheduler import Scheduler, Work
from rejeu.experiments.search import begin_or_resume
from rejeu.experiments.study_plan import Plan
from rejeu.interrupt import Interrupt
from rejeu.io import atomic
from rejeu.io.records import Count, Malformed, convert, json_text, read_json, shown
from rejeu.reporting.runs import EVALUATIONS
from rejeu.reporting.tables import read_table
from rejeu.runs.config import RunConfig, Task
from rejeu.runs.folder import newest_step, run_files, step_of

FILE = "population.json"
"""File that makes a folder one of a population."""
FACTORS, SHIFT = (0.8, 1.25), 0.1
"""Factors of a perturbation, and the share of its range by which a uniform hyperparameter is shifted."""
SELECTED = 4
"""The worst and the best 1 / 4 of the members are selected."""
INITIAL, DECISIONS, COPIES = range(10, 13)
"""Streams of random numbers: of the first hyperparameters, of the decisions after each round, of the copies."""
MAX_BYTES = 2**24

Echo = Callable[[str], object]


@dataclass(frozen=True, kw_only=True)
class Population:
    """The settings of a population."""

    plan: Plan
    """What its members have in common. ``trials`` is their number, ``evaluate_every`` the steps of a round."""
    rounds: Annotated[int, Meta(ge=1, le=100_000)]

    @property
    def members(self) -> int:
        """Number of members."""
        return self.plan.trials

    def step(self, n_rounds: int) -> int:
        """Returns the environment step of each member after so many rounds."""
        return n_rounds * self.plan.evaluate_every

    def copy_seed(self, member: int, number: int) -> int:
        """Returns the seed with which a member goes on after it has copied another at the end of a round."""
        return int(np.random.SeedSequence([self.plan.seed, COPIES, number, member]).generate_state(1)[0])

    def initial(self) -> list[dict[str, Any]]:
        """Returns the first hyperparameters of all members; the first member has those of the default, where it has any."""
        rng = np.random.default_rng([self.plan.seed, INITIAL])
        found = [{name: sample(one, rng) for name, one in self.plan.search_space.items()} for _ in range(self.members)]
        return [{**found[0], **plans.default_values(self.plan)}, *found[1:]]


@dataclass(frozen=True)
class Decision:
    """The decision about one member after a round."""

    score: float | None
    """Mean return or success rate of the evaluation at the end of the round; None if the member failed."""
    values: dict[str, Any]
    """Its hyperparameters in that round."""
    parent: Count | None
    """The member that it copies; None if it continues."""
    next_values: dict[str, Any]
    """Its hyperparameters in the next round."""


def make(rounds: int, round_steps: int, members: int, **options: Any) -> Population:
    """Returns the settings of a population; ``options`` are those of :func:`rejeu.experiments.study_plan.make`.

    Raises:
        ValueError: for fewer than two members, or a hyperparameter that cannot change while a run trains.
    """
    if members < 2:
        raise ValueError(f"members={members} must be at least 2: the worst copy the best")
    for name in {*(options.get("search") or {}), *options.get("only", ())}:
        if is_fixed(name):
            raise ValueError(f"{name} cannot change while a run trains; leave it out, or set it for all members")
    plan = plans.make(trials=members, steps=rounds * round_steps, evaluate_every=round_steps, final_seeds=0, **options)
    if plan.n_envs > round_steps:
        raise ValueError(f"round_steps={round_steps} must be at least the number of environments, {plan.n_envs}")
    if not plan.checkpoint_minutes:
        raise ValueError("checkpoint_minutes=0 must be above 0: each round begins at the checkpoints of the one before")
    space = {name: one for name, one in plan.space.items() if not is_fixed(name)}
    if not space:
        raise ValueError(
            f"there is nothing to search for {plan.algorithm}; give a range, such as learning_rate=1e-4..1e-2"
        )
    return Population(plan=dataclasses.replace(plan, space=space), rounds=rounds)


def is_fixed(name: str) -> bool:
    """Returns whether a hyperparameter cannot change while a run trains."""
    return name.split(".")[0] in FIXED_AT_START


def sample(dimension: Dimension, rng: np.random.Generator) -> Any:
    """Returns a random value of a dimension, a plain Python value."""
    if isinstance(dimension, Choice):
        return dimension.values[rng.integers(len(dimension.values))]
    low, high = dimension.low, dimension.high
    if dimension.is_whole:
        return int(rng.integers(int(low), int(high) + 1))
    if isinstance(dimension, Uniform):
        return float(rng.uniform(low, high))
    if isinstance(dimension, NearOne):
        return within(dimension, 1 - math.exp(rng.uniform(math.log(1 - high), math.log(1 - low))))
    return within(dimension, math.exp(rng.uniform(math.log(low), math.log(high))))


def perturbed(dimension: Dimension, value: Any, rng: np.random.Generator) -> Any:
    """Returns a neighboring value: of a choice the one before or after it, of a uniform range one shifted by a tenth of it.

    Of a logarithmic range, the value (or its distance from 1) is multiplied by 0.8 or 1.25. Whole numbers move by 1 at least.
    At the end of a range the value moves the other way.
    """
    up = bool(rng.integers(2))
    moved = neighbor(dimension, value, up)
    return neighbor(dimension, value, not up) if plain(moved) == plain(value) else moved


def neighbor(dimension: Dimension, value: Any, up: bool) -> Any:
    """Returns the next value in a direction; ``value`` itself at the end of the range."""
    if isinstance(dimension, Choice):
        place = dimension.index(value) + (1 if up else -1)
        return dimension.values[min(max(place, 0), len(dimension.values) - 1)]
    if isinstance(dimension, Uniform):
        return within(dimension, value + (SHIFT if up else -SHIFT) * (dimension.high - dimension.low))
    factor = FACTORS[up]
    if dimension.is_whole:
        moved = max(round(value * factor), value + 1) if up else min(round(value * factor), value - 1)
        return int(within(dimension, moved))
    if isinstance(dimension, NearOne):
        return within(dimension, 1 - (1 - value) * factor)
    return within(dimension, value * factor)


def within(dimension: Any, value: float) -> float:
    """Returns the nearest value in a range."""
    return min(max(value, dimension.low), dimension.high)


def decide(
    scores: Sequence[float | None], values: Sequence[Mapping[str, Any]], space: SearchSpace, rng: np.random.Generator
) -> list[Decision]:
    """Returns the decision about each member after a round.

    The worst quarter copies a random one of the best quarter, as do all that failed.

    Raises:
        ValueError: if all members failed.
    """
    finite = {i: score for i, score in enumerate(scores) if score is not None and math.isfinite(score)}
    if not finite:
        raise ValueError("all members failed; see their logs")
    order = sorted(finite, key=lambda i: (-finite[i], i))
    n = max(len(scores) // SELECTED, 1)
    best = order[:n]
    worst = {*[i for i in range(len(scores)) if i not in finite], *order[max(len(order) - n, n) :]}
    found = []
    for i, own in enumerate(values):
        parent = best[rng.integers(len(best))] if i in worst else None
        copied = own if parent is None else values[parent]
        moved = copied if parent is None else {name: perturbed(space[name], copied[name], rng) for name in copied}
        found.append(Decision(finite.get(i), dict(own), parent, dict(moved)))
    return found


@dataclass(frozen=True)
class Members:
    """The folder of a population."""

    path: Path
    population: Population

    def run(self, member: int) -> Path:
        """Returns the run folder of a member."""
        return self.path / "members" / f"{member:02d}" / "run"

    def decisions_file(self, number: int) -> Path:
        """Returns the file of the decisions after a round."""
        return self.path / "rounds" / f"{number:04d}.json"

    def evaluations(self, member: int, number: int) -> list[float]:
        """Returns the values of a member's evaluations at the end of a round, which may be NaN; empty if there are none."""
        table = read_table(self.run(member) / EVALUATIONS)
        first, end = (self.population.step(n) for n in (number + 1, number + 2))
        rows = zip(table.column("step"), table.column(self.population.plan.column), strict=True)
        return [float(value) for step, value in rows if first <= step < end]

    def score(self, member: int, number: int) -> float | None:
        """Returns the value of a member's evaluation at the end of a round; None if there is none."""
        values = self.evaluations(member, number)
        return values[-1] if values and math.isfinite(values[-1]) else None

    def values(self, number: int) -> list[dict[str, Any]]:
        """Returns the hyperparameters of all members in a round, after those before it were decided."""
        return [one.next_values for one in self.decisions(number - 1)] if number else self.population.initial()

    def decisions(self, number: int) -> list[Decision]:
        """Returns what was decided after a round; the file is untrusted.

        Raises:
            CheckpointError: if it is damaged.
        """
        path, space = self.decisions_file(number), self.population.plan.search_space
        try:
            found = convert(read_json(path, MAX_BYTES), list[Decision])
            if len(found) != self.population.members:
                raise Malformed(f"it has {len(found)} members instead of {self.population.members}")
            for values in (values for one in found for values in (one.values, one.next_values)):
                if values.keys() != space.keys() or not all(space[name].contains(values[name]) for name in space):
                    raise Malformed(f"{str(values)[:100]} does not lie in the search space")
            if unknown := [one.parent for one in found if one.parent is not None and one.parent >= len(found)]:
                raise Malformed(f"there is no member {unknown[0]}")
            return found
        except (ValueError, TypeError) as error:
            raise CheckpointError(f"{path} is damaged: {shown(error, 1000)}") from None

    def n_decided(self) -> int:
        """Returns after how many rounds was decided."""
        rounds = self.population.rounds
        return next((n for n in range(rounds) if not self.decisions_file(n).is_file()), rounds)

    def decide(self, number: int) -> list[Decision]:
        """Decides after a round, and writes the decisions and the history."""
        scores = [self.score(member, number) for member in range(self.population.members)]
        rng = np.random.default_rng([self.population.plan.seed, DECISIONS, number])
        found = decide(scores, self.values(number), self.population.plan.search_space, rng)
        if number + 1 == self.population.rounds:  # nobody trains on
            found = [dataclasses.replace(one, parent=None, next_values=one.values) for one in found]
        atomic.write(self.decisions_file(number), json_text(found))
        self.write_history()
        return found

    def copy(self, number: int) -> None:
        """Copies checkpoints between members as decided; what was copied before an interruption is not copied again."""
        for member, decision in enumerate(self.decisions(number)):
            marker = self.run(member).with_name("copied.json")
            if decision.parent is None or (marker.is_file() and convert(read_json(marker, MAX_BYTES), int) >= number):
                continue
            source, target = (self.run(one) / "checkpoints" for one in (decision.parent, member))
            copied = target.with_name("checkpoints.copied")
            shutil.rmtree(copied, ignore_errors=True)
            copy_run(source, copied, self.population.copy_seed(member, number))
            if not (target.parent / "config.json").is_file():  # it failed before it began
                shutil.copy(source.parent / "config.json", target.parent / "config.json")
            shutil.rmtree(target, ignore_errors=True)
            copied.replace(target)
            atomic.write(marker, json_text(number))

    def history(self) -> list[dict[str, Any]]:
        """Returns a row for each member and round that was decided."""
        rows = []
        for number in range(self.n_decided()):
            step = self.population.step(number + 1)
            for member, one in enumerate(self.decisions(number)):
                known = {"round": number, "step": step, "member": member, "score": one.score, "copies": one.parent}
                rows.append({**known, **one.values})
        return rows

    def write_history(self) -> None:
        """Writes ``history.csv``."""
        rows, text = self.history(), io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: json.dumps(one) if isinstance(one, list) else one for key, one in row.items()})
        atomic.write(self.path / "history.csv", text.getvalue())

    def lock(self) -> FileLock:
        """Locks the folder for this process.

        Raises:
            RunInUseError: if another process trains the population.
        """
        lock = hold(self.path / "population.lock")
        if lock is None:
            raise RunInUseError(f"another process trains the population in {self.path}; wait for it, or stop it")
        return lock

    def best(self) -> int:
        """Returns the member with the highest score in the last round."""
        scores = [one.score for one in self.decisions(self.population.rounds - 1)]
        return int(np.argmax([-math.inf if score is None else score for score in scores]))


class MemberWork(Work):
    """The training of a member to the end of a round. Mutable."""

    def __init__(self, members: Members, member: int, number: int, values: Mapping[str, Any], run: RunConfig) -> None:
        self.members, self.member, self.number, self.values, self.config = members, member, number, values, run
        self.target = members.population.step(number + 1)
        """Environment step of the end of the round."""
        self.name, self.run = f"member {member} in round {number}", members.run(member)
        self.log, self.lock = self.run.with_name("run.log"), self.run.with_name("process.lock")

    def is_open(self) -> bool:
        is_last = self.number + 1 == self.members.population.rounds
        has_files = not is_last or (self.run / "agent.safetensors").is_file()
        return newest_step(self.run / "checkpoints") < self.target or not has_files or not self.is_evaluated()

    def is_evaluated(self) -> bool:
        """Returns whether there was an evaluation at the end of the round."""
        return bool(self.members.evaluations(self.member, self.number))

    def has_result(self) -> bool:
        return not self.is_open() and self.members.score(self.member, self.number) is not None

    def task(self) -> Task:
        checkpoints = run_files(self.run / "checkpoints")
        if len(checkpoints) > 1 and step_of(checkpoints[0]) >= self.target and not self.is_evaluated():
            checkpoints[0].unlink()  # it was stopped in the evaluation: the end of the round is trained again
        plan, step = self.members.population.plan, max(newest_step(self.run / "checkpoints"), 0)
        complete = spaces.applied(plan.fixed, self.values)
        preset = plan.preset(complete, f"rejeu pbt, member {self.member}")
        path = presets.write(preset, self.run.with_name("preset.json"))
        minutes, seed = plan.checkpoint_minutes, plan.seeds(self.member)[0]
        run = dataclasses.replace(self.config, preset=str(path), seed=seed, checkpoint_minutes=minutes)
        changes = {name: complete[name] for name in dict.fromkeys(name.split(".")[0] for name in self.values)}
        is_last = self.number + 1 == self.members.population.rounds
        pause = None if is_last and step >= self.target else max(self.target - step, 1)  # at the target: to evaluate
        return begin_or_resume(self.run, run, changes=changes, pause=pause)

    def ended(self) -> None:
        """Does nothing: the files of the run say how far it is."""


def create(path: Path, population: Population) -> Members:
    """Returns the members of a new folder."""
    atomic.write(path / FILE, json_text(population))
    return Members(path, population)


def read(path: Path) -> Members:
    """Returns the members of a folder, whose file is untrusted.

    Raises:
        FileNotFoundError: if it is no population.
        CheckpointError: if the file is damaged.
    """
    file = path / FILE
    if not file.is_file():
        raise FileNotFoundError(f"{path} is no folder of rejeu pbt: it holds no {FILE}")
    try:
        found = convert(read_json(file, MAX_BYTES), Population)
        plans.check(found.plan, file)
        return Members(path, found)
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{file} is damaged: {shown(error, 1000)}") from None


def train(members: Members, run: RunConfig, workers: int, stop: Interrupt, echo: Echo) -> bool:
    """Trains until the last round, unless ``stop`` is requested or a run cannot be started; returns whether all is trained.

    Raises:
        ValueError: if all members failed.
    """
    for number in range(members.population.rounds):
        if number >= members.n_decided():
            if not train_round(members, number, run, workers, stop, echo):
                return False
            echo(line(number, members.decide(number), members.population))
        members.copy(number)
    shutil.copy(members.run(members.best()) / "agent.safetensors", members.path / "best.safetensors")
    return True


def train_round(members: Members, number: int, run: RunConfig, workers: int, stop: Interrupt, echo: Echo) -> bool:
    """Trains all members to the end of a round; returns False if it was stopped before, or one could not be started."""
    values = members.values(number)
    tasks = [MemberWork(members, member, number, values[member], run) for member in range(len(values))]

    def say(text: str) -> None:
        if not text.endswith((": done", ": stopped")):
            echo(text)

    scheduler = Scheduler(LocalLauncher(workers), stop, say)
    scheduler.waiting.extend(tasks)
    scheduler.run()
    if any(task.ending in ("stopped", "left") for task in tasks):
        return False
    for task in tasks:
        if task.ending != "failed" and not task.has_result():
            echo(f"{task.name} failed: {EVALUATIONS} has no {members.population.plan.measure} at the end of the round")
    return True


def line(number: int, decisions: list[Decision], population: Population) -> str:
    """Returns what a round found on one line."""
    known = {i: one.score for i, one in enumerate(decisions) if one.score is not None}
    scores, best = np.array([*known.values()]), max(known, key=lambda i: known[i])
    copies = ", ".join(f"{i} copies {one.parent}" for i, one in enumerate(decisions) if one.parent is not None)
    found = f"round {number:>3}  step {population.step(number + 1):>9,}  {population.plan.measure} "
    return found + f"{scores.mean():,.4g} (best {scores.max():,.4g}, member {best})" + f"  {copies}" * bool(copies)
