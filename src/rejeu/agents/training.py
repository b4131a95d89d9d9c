"""Training: what one call of ``learn`` does, from its limits to callbacks, statistics and the best weights."""

from __future__ import annotations

import dataclasses
import math
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces

from rejeu import xla
from rejeu.agents.model_files import WRONG, brief
from rejeu.agents.run_files import Checkpoint
from rejeu.errors import CheckpointError, NonFiniteError
from rejeu.hooks import Hooks, told_apart
from rejeu.interrupt import Interrupt
from rejeu.io.failed_writes import RetryingSink
from rejeu.io.records import Count, Duration, Positive, Seconds, convert
from rejeu.loops import finite
from rejeu.loops.learner import PackedState
from rejeu.loops.run import Episode, time_shares
from rejeu.reporting.logging import Console, Sink, TensorBoard, next_folder
from rejeu.reporting.text import counted
from rejeu.validation import number, whole

if TYPE_CHECKING:
    from rejeu.agents.base import Agent, Callback


@dataclass
class Call:
    """One call of ``learn``. Mutable: ``logged`` moves on."""

    n_steps: Positive | None
    """Environment steps to take, None where something else ends it."""
    n_episodes: Positive | None
    """Episodes to finish, likewise."""
    seconds: Duration | None
    """Wall time to take, likewise."""
    first_step: Count
    """Environment steps taken in all when it began."""
    first_episode: Count
    """Episodes finished in all when it began."""
    log_interval: Count
    """Episodes between two rows of statistics."""
    logged: Count
    """Episodes in the history when the last row was written."""
    steps_before: Count = 0
    """Environment steps that schedules count as taken before it: those since the last ``learn`` that began to count."""
    episodes_before: Count = 0
    """Episodes likewise."""
    seconds_before: Seconds = 0.0
    """Training time likewise."""
    spent: Seconds = 0.0
    """Wall time that it had taken when it was last taken up, in seconds."""
    began: float = dataclasses.field(default_factory=time.perf_counter)
    """When it was begun or last taken up, by ``time.perf_counter``."""

    @property
    def elapsed(self) -> float:
        """Wall time that it has taken, interruptions left out, in seconds."""
        return self.spent + time.perf_counter() - self.began

    @property
    def last_step(self) -> int | None:
        """Environment steps taken in all when it will be over, None where something else ends it."""
        return None if self.n_steps is None else self.first_step + self.n_steps

    def progress(self, step: int, episode: int) -> float:
        """Returns the progress of schedules, in [0, 1], when so many steps and episodes have passed in all.

        As in Stable-Baselines3, what came before counts as done, and as part of the whole: with 100 steps before and 300
        to take, progress goes from 0.25 to 1. Of several limits the nearest counts.
        """
        by_steps = share(self.steps_before, step - self.first_step, self.n_steps)
        by_episodes = share(self.episodes_before, episode - self.first_episode, self.n_episodes)
        by_time = share(self.seconds_before, self.elapsed, self.seconds)
        return min(max(by_steps, by_episodes, by_time), 1.0)

    def is_over(self, step: int, episode: int) -> bool:
        """Returns whether one of its limits is reached."""
        by_steps = self.last_step is not None and step >= self.last_step
        by_episodes = self.n_episodes is not None and episode - self.first_episode >= self.n_episodes
        return by_steps or by_episodes or (self.seconds is not None and self.elapsed >= self.seconds)

    def to_json(self) -> dict[str, Any]:
        """Returns it as plain JSON values."""
        return {**{key: getattr(self, key) for key in SAVED}, "spent": self.elapsed}

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> Call:
        """Returns the call that :meth:`to_json` described, continued now.

        Raises:
            CheckpointError: if it is damaged.
        """
        call = convert(saved, cls)
        call.began = time.perf_counter()
        return call


def share(before: float, taken: float, limit: float | None) -> float:
    """Returns which share of ``before + limit`` is done once ``taken`` more have passed; 0 without a limit.

    >>> share(100, 0, 300), share(100, 300, 300), share(100, 50, None)
    (0.25, 1.0, 0.0)
    """
    return 0.0 if limit is None else (before + taken) / (before + limit)


SAVED = [field.name for field in dataclasses.fields(Call) if field.name not in ("spent", "began")]


class Best(NamedTuple):
    """The best weights of a run so far."""

    score: float | tuple[float, ...]
    """Mean training return, or what evaluations are judged by: success rate and mean return."""
    by: str
    """``"training"`` or ``"evaluation"``."""
    step: int
    """Environment steps taken when they were kept."""
    state: PackedState
    """The algorithm's whole state at that moment, packed."""


