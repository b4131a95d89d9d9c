"""The members of a population: a run folder each, trained round by round in processes, and copied between rounds.

::

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
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from rejeu import presets
from rejeu.agents.run_files import run_files, step_of
from rejeu.errors import RunInUseError
from rejeu.interrupt import Interrupt
from rejeu.io import atomic
from rejeu.io.records import read_json
from rejeu.reporting.runs import EVALUATIONS
from rejeu.reporting.tables import read_table
from rejeu.sweeps.process import Process, last_line
from rejeu.tuning import population as populations
from rejeu.tuning.population import DECISIONS, Decision, Population
from rejeu.tuning.training import Command, settings_options

POLL = 0.2
"""Seconds between two looks at the processes."""
MAX_LOST = 3
"""How often the process of a member may be killed in a round before the member counts as failed."""
STOPPED = (129, 130, 143)
"""Exit statuses of a process that was asked to stop."""

Echo = Callable[[str], object]


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

    def step(self, member: int) -> int:
        """Returns the environment step of a member's newest checkpoint, -1 without one."""
        found = run_files(self.run(member) / "checkpoints")
        return step_of(found[0]) if found else -1

    def score(self, member: int, number: int) -> float | None:
        """Returns the value of a member's evaluation at the end of a round; None if there is none."""
        table = read_table(self.run(member) / EVALUATIONS)
        first, end = (self.population.step(n) for n in (number + 1, number + 2))
        values = [
            value
            for step, value in zip(table.column("step"), table.column(self.population.plan.column), strict=True)
            if first <= step < end
        ]
        return float(values[-1]) if values and math.isfinite(values[-1]) else None

    def values(self, number: int) -> list[dict[str, Any]]:
        """Returns the hyperparameters of all members in a round, after those before it were decided."""
        if number == 0:
            return self.population.initial()
        return [one.next_values for one in self.decisions(number - 1)]

    def decisions(self, number: int) -> list[Decision]:
        """Returns what was decided after a round."""
        return populations.read_decisions(self.decisions_file(number), self.population)

    def n_decided(self) -> int:
        """Returns after how many rounds was decided."""
        n = 0
        while n < self.population.rounds and self.decisions_file(n).is_file():
            n += 1
        return n

    def decide(self, number: int) -> list[Decision]:
        """Decides after a round, and writes the decisions and the history."""
        scores = [self.score(member, number) for member in range(self.population.members)]
        rng = np.random.default_rng([self.population.plan.seed, DECISIONS, number])
        values = self.values(number)
        found = populations.decide(scores, values, self.population.plan.search_space, rng)
        if number + 1 == self.population.rounds:  # nobody trains on
            found = [dataclasses.replace(one, parent=None, next_values=one.values) for one in found]
        populations.write(found, self.decisions_file(number))
        self.write_history()
        return found

    def copy(self, number: int) -> None:
        """Copies checkpoints between members as decided; what was copied before an interruption is not copied again."""
        for member, decision in enumerate(self.decisions(number)):
            marker = self.run(member).with_name("copied.json")
            if decision.parent is None or (marker.is_file() and read_json(marker, populations.MAX_BYTES) == number):
                continue
            source, target = (self.run(one) / "checkpoints" for one in (decision.parent, member))
            copied = target.with_name("checkpoints.copied")
            shutil.rmtree(copied, ignore_errors=True)
            shutil.copytree(source, copied, ignore=shutil.ignore_patterns("lock"))
            if not (target.parent / "config.json").is_file():  # it failed before it began
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(source.parent / "config.json", target.parent / "config.json")
            shutil.rmtree(target, ignore_errors=True)
            copied.replace(target)
            with atomic.replacing(marker) as file:
                file.write(f"{number}\n".encode())

    def history(self) -> list[dict[str, Any]]:
        """Returns a row for each member and round that was decided."""
        return [
            {
                "round": number,
                "step": self.population.step(number + 1),
                "member": member,
                "score": one.score,
                "copies": one.parent,
                **one.values,
            }
            for number in range(self.n_decided())
            for member, one in enumerate(self.decisions(number))
        ]

    def write_history(self) -> None:
        """Writes ``history.csv``."""
        rows, text = self.history(), io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {name: json.dumps(value) if isinstance(value, list) else value for name, value in row.items()}
            for row in rows
        )
        with atomic.replacing(self.path / "history.csv") as file:
            file.write(text.getvalue().encode())

    def lock(self) -> FileLock:
        """Locks the folder for this process.

        Raises:
            RunInUseError: if another process trains the population.
        """
        lock = FileLock(self.path / "population.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise RunInUseError(
                f"another process trains the population in {self.path}; wait for it, or stop it"
            ) from None
        return lock


