"""Several runs in one program: seeds, and values of numeric hyperparameters.

The runs are ordinary agents with environments, histories, callbacks and files of their own. Only the chunks of turns between
callbacks are computed together, by ``jax.vmap`` over the runs.
"""

from __future__ import annotations

import dataclasses
import itertools
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any, TypeVar

import jax

from rejeu.agents import device, training
from rejeu.agents.agent import Agent
from rejeu.agents.device import require_memory
from rejeu.algorithms import config as configs
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.callbacks.base import Callback, in_order, listed
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.core import devices
from rejeu.core.interrupt import Interrupt
from rejeu.core.validation import field_names, is_number, whole, whole_seed
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.make import make_vector
from rejeu.exploration import explorer as exploration
from rejeu.logs.logging import Sink
from rejeu.training import finite
from rejeu.training.compiled import Stops, train
from rejeu.training.finite import NonFiniteSteps
from rejeu.training.run import TrainingCall

A = TypeVar("A", bound=Agent)
IN_REPLAY = ("gamma",)
"""Numbers that the replay buffer on the device is compiled with."""


def train_seeds(
    kind: type[A],
    policy: str,
    env: str | FunctionalEnv,
    total_timesteps: int | None = None,
    *,
    seeds: int | Sequence[int],
    n_envs: int = 1,
    minutes: float | None = None,
    callback: Callable[[A], Callback | Iterable[Callback] | None] | None = None,
    log_interval: int = 4,
    progress_bar: bool = False,
    device: str = "auto",
    **settings: Any,
) -> list[A]:
    """Trains independent runs and returns their agents.

    Runs in JAX environments are trained together, in one program on the device. Each is that of an agent with the same seed
    and settings that was trained alone, up to the rounding of sums, whose order differs (see ``docs/device.md``). Runs in
    other environments are trained one after another.

    Args:
        kind: the class of the agents, such as ``rejeu.SAC``.
        policy: as for the agent.
        env: an id, or an environment in JAX.
        total_timesteps: environment steps of each run.
        seeds: how many runs, with the seeds 0, 1, ...; or their seeds.
        n_envs: environments of each run.
        minutes: stop after so many, without compilation, which runs that are trained one after another have each.
        callback: called with each agent before training; returns its callbacks.
        log_interval: episodes of a run between two rows of its statistics.
        progress_bar: show the progress of the first run, which is that of all that are trained together.
        device: ``"auto"``, ``"cpu"`` or ``"gpu"``.
        settings: arguments of the agent. A list of numbers in place of a float hyperparameter, such as
            ``learning_rate=[1e-4, 3e-4, 1e-3]``, trains every seed with each of them, or with each combination of several.

    Returns:
        The agents: for the first values of such hyperparameters one of each seed, then for the next.

    Raises:
        ValueError: if the environment is an object that runs would share, or a setting is not supported or cannot differ; or
            if JAX has no such device.
        MemoryError: if replay buffers and states of all runs need more memory than is free.

    >>> import rejeu
    >>> agents = rejeu.train_seeds(rejeu.DQN, "MlpPolicy", "jax/CartPole-v1", 60, seeds=2, learning_rate=[1e-4, 1e-3])
    >>> [(agent.seed, agent.config.learning_rate) for agent in agents]
    [(0, 0.0001), (1, 0.0001), (0, 0.001), (1, 0.001)]
    """
    if not callable(kind):
        raise TypeError(f"kind={kind!r} must be the class of an algorithm, such as rejeu.SAC")
    if not isinstance(env, str | FunctionalEnv):
        raise ValueError(
            f"env is a {type(env).__name__}, and every run needs environments of its own; give an id, such as 'Pendulum-v1', "
            "or a FunctionalEnv"
        )
    if "seed" in settings:
        raise ValueError(
            f"seed={settings['seed']!r}: the runs have different seeds; give them as seeds, such as seeds=[3, 4]"
        )
    numbers = numbers_of(seeds)
    lists = {name: value for name, value in settings.items() if is_list_of_numbers(value)}
    fixed = {name: value for name, value in settings.items() if name not in lists}
    values = [dict(zip(lists, combination, strict=True)) for combination in itertools.product(*lists.values())]
    agents: list[A] = []
    for combination in values:
        vector = lambda seed: make_vector(env, n_envs, seed=seed)  # noqa: E731
        first = kind(policy, vector(numbers[0]), seed=numbers[0], device=device, **fixed, **combination)
        if not agents:
            require_memory(first, len(numbers) * len(values))
        first.made_from_id = isinstance(env, str)
        agents += [first, *(sibling(first, vector(seed), seed) for seed in numbers[1:])]
    if agents[0].run.env.backend != "jax":
        for agent in agents:
            called = None if callback is None else callback(agent)
            agent.learn(total_timesteps, called, log_interval, progress_bar=progress_bar, minutes=minutes)
        return agents
    calls = [training.start_call(agent, total_timesteps, None, minutes, log_interval, True) for agent in agents]
    callbacks = [listed(None if callback is None else callback(agent)) for agent in agents]
    learn_together(agents, calls, callbacks, progress_bar=progress_bar, differing=tuple(lists))
    return agents


