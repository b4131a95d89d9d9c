"""Training loops that run on the device: environments in JAX, replay buffer and updates in one compiled program.

A *chunk* of turns is one call of the program. Between chunks, :class:`rejeu.training.run.Run` holds all that the loops of the
host would have left there, so callbacks, evaluation, checkpoints and files do not differ; steps of experience are copied there
when ``Run.replay`` is read. Results do not depend on where a chunk ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.core.errors import BadEnvironmentError
from rejeu.core.types import AnyArray, PyTree
from rejeu.core.xla import clock
from rejeu.training.checks import check_state
from rejeu.training.compiled.off_policy import OffPolicyProgram
from rejeu.training.compiled.on_policy import OnPolicyProgram
from rejeu.training.compiled.program import MAX_TURNS, Limits, Remake
from rejeu.training.compiled.trainer import DeviceTrainer
from rejeu.training.finite import NonFiniteSteps
from rejeu.training.learner import Learner, bad_leaves, checked
from rejeu.training.run import Progress, Run, add_time, start_clock

SECONDS = 0.2
"""Wall time of a chunk that is aimed at: progress bar, callbacks and Ctrl-C wait for its end."""


class Stops(NamedTuple):
    """Where chunks must end, so that what happens between them does not depend on the speed of the machine."""

    every: tuple[int, ...] = ()
    """Chunks end where the number of environment steps crosses a multiple of one of these."""
    at_episodes: bool = False
    """Chunks end with every turn in which an episode ends."""


def train_one(
    run: Run,
    learner: Learner,
    config: OffPolicyConfig | RolloutConfig,
    n_steps: int | None,
    progress: Callable[[AnyArray], AnyArray],
    stops: Stops,
) -> Iterator[Progress]:
    """Trains a run; the arguments are those of :func:`train`, which see."""
    for (turn,) in train([run], learner, config, n_steps, progress, stops, [0]):
        assert turn is not None
        yield turn


def train(
    runs: Sequence[Run],
    learner: Learner,
    config: OffPolicyConfig | RolloutConfig,
    n_steps: int | None,
    progress: Callable[[AnyArray], AnyArray],
    stops: Stops,
    active: Sequence[int],
    remake: Remake | None = None,
    hyper: Sequence[dict[str, float]] | None = None,
) -> Iterator[list[Progress | None]]:
    """Trains runs of equal settings until each has taken ``n_steps`` environment steps; yields after every chunk.

    Args:
        runs: mutated; consistent whenever the generator has yielded.
        learner: of one of them.
        config: its hyperparameters.
        n_steps: over all environments of a run, rounded up to whole turns; None: until the caller stops.
        progress: returns the progress of schedules after a number of steps, or an array of it after an array of numbers.
        stops: where chunks must end.
        active: indices of the runs that are trained, ascending. The caller may remove some between chunks: such runs stay
            as they are, and None stands for what they did. There must be one.
        remake: makes the algorithm, if hyperparameters differ.
        hyper: those that differ, by run.

    Raises:
        BadEnvironmentError: if a reward or an observation is not finite.
        NonFiniteError: if the state is not finite when training begins.
        NonFiniteSteps: if an update leaves numbers that are not finite. The run has the state before that chunk.
    """
    program_class: Any = OnPolicyProgram if isinstance(config, RolloutConfig) else OffPolicyProgram
    program = program_class.of(
        runs[0],
        config,
        algorithm=learner.algorithm,
        explorer=learner.explorer,
        packing=learner.packing,
        n_envs=runs[0].env.n_envs,
        skips=learner.skips,
        stops_at_episode=stops.at_episodes,
        remake=remake,
    )
    trainer = DeviceTrainer(program, runs, learner, hyper or [{}] * len(runs))
    first = runs[active[0]].step
    last = None if n_steps is None else first + n_steps
    for run in runs:
        check_state(run, learner)
    try:
        yield from take_chunks(trainer, first, last, progress, stops, active)
    finally:
        trainer.close(active)


def take_chunks(
    trainer: DeviceTrainer,
    first: int,
    last: int | None,
    progress: Callable[[AnyArray], AnyArray],
    stops: Stops,
    active: Sequence[int],
) -> Iterator[list[Progress | None]]:
    """Takes chunks from the step ``first`` to the step ``last``; see :func:`train`."""
    runs, capacity, n_envs = trainer.runs, trainer.program.capacity, trainer.program.n_envs
    for run in runs:
        start_clock(run)
    pace = Pace(capacity)
    identical, trained = list[Any](), list[int]()
    while active and (last is None or runs[active[0]].step < last):
        leader, began = runs[active[0]], time.perf_counter()
        for run in runs:
            if run.obs is None or run.env.must_reset:
                trainer.program.begin_episodes(run)
        if trained != [*active] or any(now is not then for now, then in zip(held(runs), identical, strict=True)):
            trained = [*active]
            trainer.push(float(progress(leader.step - first)), active[0])
        for run in runs:
            add_time(run, "replay", began)
        step = leader.step
        n_turns = min(pace.turns, turns_left(step, n_envs, last, stops))
        if step <= leader.learn_from:  # the turns that follow take longer
            n_turns = min(n_turns, max(-(-(leader.learn_from - step) // n_envs), 1))
        limits = Limits(
            np.int32(n_turns),
            schedule(progress, step - first, n_turns, n_envs, capacity),
            np.uint32(leader.learn_from),
        )
        began, paced, before = time.perf_counter(), clock(), [(run.state, run.n_updates) for run in runs]
        trainer.take(limits)
        for i in active:
            add_time(runs[i], "update", began)
        began, turns = time.perf_counter(), trainer.pull(active)
        for i in active:
            add_time(runs[i], "replay", began)
            if trainer.fault(i):
                raise_fault(trainer, i, step, before[i])
        pace.note(n_turns, clock() - paced)
        if step <= leader.learn_from <= leader.step:
            pace.turns = min(8, pace.turns)
        identical = held(runs)
        yield turns


def raise_fault(trainer: DeviceTrainer, run_number: int, first_step: int, before: tuple[PyTree, int]) -> NoReturn:
    """Raises the error of a run in a chunk after ``first_step``, before which its state and updates were ``before``.

    Its experience holds what is finite; a rollout is dropped.
    """
    run, report, after = trainer.runs[run_number], trainer.reports[run_number], trainer.carries[run_number].state
    run.state, run.n_updates = before
    if isinstance(trainer.program, OnPolicyProgram):
        run.replay.length = 0
    if report.nonfinite_env:
        run.obs = run.action = None
        raise BadEnvironmentError(
            f"{run.env.env_id} returned a reward or an observation that is not finite in one of the steps {first_step + 1:,} "
            f"to {run.step:,}; agent.on_device = False trains with the loop of the host, which says which one it was"
        )
    metrics = {name: value for name, value in report.metrics.items() if not trainer.program.skips}
    names = [*bad_leaves(checked(metrics)), *(f"{leaf} of the state" for leaf in trainer.learner.bad_leaves(after))]
    in_a_row = int(trainer.carries[run_number].in_a_row) if trainer.program.skips else 0
    raise NonFiniteSteps(run_number, range(first_step + 1, run.step + 1), names, in_a_row)


def held(runs: Sequence[Run]) -> list[object]:
    """Returns the objects of the runs that others may replace between chunks."""
    return [content for run in runs for content in (run.state, run.obs, run.action, run.buffer, run.env)]


def turns_left(step: int, n_envs: int, last: int | None, stops: Stops) -> int:
    """Returns the number of turns from ``step`` to the next stop, or to the last step if that is nearer.

    >>> turns_left(90, 4, None, Stops((100,))), turns_left(100, 4, 103, Stops((100,)))
    (3, 1)
    """
    marks = [(step // every + 1) * every for every in (*stops.every, MAX_TURNS * n_envs)]
    nearest = min(marks if last is None else [*marks, last])
    return -(-(nearest - step) // n_envs)


def schedule(
    progress: Callable[[AnyArray], AnyArray], first_step: int, n_turns: int, n_envs: int, capacity: int
) -> np.ndarray:
    """Returns the progress after 0 to ``n_turns`` turns, ``float32 (capacity + 1,)``, padded."""
    steps = first_step + n_envs * np.arange(n_turns + 1)
    values = np.broadcast_to(np.asarray(progress(steps), np.float32), steps.shape)
    return np.pad(values, (0, capacity - n_turns), mode="edge")


class Pace:
    """How many turns a chunk has, so that it takes about ``SECONDS``. Mutable."""

    def __init__(self, capacity: int) -> None:
        self.turns = min(8, capacity)
        self._capacity = capacity

    def note(self, n_turns: int, seconds: float) -> None:
        """Takes into account that so many turns took so long, without compilation."""
        wanted = int(n_turns * SECONDS / max(seconds, 1e-6))
        self.turns = min(max(wanted, 1), 8 * self.turns, self._capacity)
