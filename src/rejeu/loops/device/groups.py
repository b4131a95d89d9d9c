"""Many runs in groups that take their chunks one after another, each in one call of the same program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from rejeu.loops.device.machine import Machine
from rejeu.loops.device.turns import Limits
from rejeu.loops.run import Progress, Run


class Groups:
    """Machines of equal programs as one; see :class:`rejeu.loops.device.machine.Machine`. Mutable."""

    def __init__(self, machines: Sequence[Machine], size: int, active: Sequence[int]) -> None:
        """Takes the machine of each group of ``size`` runs, and the indices of the runs that are trained, which may change."""
        self.machines, self.size, self.active = machines, size, active
        self.capacity = machines[0].capacity

    def uses_part(self, run: Run, n_turns: int, last: int | None) -> bool:
        return self.machines[0].uses_part(run, n_turns, last)

    def push(self, runs: Sequence[Run], leader: Run, progress: float) -> None:
        for i, machine in enumerate(self.machines):
            machine.push(runs[i * self.size : (i + 1) * self.size], leader, progress)

    def call(self, limits: Limits) -> None:
        """Takes a chunk of turns in the groups that are trained; the results of one are copied while the next computes."""
        busy = [self.machines[i] for i in sorted({which // self.size for which in self.active})]
        for machine in busy:
            machine.start(limits)
        for machine in busy:
            machine.finish()

    def fault(self, which: int) -> bool:
        return self.machines[which // self.size].fault(which % self.size)

    def pull(self, which: int, run: Run) -> Progress:
        return self.machines[which // self.size].pull(which % self.size, run)

    def raise_fault(self, which: int, run: Run, limits: Limits) -> NoReturn:
        self.machines[which // self.size].raise_fault(which % self.size, run, limits)
