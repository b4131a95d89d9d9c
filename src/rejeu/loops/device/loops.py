"""The loops on the device as generators, which take the place of those of the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.loops.device.driver import Stops, train
from rejeu.loops.device.groups import Groups
from rejeu.loops.device.off_policy_machine import OffPolicyMachine
from rejeu.loops.device.on_policy_machine import OnPolicyMachine
from rejeu.loops.device.sharing import group_size
from rejeu.loops.device.variants import Variants
from rejeu.loops.learner import Learner
from rejeu.loops.off_policy import begin_episodes
from rejeu.loops.on_policy import begin_episodes as begin_rollouts
from rejeu.loops.run import Progress, Run


def off_policy(
    run: Run,
    learner: Learner,
    config: OffPolicyConfig,
    n_steps: int | None,
    progress: Callable[[int], float],
    stops: Stops,
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every chunk.

    The other arguments and the errors are those of :func:`rejeu.loops.off_policy.off_policy`.
    """
    machine = OffPolicyMachine([run], learner, config, stops)
    for (turn,) in train(machine, [run], learner, n_steps, progress, stops, begin_episodes):
        assert turn is not None
        yield turn


def on_policy(
    run: Run,
    learner: Learner,
    config: RolloutConfig,
    n_steps: int | None,
    progress: Callable[[int], float],
    stops: Stops,
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every chunk.

    The other arguments and the errors are those of :func:`rejeu.loops.on_policy.on_policy`.
    """
    machine = OnPolicyMachine([run], learner, config, stops)
    for (turn,) in train(machine, [run], learner, n_steps, progress, stops, lambda run: begin_rollouts(run, config)):
        assert turn is not None
        yield turn


def together(
    runs: Sequence[Run],
    learner: Learner,
    config: OffPolicyConfig | RolloutConfig,
    n_steps: int | None,
    progress: Callable[[int], float],
    stops: Stops,
    active: Sequence[int],
    variants: Variants | None = None,
    hyper: Sequence[dict[str, float]] | None = None,
    devices: Sequence[jax.Device] = (),
) -> Iterator[list[Progress | None]]:
    """Trains several runs of equal settings in one program; yields what each has done after every chunk.

    Args:
        runs: mutated.
        learner: of one of them.
        config: its hyperparameters.
        n_steps: environment steps of each run.
        progress: of schedules, after a number of steps.
        stops: where chunks must end.
        active: see :func:`rejeu.loops.device.driver.train`.
        variants: what makes the algorithm, if hyperparameters differ.
        hyper: those that differ, by run.
        devices: of which each computes some of the runs; none for JAX's default device.
    """
    size = group_size(len(runs), devices)
    by_run = {id(run): one for run, one in zip(runs, hyper or [{}] * len(runs), strict=True)}
    kind: Any = OnPolicyMachine if isinstance(config, RolloutConfig) else OffPolicyMachine
    groups = [runs[i : i + size] for i in range(0, len(runs), size)]
    machines = [kind(group, learner, config, stops, variants, by_run, size, devices) for group in groups]
    machine = machines[0] if len(machines) == 1 else Groups(machines, size, active)
    begin: Any = partial(begin_rollouts, config=config) if isinstance(config, RolloutConfig) else begin_episodes
    yield from train(machine, runs, learner, n_steps, progress, stops, begin, active)