def numbers_of(seeds: int | Iterable[int]) -> list[int]:
    """Returns the seeds that a number of seeds, or the seeds themselves, stand for.

    Raises:
        ValueError: if there is none, or one twice.

    >>> numbers_of(2), numbers_of([7, 3])
    ([0, 1], [7, 3])
    """
    if not isinstance(seeds, Iterable) or isinstance(seeds, str):
        return [*range(whole("seeds", seeds, least=1))]
    numbers = [whole_seed(seed) for seed in seeds]
    if not numbers or len({*numbers}) < len(numbers):
        raise ValueError(f"seeds={seeds!r} must be a number of at least 1, or different seeds")
    return numbers


def is_list_of_numbers(value: object) -> bool:
    """Returns whether the value of a setting is a list of numbers, one for each run.

    >>> is_list_of_numbers([1e-3, 1e-4]), is_list_of_numbers((4, "step")), is_list_of_numbers([True])
    (True, False, False)
    """
    return isinstance(value, list) and bool(value) and all(map(is_number, value))


def sibling(agent: A, env: Any, seed: int) -> A:
    """Returns an agent with the same settings and compiled functions, other environments and another seed."""
    twin = object.__new__(type(agent))
    twin.configure(agent.config, dataclasses.replace(agent.identity, seed=seed, run_id=secrets.token_hex(8)))
    twin.outputs = dataclasses.replace(agent.outputs)
    twin.observation_space, twin.action_space = agent.observation_space, agent.action_space
    twin.obs_leaves, twin.learner = agent.obs_leaves, agent.learner
    twin.start_run(twin.make_envs(env, seed=seed))
    return twin


def learn_together(
    agents: Sequence[Agent],
    calls: Sequence[TrainingCall],
    callbacks: Sequence[Sequence[Callback]],
    sinks: Sequence[Iterable[Sink]] | None = None,
    progress_bar: bool = False,
    differing: Sequence[str] = (),
) -> None:
    """Trains agents of equal settings in one program.

    A callback of a run that returns ``False`` stops that run. Ctrl-C and SIGTERM stop all. An error of one ends all.

    Args:
        agents: with the same environment, number of environments and settings, apart from seeds and ``differing``.
        calls: the limits, equal for all.
        callbacks: of each run.
        sinks: further outputs of each run.
        progress_bar: show the progress of the first run.
        differing: names of float hyperparameters whose values differ.

    Raises:
        ValueError: if the settings cannot be trained on the device, or not with such differences.
    """
    first = agents[0]
    check_differing(first, differing)
    ordered = [in_order(run_callbacks) for run_callbacks in callbacks]
    if progress_bar:
        ordered[0] = [*ordered[0], ProgressBar.of(calls[0])]
    stops = common_stops(agents, calls, ordered)
    remake = remaking(first) if differing else None
    hyper = [{name: float(getattr(agent.config, name)) for name in differing} for agent in agents]
    active = [*range(len(agents))]
    with ExitStack() as stack:
        stack.enter_context(devices.chosen(first.device))
        outputs = sinks or [()] * len(agents)
        sessions = [
            stack.enter_context(training.session(agent, call, run_callbacks, None, more))
            for agent, call, run_callbacks, more in zip(agents, calls, ordered, outputs, strict=True)
        ]
        try:
            with Interrupt() as interrupt:
                turns: Any = train(
                    [agent.run for agent in agents],
                    first.learner,
                    first.config,
                    *training.horizon(first, calls[0]),
                    stops,
                    active,
                    remake,
                    hyper,
                )
                stack.callback(turns.close)  # which copies what is still on the device
                for chunk in named(turns, differing, first):
                    over = [i for i in active if sessions[i](chunk[i])]
                    active[:] = [i for i in active if i not in over]
                    if not active or interrupt.requested:
                        break
            for agent in agents:
                agent.call.interrupted_by = interrupt.signal
        except NonFiniteSteps as broken:
            culprit = agents[broken.which]
            values = [f"{name}={getattr(culprit.config, name):g}" for name in differing]
            raise finite.steps_reported(culprit, broken, f"{', '.join([f'seed {culprit.seed}', *values])}: ") from None