def create(path: Path, population: Population) -> Members:
    """Returns the members of a new folder."""
    populations.write(population, path / "population.json")
    return Members(path, population)


def train(members: Members, command: Command, workers: int, stop: Interrupt, echo: Echo) -> bool:
    """Trains until the last round or until ``stop`` is requested; returns whether the population is complete.

    Raises:
        ValueError: if all members failed.
    """
    population = members.population
    for number in range(population.rounds):
        if number < members.n_decided():
            members.copy(number)
            continue
        if not train_round(members, number, command, workers, stop, echo):
            return False
        decisions = members.decide(number)
        echo(line(number, decisions, population))
        members.copy(number)
    best = best_member(members)
    shutil.copy(members.run(best) / "agent.safetensors", members.path / "best.safetensors")
    return True


def train_round(members: Members, number: int, command: Command, workers: int, stop: Interrupt, echo: Echo) -> bool:
    """Trains all members to the end of a round; returns False if it was stopped before."""
    values, target = members.values(number), members.population.step(number + 1)
    waiting = [member for member in range(members.population.members) if not is_done(members, member, number)]
    running, lost = dict[int, Process](), dict[int, int]()
    was_stopped = False
    try:
        while True:
            if stop.requested and not was_stopped:
                was_stopped = True
                for process in running.values():
                    process.stop()
            while waiting and len(running) < workers and not stop.requested:
                member = waiting.pop(0)
                running[member] = begin(members, member, values[member], target, command)
            for member, process in list(running.items()):
                status = process.poll()
                if status is None:
                    continue
                del running[member]
                if was_stopped or is_done(members, member, number):
                    continue
                lost[member] = lost.get(member, 0) + 1
                if status in (*STOPPED, 0) or (status < 0 and lost[member] < MAX_LOST):
                    waiting.append(member)
                else:
                    echo(f"member {member} failed in round {number}: {last_line(log_of(members, member))}")
            if not running and (stop.requested or not waiting):
                return not (stop.requested and (was_stopped or waiting))
            time.sleep(POLL)
    finally:
        for process in running.values():
            process.kill()


def begin(members: Members, member: int, values: Mapping[str, Any], target: int, command: Command) -> Process:
    """Starts the process that trains a member to a step."""
    plan, run = members.population.plan, members.run(member)
    complete = populations.hyperparameters(members.population, values)
    step = members.step(member)
    if step < 0:
        if run.exists():
            shutil.rmtree(run)  # it was killed before its first checkpoint
        preset = presets.write(plan.preset(complete, f"rejeu pbt, member {member}"), run.with_name("preset.json"))
        words = [*command.train(preset, plan.seeds(member)[0], run, plan.checkpoint_minutes), "--pause", str(target)]
    else:
        given = {name.split(".")[0]: None for name in values}
        words = [*command.resume(run), *settings_options({name: complete[name] for name in given})]
        words += ["--steps", str(target - step)] if target > step else []
    lock = run.with_name("process.lock")
    return Process(words, log_of(members, member), lock, command.environ)


def log_of(members: Members, member: int) -> Path:
    """Returns the file with what the processes of a member printed."""
    return members.run(member).with_name("run.log")


def is_done(members: Members, member: int, number: int) -> bool:
    """Returns whether a member has finished a round: its checkpoint is at the end of it, and it was evaluated there."""
    is_there = members.step(member) >= members.population.step(number + 1) and members.score(member, number) is not None
    is_last = number + 1 == members.population.rounds
    return is_there and (not is_last or (members.run(member) / "agent.safetensors").is_file())


def best_member(members: Members) -> int:
    """Returns the member with the highest score in the last round."""
    last = members.decisions(members.population.rounds - 1)
    scores = [-math.inf if one.score is None else one.score for one in last]
    return int(np.argmax(scores))


def line(number: int, decisions: list[Decision], population: Population) -> str:
    """Returns what a round found on one line."""
    known = {i: one.score for i, one in enumerate(decisions) if one.score is not None}
    scores, best = np.array([*known.values()]), max(known, key=lambda i: known[i])
    copies = ", ".join(f"{i} copies {one.parent}" for i, one in enumerate(decisions) if one.parent is not None)
    found = f"round {number:>3}  step {population.step(number + 1):>9,}  {population.plan.measure} "
    return found + f"{scores.mean():,.4g} (best {scores.max():,.4g}, member {best})" + f"  {copies}" * bool(copies)
