"""Training: what one call of ``learn`` does, from its limits to callbacks, statistics and the best weights."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from gymnasium import spaces

from rejeu import schedules, xla
from rejeu.agents import device
from rejeu.agents.base import BaseAgent, Best
from rejeu.agents.model_files import WRONG, brief
from rejeu.algorithms import config as configs
from rejeu.callbacks.base import Callback, Stateful, TrainingCallback
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.errors import CheckpointError
from rejeu.interrupt import Interrupt
from rejeu.io.records import shown
from rejeu.loops import finite
from rejeu.loops.nonfinite import NonFiniteUpdate
from rejeu.loops.run import Episode, Progress
from rejeu.loops.timing import time_shares
from rejeu.loops.training_call import TrainingCall
from rejeu.reporting.logging import Console, RetryingSink, Sink, guarded, next_folder, open_log
from rejeu.reporting.text import counted
from rejeu.reporting.trackers import Background
from rejeu.validation import number, whole

TABLE_SECONDS = 2.0
"""Least time between two tables that ``verbose=1`` prints; other outputs get every row."""
LOG_FOLDER = "logs"
"""Folder of the folders of logs, in the current folder."""
HIDDEN = (
    "rejeu: progress.action, progress.result and progress.last_obs are None, because callbacks are called between chunks of "
    "turns here; to be called after every step, set agent.on_device = False, or derive the callback from "
    "rejeu.callbacks.TrainingCallback with every_step = True"
)
"""What is added to the error of a callback that needs what a chunk hides."""
DETERMINISTIC = ("DDPG", "TD3")
"""Algorithms whose policy for continuous actions does not explore by itself."""
LOGGED_AS = {"exploration_rate": "rollout/exploration_rate"}
"""Names of metrics in the log, where they are not ``train/NAME``."""
RENAMED_CALLBACKS = {"Film": "RecordVideo"}
"""Classes of callbacks that older checkpoints know by another name."""


def start_call(
    agent: BaseAgent,
    total_timesteps: int | None,
    episodes: int | None,
    minutes: float | None,
    log_interval: int,
    reset_num_timesteps: bool,
) -> TrainingCall:
    """Returns the limits of a call of ``learn``, and prepares the agent's counters and environments for it.

    Raises:
        ValueError: without an environment; without a limit, unless the agent resumes an unfinished ``learn``.
    """
    run = agent.run
    if run.env is None:
        raise ValueError("this agent has no environment to learn in; give one to load(path, env=...) or set_env(env)")
    resumes = total_timesteps is None and minutes is None and episodes is None
    if resumes:
        call = unfinished_call(agent)
    else:
        n_steps = None if total_timesteps is None else whole("total_timesteps", total_timesteps, least=1)
        n_episodes = None if episodes is None else whole("episodes", episodes, least=1)
        seconds = None if minutes is None else 60 * number("minutes", minutes, above=0)
        if reset_num_timesteps:
            agent.reset_step, agent.reset_episode = run.step, run.episode
            agent.reset_seconds = run.seconds["total"]
        call = TrainingCall(
            n_steps,
            n_episodes,
            seconds,
            first_step=run.step,
            first_episode=run.episode,
            log_interval=log_interval,
            logged=len(agent.history),
            steps_before=run.step - agent.reset_step,
            episodes_before=run.episode - agent.reset_episode,
            seconds_before=run.seconds["total"] - agent.reset_seconds,
        )
    if run.env.venv is not None and (reset_num_timesteps or resumes):  # may have been stepped by hand since
        run.obs = run.action = None
    return call


def unfinished_call(agent: BaseAgent) -> TrainingCall:
    """Returns the ``learn`` that a resumed agent was in when it was saved.

    Raises:
        ValueError: if there is none, or if it is complete.
    """
    call = agent.training_call if agent.resumed is not None else None
    if call is None:
        raise ValueError("learn needs total_timesteps, episodes or minutes (or an agent from resume(), to continue)")
    if call.is_over(agent.run.step, agent.run.episode):
        raise ValueError(
            "the run is complete; to train on, say how long: total_timesteps (--steps), episodes or minutes (--minutes)"
        )
    return call


def train(
    agent: BaseAgent,
    call: TrainingCall,
    callback: Callback | Iterable[Callback] | None,
    tb_log_name: str | None,
    progress_bar: bool,
    sinks: Iterable[Sink],
) -> None:
    """Trains until a limit of ``call`` is reached, a callback returns ``False``, or Ctrl-C or SIGTERM arrives.

    The other arguments are those of :meth:`Agent.learn`.
    """
    warn_without_noise(agent)
    bar = []
    if progress_bar:
        taken = agent.run.step - call.first_step
        bar = [ProgressBar(call.n_steps, call.seconds, taken=taken, spent=call.spent)]
    callbacks = in_order([*listed(callback), *bar])
    agent.stops = device.stops_of(agent, call, callbacks)
    if agent.stops is not None:
        device.require_memory(agent)
    with session(agent, call, callbacks, tb_log_name, sinks) as record:
        try:
            with Interrupt() as interrupt:
                for turn in agent.loop(*horizon(agent, call)):
                    if record(turn) or interrupt.requested:
                        break
            agent.interrupted, agent.interrupted_by = interrupt.requested, interrupt.signal
            finite.settle(agent)
        except NonFiniteUpdate as broken:
            raise finite.reported(agent, broken) from None


@contextmanager
def session(
    agent: BaseAgent,
    call: TrainingCall,
    callbacks: Sequence[Callback],
    tb_log_name: str | None = None,
    sinks: Iterable[Sink] = (),
) -> Iterator[Callable[[Progress], bool]]:
    """While entered, the agent is learning: outputs are open, and callbacks were told.

    Yields a function that is called after every turn of the loop. It records the turn, calls the callbacks, and returns
    whether training is over.
    """
    agent.training_call = call
    agent.callbacks = stateful(callbacks)
    agent.interrupted, agent.interrupted_by = False, None
    agent.run.success_threshold = agent.success_threshold
    agent.failed_writes.forget_written()
    with ExitStack() as stack:
        stack.callback(agent.failed_writes.warn)
        outputs = open_outputs(agent, sinks, tb_log_name, stack)
        stack.callback(agent.failed_writes.retry)
        for output in outputs:
            output.write_config(run_config(agent, call))
        stack.enter_context(marked_as_learning(agent, outputs))
        stack.enter_context(listening(agent, callbacks))

        def record(turn: Progress) -> bool:
            record_turn(agent, call, turn, outputs)
            answers = [called(callback, agent, turn) for callback in callbacks]
            agent.failed_writes.retry_if_due()
            stopped = any(isinstance(answer, bool | np.bool_) and not answer for answer in answers)
            return stopped or call.is_over(turn.step, agent.run.episode)

        yield record


def called(callback: Callback, agent: BaseAgent, turn: Progress) -> bool | None:
    """Returns the answer of a callback; an error because it looked at a single step of a chunk says so."""
    try:
        return callback(agent, turn)
    except (AttributeError, TypeError) as error:
        if turn.result is None and "NoneType" in str(error):
            error.add_note(HIDDEN)
        raise


def horizon(agent: BaseAgent, call: TrainingCall) -> tuple[int | None, Callable[[int], float]]:
    """Returns the number of steps that are left to take, and the progress of schedules after a number of them."""
    run, first = agent.run, agent.run.step
    remaining = None if call.last_step is None else call.last_step - first
    return remaining, lambda taken: call.progress(first + taken, run.episode)


def listed(callback: Callback | Iterable[Callback] | None) -> list[Callback]:
    """Returns one callback, several or none as a list."""
    return [] if callback is None else [callback] if callable(callback) else [*callback]


def in_order(callbacks: Iterable[Callback]) -> list[Callback]:
    """Returns callbacks in the order in which they are called: those that run last after the others."""
    return sorted(callbacks, key=lambda callback: isinstance(callback, TrainingCallback) and callback.runs_last)


def stateful(callbacks: Iterable[Any]) -> list[Stateful]:
    """Returns the callbacks whose state a checkpoint contains."""
    return [one for one in callbacks if isinstance(one, Stateful)]


@contextmanager
def listening(agent: BaseAgent, callbacks: Sequence[Callback]) -> Iterator[None]:
    """Tells callbacks that training starts and, on exit, that it has ended; restores their state in a resumed run."""
    started: list[TrainingCallback] = []
    error: BaseException | None = None
    saved = None if agent.saved_callbacks is None else unpacked(agent.saved_callbacks, callbacks)
    try:
        for callback in callbacks:
            if isinstance(callback, TrainingCallback):
                callback.before_training(agent)
                started.append(callback)
            if saved is not None and isinstance(callback, Stateful):
                restore_callback(callback, saved)
        agent.saved_callbacks = None
        if saved:
            names = shown(", ".join(name for name, _ in saved))
            warnings.warn(f"the run was saved with {names}, which learn was not given now", UserWarning, stacklevel=6)
        yield
    except BaseException as raised:
        error = raised
        raise
    finally:
        with ExitStack() as ends:
            for one in reversed(started):
                ends.callback(one.after_training, agent, error)


def restore_callbacks(agent: BaseAgent, callbacks: Sequence[Callback]) -> None:
    """Restores the state of callbacks of a resumed run that is not trained further.

    Raises:
        CheckpointError: if a saved state is damaged.
    """
    saved = unpacked(agent.saved_callbacks or (), callbacks)
    for callback in callbacks:
        if isinstance(callback, Stateful):
            restore_callback(callback, saved)


def unpacked(saved: Sequence[tuple[str, Any]], callbacks: Sequence[Callback]) -> list[tuple[str, Any]]:
    """Returns the saved states of callbacks under the present names of their classes.

    Older checkpoints hold several callbacks with hooks as one ``CallbackList``.

    Raises:
        CheckpointError: if such a list is damaged.
    """
    given = {type(callback).__name__ for callback in callbacks}
    states: list[tuple[str, Any]] = []
    for name, state in saved:
        try:
            inside = state["inside"] if name == "CallbackList" and name not in given else [(name, state)]
            states += [(RENAMED_CALLBACKS.get(inner, inner), part) for inner, part in inside]
        except WRONG as error:
            raise CheckpointError(f"the saved state of {name} is damaged: {brief(error)}") from error
    return states


def restore_callback(callback: Stateful, saved: list[tuple[str, Any]]) -> None:
    """Restores a callback from the first saved state of its class, which is removed from ``saved``; warns without one.

    Raises:
        CheckpointError: if that state is damaged.
    """
    name = type(callback).__name__
    match = next((entry for entry in saved if entry[0] == name), None)
    if match is None:
        warnings.warn(f"the run was saved without a {name}; it starts from the beginning", UserWarning, stacklevel=7)
        return
    saved.remove(match)
    try:
        callback.load_state_dict(match[1])
    except WRONG as error:
        raise CheckpointError(f"the saved state of {name} is damaged: {brief(error)}") from error


@contextmanager
def marked_as_learning(agent: BaseAgent, outputs: Sequence[Sink]) -> Iterator[None]:
    """While entered, the agent counts as learning, and its logger writes to ``outputs``."""
    loggers = agent.logger.outputs
    agent.logger.outputs, agent.is_learning = [*outputs], True
    try:
        yield
    finally:
        agent.logger.outputs, agent.is_learning = loggers, False


def record_turn(agent: BaseAgent, call: TrainingCall, turn: Progress, outputs: Sequence[Sink]) -> None:
    """Adds what one turn of the loop did to the statistics, writes a row if one is due, and keeps the best weights."""
    agent.steps_per_second = (turn.step - call.first_step) / max(call.elapsed, 1e-9)
    for episode in turn.episodes:
        record_episode(agent, episode)
    if len(agent.history) - call.logged >= call.log_interval and outputs:
        call.logged = len(agent.history)
        row = statistics_row(agent) | agent.logger.take()
        for output in outputs:
            output.write(agent.num_timesteps, row)
    if ended := device.episodes_to_judge(agent, call, turn):
        note_training_return(agent, ended)


def warn_without_noise(agent: BaseAgent) -> None:
    """Warns at the start of a run if the policy is deterministic and there is no exploration noise."""
    deterministic = agent.name in DETERMINISTIC and isinstance(agent.action_space, spaces.Box)
    if deterministic and agent.make_noise() is None and agent.run.step == 0:
        warnings.warn(
            f"{agent.name} trains without exploration noise: its policy is deterministic, so after the random steps of "
            f"learning_starts={agent.config.learning_starts} it explores nothing new; set action_noise=0.1 (--set "
            "action_noise=0.1), 'ou(0.2)' or ParameterNoise()",
            UserWarning,
            stacklevel=4,
        )


def open_outputs(
    agent: BaseAgent, sinks: Iterable[Sink], tb_log_name: str | None, stack: ExitStack
) -> Sequence[RetryingSink | Background]:
    """Returns the outputs for rows of statistics; ``stack`` closes those that are opened here."""
    given, opened = [*sinks, *agent.logger.outputs], list[Sink]()
    if agent.verbose and not agent.logger.outputs:
        opened.append(Console(TABLE_SECONDS))
    if agent.log and not agent.logger.outputs:
        folder = next_folder(agent.tensorboard_log or LOG_FOLDER, tb_log_name or agent.name)
        opened += [open_log(kind, folder, run_name(agent), tracker_id(agent)) for kind in agent.log]
    outputs = [guarded(one, agent.failed_writes) for one in given]
    for one, output in zip(given, outputs, strict=True):
        if isinstance(output, Background) and output is not one:
            stack.callback(output.close)
    for one in opened:
        outputs.append(guarded(one, agent.failed_writes, closes=True))
        stack.callback(outputs[-1].close)
    return outputs


def run_name(agent: BaseAgent) -> str:
    """Returns a name for the run in a tracker: environment, algorithm, seed and :func:`tracker_id`."""
    assert agent.env is not None
    return f"{agent.env.env_id}-{agent.name}-seed{agent.seed}-{tracker_id(agent)}"


def tracker_id(agent: BaseAgent) -> str:
    """Returns what identifies the run in a tracker. A ``learn`` that counts steps from 0 starts another run."""
    return agent.run_id + (f"-{agent.reset_step}" if agent.reset_step else "")


def run_config(agent: BaseAgent, call: TrainingCall) -> dict[str, Any]:
    """Returns what trackers show as the configuration of a run: environment, algorithm, limits, hyperparameters."""
    assert agent.env is not None
    return {
        "algorithm": agent.name,
        "env_id": agent.env.env_id,
        "n_envs": agent.n_envs,
        "backend": agent.env.backend,
        "policy": agent.policy,
        "seed": agent.seed,
        "total_timesteps": call.n_steps,
        "episodes": call.n_episodes,
        "minutes": None if call.seconds is None else call.seconds / 60,
        **configs.to_json(agent.config),
    }


def note_training_return(agent: BaseAgent, ended: int) -> None:
    """Keeps the current weights if the mean return of the last ``best_window`` episodes is the best so far.

    Each of the ``ended`` episodes that have just finished is the last of a window.
    """
    window = agent.best_window
    returns = [episode.episode_return for episode in agent.history.last(window + ended - 1)]
    if len(returns) >= window and (agent.best is None or agent.best.by == "training"):
        means = np.lib.stride_tricks.sliding_window_view(returns, window).mean(axis=-1)
        remember_best(agent, float(means.max()), "training")


def remember_best(agent: BaseAgent, score: float | tuple[float, ...], by: str) -> bool:
    """Keeps the current weights if ``score`` is the best of its kind so far; returns whether it is."""
    if agent.best is not None and agent.best.by == by and score <= agent.best.score:  # type: ignore[operator]
        return False
    finite.settle(agent)
    agent.best = Best(score, by, agent.run.step, agent.learner.copy(agent.run.state))
    return True


def restore_best(agent: BaseAgent) -> None:
    """Restores the best weights.

    Raises:
        ValueError: if there are none yet.
    """
    if agent.best is None:
        raise ValueError(
            f"no best weights are known yet: they are kept after {counted(agent.best_window, 'episode')} of training, "
            "and at every evaluation by rejeu.callbacks.Evaluate"
        )
    agent.run.state = agent.learner.copy(agent.best.state)
    agent.drop_rollout()


def record_episode(agent: BaseAgent, episode: Episode) -> None:
    """Adds an episode to the history and to the buffers of recent episodes."""
    agent.history.append(episode)
    agent.ep_info_buffer.append({"r": episode.episode_return, "l": episode.length, "t": episode.seconds})
    if not math.isnan(episode.success):
        agent.ep_success_buffer.append(episode.success)


def fill_windows(agent: BaseAgent) -> None:
    """Fills the buffers of recent episodes from the history."""
    episodes = agent.history.last(agent.stats_window_size)
    agent.ep_info_buffer.extend({"r": e.episode_return, "l": e.length, "t": e.seconds} for e in episodes)
    successes = agent.history["success"]
    agent.ep_success_buffer.extend(successes[~np.isnan(successes)][-agent.stats_window_size :].tolist())


def statistics_row(agent: BaseAgent) -> dict[str, float]:
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
    numbers["time/fps"] = float(agent.steps_per_second)
    numbers["time/time_elapsed"] = run.seconds["total"]
    numbers["time/total_timesteps"] = agent.num_timesteps
    for part, share in time_shares(run.seconds).items():
        numbers[f"time/{part}_share"] = share
    numbers["time/compile_seconds"] = xla.seconds()
    numbers["train/n_updates"] = run.n_updates
    if agent.learner.skips:
        numbers["train/skipped_updates"] = run.monitor.n_skipped
    if agent.training_call is not None:
        progress = agent.training_call.progress(run.step, run.episode)
        numbers["train/learning_rate"] = float(schedules.at(agent.config.learning_rate, progress))
    for key, value in (run.metrics or {}).items():
        numbers[LOGGED_AS.get(key, f"train/{key}")] = float(value)
    return numbers
