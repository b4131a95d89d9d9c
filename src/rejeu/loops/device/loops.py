"""The loops on the device as generators, which take the place of those of the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rejeu.algorithms.actor_critic import OnPolicyConfig
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.loops.device.driver import Stops, train
from rejeu.loops.device.off_policy_machine import OffPolicyMachine
from rejeu.loops.device.on_policy_machine import OnPolicyMachine
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
    for turns in train(machine, [run], learner, n_steps, progress, stops, begin_episodes):
        yield turns[0]


def on_policy(
    run: Run,
    learner: Learner,
    config: OnPolicyConfig,
    n_steps: int | None,
    progress: Callable[[int], float],
    stops: Stops,
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every chunk.

    The other arguments and the errors are those of :func:`rejeu.loops.on_policy.on_policy`.
    """
    machine = OnPolicyMachine([run], learner, config, stops)
    for turns in train(machine, [run], learner, n_steps, progress, stops, lambda run: begin_rollouts(run, config)):
        yield turns[0]