def common_stops(
    agents: Sequence[Agent], calls: Sequence[TrainingCall], callbacks: Sequence[Sequence[Callback]]
) -> Stops:
    """Returns where the program returns to the host: where any of the runs asks for it.

    Raises:
        ValueError: if an agent cannot train on the device, or the limit is a number of episodes.
    """
    every: set[int] = set()
    for agent, call, run_callbacks in zip(agents, calls, callbacks, strict=True):
        if reason := reason_against(agent, run_callbacks):
            raise ValueError(
                f"several runs in one program are not possible: {reason}; use rejeu train --seeds N --jobs M"
            )
        if call.n_episodes is not None:
            raise ValueError("several runs in one program end after steps or minutes, not after episodes")
        agent.call.stops, agent.call.n_together = device.stops_at(call, run_callbacks), len(agents)
        every |= {*agent.call.stops.every}
    return Stops(tuple(sorted(every)))


def reason_against(agent: Agent, callbacks: Sequence[Callback]) -> str | None:
    """Returns why an agent cannot be trained with others in one program, None if it can."""
    assert agent.run.env is not None
    if isinstance(agent.config, OffPolicyConfig) and not isinstance(agent.config.train_freq, int):
        return f"updates depend on episodes (train_freq={agent.config.train_freq!r})"
    return device.reason_against(agent, callbacks)


def check_differing(agent: Agent, names: Iterable[str]) -> None:
    """Raises ``ValueError`` if hyperparameters cannot differ between the runs of one program."""
    config_class: Any = type(agent.config)
    for name in names:
        if name not in field_names(config_class):
            raise ValueError(f"{name} is no hyperparameter of {agent.name} and is equal for all runs; give one value")
        in_replay = name in IN_REPLAY and isinstance(agent.config, OffPolicyConfig)
        if float not in configs.value_types(config_class)[name] or in_replay:
            raise ValueError(
                f"{name} cannot differ between the runs of one program, which is compiled for its value; give one number, or "
                "train one program for each"
            )


def remaking(agent: Agent) -> Callable[[Any], Any]:
    """Returns the function that makes the algorithm of an agent, and its exploration, from other hyperparameters."""

    def make(config: Any) -> Any:
        algorithm = agent.algorithm_of(config)
        return algorithm, exploration.make(algorithm, agent.make_noise())

    return make


def named(turns: Iterator[Any], differing: Sequence[str], agent: Agent) -> Iterator[Any]:
    """Yields ``turns``; an error that a traced hyperparameter causes says which may be the reason.

    Raises:
        ValueError: if Python code depends on the value of a hyperparameter that differs.
    """
    try:
        yield from turns
    except jax.errors.ConcretizationTypeError as error:
        if not differing:
            raise
        raise ValueError(
            f"{agent.name} decides by the value of one of {', '.join(differing)} what it computes, so it cannot differ "
            f"between the runs of one program; give one number ({str(error).splitlines()[0][:120]})"
        ) from None