def note_training_return(agent: Agent, ended: int) -> None:
    """Keeps the present weights if ``ended`` episodes that have just ended bring the best mean return so far.

    Where several ended at once, each of them closes a window of its own.
    """
    window = agent.best_window
    returns = [episode.episode_return for episode in agent.history.last(window + ended - 1)]
    if len(returns) >= window and (agent.best is None or agent.best.by == "training"):
        means = np.lib.stride_tricks.sliding_window_view(returns, window).mean(axis=-1)
        agent.remember_best(float(means.max()), "training")


def remember_best(agent: Agent, score: float | tuple[float, ...], by: str) -> bool:
    """Keeps the present weights if ``score`` is the best of its kind so far; returns whether it is."""
    if agent.best is not None and agent.best.by == by and score <= agent.best.score:  # type: ignore[operator]
        return False
    finite.settle(agent)
    agent.best = Best(score, by, agent.run.step, agent.learner.copy(agent.run.state))
    return True


def restore_best(agent: Agent) -> None:
    """Puts the best weights back.

    Raises:
        ValueError: if none were kept yet.
    """
    if agent.best is None:
        raise ValueError(
            f"no best weights are known yet: they are kept once {counted(agent.best_window, 'episode')} of training "
            "ended, and at every evaluation by rejeu.callbacks.Evaluate"
        )
    agent.run.state = agent.learner.copy(agent.best.state)
    agent._drop_rollout()


def record_episode(agent: Agent, episode: Episode) -> None:
    """Adds an episode to the history and to the windows."""
    agent.history.append(episode)
    agent.ep_info_buffer.append({"r": episode.episode_return, "l": episode.length, "t": episode.seconds})
    if not math.isnan(episode.success):
        agent.ep_success_buffer.append(episode.success)


def fill_windows(agent: Agent) -> None:
    """Fills the windows from the history."""
    episodes = agent.history.last(agent.stats_window_size)
    agent.ep_info_buffer.extend({"r": e.episode_return, "l": e.length, "t": e.seconds} for e in episodes)
    successes = agent.history["success"]
    agent.ep_success_buffer.extend(successes[~np.isnan(successes)][-agent.stats_window_size :].tolist())


def statistics_row(agent: Agent) -> dict[str, float]:
    """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
    numbers: dict[str, float] = {}
    if agent.ep_info_buffer:
        numbers["rollout/ep_len_mean"] = float(np.mean([e["l"] for e in agent.ep_info_buffer]))
        numbers["rollout/ep_rew_mean"] = float(np.mean([e["r"] for e in agent.ep_info_buffer]))
        numbers["rollout/ep_rew_best"] = agent.history.best_return
    if agent.ep_success_buffer:
        numbers["rollout/success_rate"] = float(np.mean(agent.ep_success_buffer))
    run = agent.run
    numbers["time/episodes"] = run.episode
    numbers["time/steps_per_second"] = float(agent.steps_per_second)
    numbers["time/seconds"] = run.seconds["total"]
    for part, share in time_shares(run.seconds).items():
        numbers[f"time/{part}_share"] = share
    numbers["time/compile_seconds"] = xla.seconds()
    numbers["train/n_updates"] = run.n_updates
    if agent.learner.skips:
        numbers["train/skipped_updates"] = run.watch.n_skipped
    for key, value in (run.metrics or {}).items():
        numbers[f"train/{key}"] = float(value)
    return numbers


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
        n_steps = None if total_timesteps is None else whole("total_timesteps", total_timesteps, least=1)
        n_episodes = None if episodes is None else whole("episodes", episodes, least=1)
        seconds = None if minutes is None else 60 * number("minutes", minutes, above=0)
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
            restore_callbacks(agent._callbacks, saved)
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
            record_episode(agent, episode)
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


def restore_callbacks(callbacks: Sequence[Any], saved: Sequence[Any]) -> None:
    """Gives callbacks what those of the same kind remembered when the run was saved, in order.

    Those for which nothing was saved begin anew, with a warning, and what was saved for others is passed over likewise.
    """
    left = [(name, state) for name, state in saved]
    for one in callbacks:
        name = type(one).__name__
        match = next((entry for entry in left if entry[0] == name), None)
        if match is None:
            warnings.warn(f"the run was saved without a {name}; it begins anew", UserWarning, stacklevel=4)
            continue
        left.remove(match)
        try:
            one.load_state_dict(match[1])
        except WRONG as error:
            raise CheckpointError(f"what {name} remembered is damaged: {brief(error)}") from error
    if left:
        names = ", ".join(name for name, _ in left)
        warnings.warn(f"the run was saved with {names}, which learn was not given now", UserWarning, stacklevel=4)
