"""What one ``learn`` does: turns of the loop until a limit is reached, with callbacks, rows and checkpoints beside them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces

from rejeu import validation
from rejeu.agents import resuming, statistics
from rejeu.agents.best import note_training_return
from rejeu.agents.call import Call
from rejeu.agents.checkpoints import Checkpoint
from rejeu.errors import NonFiniteError
from rejeu.hooks import Hooks, told_apart
from rejeu.interrupt import Interrupt
from rejeu.io.failed_writes import RetryingSink
from rejeu.loops import finite
from rejeu.reporting.logging import Console, Sink, TensorBoard, next_folder

if TYPE_CHECKING:
    from rejeu.agents.base import Agent, Callback


TABLE_SECONDS = 2.0
"""Least time between two tables that ``verbose=1`` prints; other outputs get every row."""


DETERMINISTIC = ("DDPG", "TD3")
"""Algorithms whose policy for continuous actions does not explore by itself."""


class Company(NamedTuple):
    """Who is called in the course of a ``learn``, turn by turn and in this order."""

    outputs: Sequence[Sink]
    """Where rows of statistics go."""
    callbacks: Sequence[Callback]
    """Functions of ``(agent, progress)``."""
    hooks: Hooks
    """Callbacks with hooks."""
    savers: Sequence[Checkpoint]
    """Checkpoints; last, so that they hold what the others did."""


def begin(
    agent: Agent,
    total_timesteps: int | None,
    episodes: int | None,
    minutes: float | None,
    log_interval: int,
    reset_num_timesteps: bool,
) -> Call:
    """Returns what ``learn`` is to do, and readies the agent's counters and environments for it.

    Raises:
        ValueError: without an environment; if no limit is given and there is no ``learn`` to go on with.
    """
    run = agent.run
    if run.env is None:
        raise ValueError("this agent has no environment to learn in; give one to load(path, env=...) or set_env(env)")
    goes_on = total_timesteps is None and minutes is None and episodes is None
    if goes_on:
        call = cut_off(agent)
    else:
        n_steps = None if total_timesteps is None else validation.whole("total_timesteps", total_timesteps, least=1)
        n_episodes = None if episodes is None else validation.whole("episodes", episodes, least=1)
        seconds = None if minutes is None else 60 * validation.number("minutes", minutes, above=0)
        if reset_num_timesteps:
            agent._steps_before, agent._episodes_before = run.step, run.episode
            agent._seconds_before = run.seconds["total"]
        call = Call(
            n_steps,
            n_episodes,
            seconds,
            first_step=run.step,
            first_episode=run.episode,
            log_interval=log_interval,
            logged=len(agent.history),
            steps_before=run.step - agent._steps_before,
            episodes_before=run.episode - agent._episodes_before,
            seconds_before=run.seconds["total"] - agent._seconds_before,
        )
    if run.env.venv is not None and (reset_num_timesteps or goes_on):  # may have been stepped by hand since
        run.obs = run.action = None
    return call


def cut_off(agent: Agent) -> Call:
    """Returns the ``learn`` that a resumed agent was in when it was saved.

    Raises:
        ValueError: if there is none, or if it is complete.
    """
    call = agent._call if agent.resumed is not None else None
    if call is None:
        raise ValueError("learn needs total_timesteps, episodes or minutes (or an agent from resume(), to go on with)")
    if call.is_over(agent.run.step, agent.run.episode):
        raise ValueError(
            "the run is complete; to train on, say how long: total_timesteps (--steps), episodes or minutes (--minutes)"
        )
    return call


def carry_out(
    agent: Agent,
    call: Call,
    callback: Any,
    tb_log_name: str | None,
    progress_bar: bool,
    sinks: Iterable[Sink],
    arguments: dict[str, Any],
) -> None:
    """Trains as ``call`` says.

    Args:
        agent: which learns.
        call: for how long.
        callback: as for ``learn``, as the next three.
        tb_log_name: see there.
        progress_bar: see there.
        sinks: see there.
        arguments: of ``learn``, that callbacks with hooks are told.
    """
    warn_without_noise(agent)
    hooks, callbacks = told_apart(callback)
    savers = [one for one in callbacks if isinstance(one, Checkpoint)]
    callbacks = [one for one in callbacks if not isinstance(one, Checkpoint)]
    agent._call = call
    agent._callbacks = [one for one in (*callbacks, hooks.callback) if hasattr(one, "state_dict")]
    agent.failed_writes.forget_written()
    with ExitStack() as held:
        held.callback(agent.failed_writes.warn)
        outputs = open_outputs(agent, sinks, tb_log_name, held)
        if progress_bar:
            from rejeu.callbacks import ProgressBar

            taken = agent.run.step - call.first_step
            bar = ProgressBar(call.n_steps, call.seconds, taken=taken, spent=call.spent)
            held.callback(bar.close)
            callbacks.append(bar)
        agent.interrupted, agent.interrupted_by = False, None
        agent.run.success_threshold = agent.success_threshold
        held.callback(_stop, agent, agent.logger.outputs)
        agent.logger.outputs, agent._learning = [*outputs], True
        for saver in savers:
            held.enter_context(saver.held(agent))
        remaining = None if call.last_step is None else call.last_step - agent.run.step
        hooks.begin(agent, remaining, arguments)
        saved, agent._saved_callbacks = agent._saved_callbacks, None
        if saved is not None:
            resuming.restore_callbacks(agent._callbacks, saved)
        try:
            with Interrupt() as interrupt:
                iterate(agent, call, Company(outputs, callbacks, hooks, savers), interrupt)
            agent.interrupted, agent.interrupted_by = interrupt.requested, interrupt.signal  # after the last turn, too
            finite.settle(agent)
        except finite.Broken as broken:
            raise finite.reported(agent, broken) from None
        except NonFiniteError:
            raise
        except Exception as error:
            for saver in savers:
                saver.save_after(error, agent)
            raise
        hooks.end()
        for saver in savers:
            saver.attempt(agent)
        agent.failed_writes.retry()


def warn_without_noise(agent: Agent) -> None:
    """Warns, at the beginning of a run, if its policy is deterministic and nothing makes it try other actions."""
    deterministic = agent.name in DETERMINISTIC and isinstance(agent.action_space, spaces.Box)
    if deterministic and agent._noise() is None and agent.run.step == 0:
        warnings.warn(
            f"{agent.name} trains without exploration noise: its policy is deterministic, so after the random steps of "
            f"learning_starts={agent.config.learning_starts} it tries nothing new; set action_noise=0.1 (--set "
            "action_noise=0.1), 'ou(0.2)' or ParameterNoise()",
            UserWarning,
            stacklevel=4,
        )


def open_outputs(
    agent: Agent, sinks: Iterable[Sink], tb_log_name: str | None, held: ExitStack
) -> Sequence[RetryingSink]:
    """Returns where rows of statistics go; ``held`` closes those that are opened here."""
    loggers = agent.logger.outputs
    outputs: list[Sink] = [*sinks, *loggers]
    if agent.verbose and not loggers:
        console = Console(TABLE_SECONDS)
        held.callback(console.close)
        outputs.append(console)
    if agent.tensorboard_log is not None and not loggers:
        tensorboard = TensorBoard(next_folder(agent.tensorboard_log, tb_log_name or agent.name))
        held.callback(tensorboard.close)
        outputs.append(tensorboard)
    return [RetryingSink(output, agent.failed_writes) for output in outputs]


def _stop(agent: Agent, loggers: list[Sink]) -> None:
    """Gives back what ``learn`` held, however it ended."""
    agent.logger.outputs, agent._learning = loggers, False


def iterate(agent: Agent, call: Call, company: Company, interrupt: Interrupt) -> None:
    """Trains until a limit is reached, a callback says so or Ctrl-C is pressed."""
    run, first = agent.run, agent.run.step
    remaining = None if call.last_step is None else call.last_step - first
    for turn in agent._turns(remaining, lambda taken: call.progress(first + taken, run.episode)):
        agent.steps_per_second = (turn.step - call.first_step) / max(call.elapsed, 1e-9)
        for episode in turn.episodes:
            statistics.record(agent, episode)
        if len(agent.history) - call.logged >= call.log_interval and company.outputs:
            call.logged = len(agent.history)
            row = agent.statistics() | agent.logger.take()
            for output in company.outputs:
                output.write(agent.num_timesteps, row)
        if turn.episodes:
            note_training_return(agent, len(turn.episodes))
        answers = [callback(agent, turn) for callback in company.callbacks]
        answers.append(company.hooks.step(agent, turn, run.obs))
        for saver in company.savers:
            saver(agent, turn)
        agent.failed_writes.retry_if_due()
        agent.interrupted, agent.interrupted_by = interrupt.requested, interrupt.signal
        refused = any(isinstance(answer, bool | np.bool_) and not answer for answer in answers)
        if refused or agent.interrupted or call.is_over(turn.step, run.episode):
            break
