"""Training: what one call of ``learn`` does, from its limits to statistics, their outputs, and the best weights."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

import gymnasium as gym
import numpy as np

from rejeu.agents import device
from rejeu.algorithms import config as configs
from rejeu.algorithms.catalog import CATALOG
from rejeu.callbacks.base import Callback, called, in_order, listed, listening, runs_last, stateful
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.checkpoints.agent_state import AnyAgent, Best
from rejeu.core import schedules, xla
from rejeu.core.interrupt import Interrupt
from rejeu.core.types import JsonObject
from rejeu.envs import snapshot
from rejeu.exploration.noise import warn_without_noise
from rejeu.logs.logging import Console, GuardedSink, Sink, guarded, next_folder, open_log
from rejeu.training import finite
from rejeu.training.finite import NonFiniteSteps, NonFiniteUpdate
from rejeu.training.run import Progress, TrainingCall, checked_limits, last_countable, time_shares

TABLE_SECONDS = 2.0
"""Least time between two tables that ``verbose=1`` prints; other outputs get every row."""
HINT_SECONDS, HINT_RATE = 10.0, 200.0
"""After so many seconds of training, at fewer steps a second, a run may get a hint."""
DETERMINISTIC = {name for name, entry in CATALOG.items() if entry.is_deterministic}
LOG_FOLDER = "logs"
"""Folder of the folders of logs, in the current folder."""
LOGGED_AS = {"exploration_rate": "rollout/exploration_rate"}
"""Names of metrics in the log, where they are not ``train/NAME``."""


def open_outputs(
    agent: AnyAgent, sinks: Iterable[Sink], tb_log_name: str | None, stack: ExitStack
) -> Sequence[GuardedSink]:
    """Returns the outputs for rows of statistics; ``stack`` closes those that are opened here."""
    passed, opened = [*sinks, *agent.logger.outputs], list[Sink]()
    if agent.outputs.verbose and not agent.logger.outputs:
        opened.append(Console(TABLE_SECONDS))
    if agent.outputs.log and not agent.logger.outputs:
        folder = next_folder(agent.outputs.tensorboard_log or LOG_FOLDER, tb_log_name or agent.name)
        opened += [open_log(name, folder, run_name(agent), tracker_id(agent)) for name in agent.outputs.log]
    outputs = [guarded(sink, agent.files.failed_writes, closes=sink in opened) for sink in [*passed, *opened]]
    for sink, output in zip([*passed, *opened], outputs, strict=True):
        if sink in opened or (output.in_background and output is not sink):
            stack.callback(output.close)
    return outputs


def run_name(agent: AnyAgent) -> str:
    """Returns a name for the run in a tracker: environment, algorithm, seed and :func:`tracker_id`."""
    return f"{agent.run.env.env_id}-{agent.name}-seed{agent.identity.seed}-{tracker_id(agent)}"


def tracker_id(agent: AnyAgent) -> str:
    """Returns the id of the run in a tracker. A ``learn`` that counts steps from 0 starts another run."""
    return agent.identity.run_id + (f"-{agent.call.reset_step}" if agent.call.reset_step else "")


def run_config(agent: AnyAgent, call: TrainingCall) -> JsonObject:
    """Returns the configuration of a run for trackers: environment, algorithm, limits, hyperparameters."""
    return {
        "algorithm": agent.name,
        "env_id": agent.run.env.env_id,
        "n_envs": agent.n_envs,
        "backend": agent.run.env.backend,
        "policy": agent.identity.policy_name,
        "seed": agent.identity.seed,
        "total_timesteps": call.n_steps,
        "episodes": call.n_episodes,
        "minutes": None if call.seconds is None else call.seconds / 60,
        **configs.to_json(agent.config),
    }


def statistics_row(agent: AnyAgent) -> dict[str, float]:
    """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
    numbers: dict[str, float] = {}
    if agent.record.ep_info_buffer:
        numbers["rollout/ep_len_mean"] = float(np.mean([e["l"] for e in agent.record.ep_info_buffer]))
        numbers["rollout/ep_rew_mean"] = float(np.mean([e["r"] for e in agent.record.ep_info_buffer]))
    if len(agent.record.history):
        numbers["rollout/ep_rew_best"] = agent.record.history.best_return
    if agent.record.ep_success_buffer:
        numbers["rollout/success_rate"] = float(np.mean(agent.record.ep_success_buffer))
    run = agent.run
    numbers["time/episodes"] = run.episode
    numbers["time/fps"] = float(agent.record.steps_per_second)
    numbers["time/time_elapsed"] = run.seconds["total"]
    numbers["time/total_timesteps"] = agent.num_timesteps
    for phase, share in time_shares(run.seconds).items():
        numbers[f"time/{phase}_share"] = share
    numbers["time/compile_seconds"] = xla.seconds()
    numbers["train/n_updates"] = run.n_updates
    if agent.learner.skips:
        numbers["train/skipped_updates"] = run.monitor.n_skipped
    if agent.call.training_call is not None:
        progress = agent.call.training_call.progress(run.step, run.episode)
        numbers["train/learning_rate"] = float(schedules.at(agent.config.learning_rate, progress))
    for key, value in (run.metrics or {}).items():
        numbers[LOGGED_AS.get(key, f"train/{key}")] = float(value)
    return numbers


STEPS_OF_A_ROW = 250
"""Gradient steps that count as an episode for rows of statistics, where no environment is stepped."""


def start_call(
    agent: AnyAgent,
    total_timesteps: int | None,
    episodes: int | None,
    minutes: float | None,
    log_interval: int,
    reset_num_timesteps: bool,
) -> TrainingCall:
    """Returns the limits of a call of ``learn``, and prepares the agent's counters and environments for it.

    Raises:
        ValueError: without an environment; without a limit, unless the agent resumes an unfinished ``learn``; if the steps
            are too many to be counted with 32 bits.
        RuntimeError: if the agent is learning.
    """
    if agent.call.is_learning:
        raise RuntimeError(
            "this agent is learning already, in another thread or around a callback; let that learn return first, or "
            "give each thread an agent of its own"
        )
    run = agent.run
    if run.env is None:
        raise ValueError("this agent has no environment to learn in; give one to load(path, env=...) or set_env(env)")
    if run.step == 0 and (doubt := agent.config.doubts(run.env.n_envs)):
        warnings.warn(doubt, UserWarning, stacklevel=3)
    resumes = total_timesteps is None and minutes is None and episodes is None
    if resumes:
        call = unfinished_call(agent)
    else:
        limits = checked_limits(total_timesteps, episodes, minutes)
        last = None if limits[0] is None else run.step + agent.steps_to_take(limits[0])
        if last is not None and last > last_countable(run):
            raise ValueError(
                f"the run would end at step {last:,}, and steps are counted up to {last_countable(run):,}; give fewer "
                "total_timesteps, or minutes"
            )
        if reset_num_timesteps:
            agent.call.reset_step, agent.call.reset_episode = run.step, run.episode
            agent.call.reset_seconds = run.seconds["total"]
        call = TrainingCall(
            *limits,
            first_step=run.step,
            first_episode=run.episode,
            log_interval=log_interval,
            logged=run.step // STEPS_OF_A_ROW if is_offline(agent) else len(agent.record.history),
            steps_before=run.step - agent.call.reset_step,
            episodes_before=run.episode - agent.call.reset_episode,
            seconds_before=run.seconds["total"] - agent.call.reset_seconds,
            last_step=last,
        )
    is_touched = run.fingerprint is not None and run.fingerprint != snapshot.fingerprint(run.env)
    if is_touched or (run.env.venv is not None and (reset_num_timesteps or resumes)):  # or stepped by hand unseen
        run.obs = run.action = None
    return call


def unfinished_call(agent: AnyAgent) -> TrainingCall:
    """Returns the ``learn`` that a resumed agent was in when it was saved.

    Raises:
        ValueError: if there is none, or if it is complete.
    """
    call = agent.call.training_call if agent.resumed is not None else None
    if call is None:
        raise ValueError("learn needs total_timesteps, episodes or minutes (or an agent from resume(), to continue)")
    if call.is_over(agent.run):
        raise ValueError(
            "the run is complete; to train on, say how long: total_timesteps (--steps), episodes or minutes (--minutes)"
        )
    return call


def train(
    agent: AnyAgent,
    call: TrainingCall,
    callback: Callback | Iterable[Callback] | None,
    tb_log_name: str | None,
    progress_bar: bool,
    sinks: Iterable[Sink],
) -> None:
    """Trains until a limit of ``call`` is reached, a callback returns ``False``, or Ctrl-C or SIGTERM arrives.

    The other arguments are those of :meth:`Agent.learn`.
    """
    if agent.name in DETERMINISTIC:
        warn_without_noise(agent)
    bar = [ProgressBar.of(call, steps_before=agent.run.step - call.first_step)] if progress_bar else []
    callbacks = in_order([*listed(callback), *bar])
    agent.call.stops, agent.call.n_together = device.stops_of(agent, call, callbacks), 1
    if agent.call.stops is not None:
        device.require_memory(agent)
    with session(agent, call, callbacks, tb_log_name, sinks) as record:
        try:
            with Interrupt() as interrupt:
                is_over, learner = False, None
                while not is_over and learner is not agent.learner:  # again if a callback has set a hyperparameter
                    learner = agent.learner
                    for turn in agent.loop(*horizon(agent, call)):
                        if (is_over := record(turn) or interrupt.requested) or learner is not agent.learner:
                            break
            agent.call.interrupted_by = interrupt.signal
            finite.settle(agent)
        except NonFiniteUpdate as broken:
            raise finite.reported(agent, broken) from None
        except NonFiniteSteps as broken:
            raise finite.steps_reported(agent, broken) from None


@contextmanager
def session(
    agent: AnyAgent,
    call: TrainingCall,
    callbacks: Sequence[Callback],
    tb_log_name: str | None = None,
    sinks: Iterable[Sink] = (),
) -> Iterator[Callable[[Progress], bool]]:
    """While entered, the agent is learning: outputs are open, and callbacks were told.

    Yields a function that is called after every turn of the loop. It records the turn, calls the callbacks, and returns
    whether training is over.
    """
    agent.call.training_call, agent.call.callbacks, agent.call.interrupted_by = call, stateful(callbacks), None
    agent.run.success_threshold = agent.identity.success_threshold
    with ExitStack() as stack:
        stack.callback(lambda: setattr(agent.run, "fingerprint", snapshot.fingerprint(agent.run.env)))
        outputs = open_outputs(agent, sinks, tb_log_name, stack)
        stack.callback(agent.files.failed_writes.retry)
        for output in outputs:
            output.write_config(run_config(agent, call))
        stack.callback(partial(setattr, agent.logger, "outputs", agent.logger.outputs))
        stack.callback(partial(setattr, agent.call, "is_learning", False))
        agent.logger.outputs, agent.call.is_learning = [*outputs], True
        stack.enter_context(listening(agent, callbacks))

        def record(turn: Progress) -> bool:
            record_turn(agent, call, turn)
            results = [called(callback, agent, turn) for callback in callbacks if not runs_last(callback)]
            write_row(agent, call, turn, outputs)  # with what these callbacks have recorded
            results += [called(callback, agent, turn) for callback in callbacks if runs_last(callback)]
            over = call.is_over(agent.run)
            return over or any(isinstance(result, bool | np.bool_) and not result for result in results)

        try:
            yield record
        except BaseException:  # perhaps of an environment, some of which have taken a step that was not stored
            if agent.call.stops is None:  # a chunk on the device is completed
                agent.run.obs = agent.run.action = None
            raise


def hint_at_more_environments(agent: AnyAgent) -> None:
    """Warns if a run waits for a single registered environment, and names the call that makes eight; Python shows it once."""
    env, seconds = agent.run.env, agent.run.seconds
    is_slow = seconds["total"] > HINT_SECONDS and agent.record.steps_per_second < HINT_RATE
    is_single = env is not None and env.n_envs == 1 and env.env_id in gym.registry
    if is_slow and is_single and time_shares(seconds)["env"] > 0.75:
        call = f"rejeu.make_vector({env.env_id!r}, n_envs=8)"
        hint = (
            f"most of the time goes into the only environment; {call} steps eight, on EnvPool where it has {env.env_id}"
        )
        warnings.warn(hint, UserWarning, stacklevel=2)


def horizon(agent: AnyAgent, call: TrainingCall) -> tuple[int, Callable[[int], float]]:
    """Returns the number of steps that are left to take at most, and the progress of schedules after a number of them."""
    run, first = agent.run, agent.run.step
    last = last_countable(run) if call.last_step is None else call.last_step
    return last - first, lambda n_steps: call.progress(first + n_steps, run.episode)


def record_turn(agent: AnyAgent, call: TrainingCall, turn: Progress) -> None:
    """Adds what one turn of the loop did to the statistics, and keeps the best weights."""
    agent.record.steps_per_second = (turn.step - call.first_step) / max(call.elapsed, 1e-9)
    for episode in turn.episodes:
        agent.record.add(episode)
    if ended := device.episodes_to_judge(agent, call, turn):
        note_training_return(agent, ended)


def write_row(agent: AnyAgent, call: TrainingCall, turn: Progress, outputs: Sequence[Sink]) -> None:
    """Writes a row of statistics if one is due."""
    counted = turn.step // STEPS_OF_A_ROW if is_offline(agent) else len(agent.record.history)
    if counted - call.logged >= call.log_interval and outputs:
        call.logged = counted
        row = statistics_row(agent) | agent.logger.take()
        for output in outputs:
            output.write(agent.num_timesteps, row)
        hint_at_more_environments(agent)


def is_offline(agent: AnyAgent) -> bool:
    """Returns whether an agent learns without an environment, so that no episodes end."""
    return isinstance(agent.config, configs.OffPolicyConfig) and agent.config.offline


def note_training_return(agent: AnyAgent, ended: int) -> None:
    """Keeps the current weights if the mean return of the last ``best_window`` episodes is the best so far.

    Each of the ``ended`` episodes that have just finished is the last of a window.
    """
    window = agent.identity.best_window
    returns = [episode.episode_return for episode in agent.record.history.last(window + ended - 1)]
    if len(returns) >= window and (agent.record.best is None or agent.record.best.by == "training"):
        means = np.lib.stride_tricks.sliding_window_view(returns, window).mean(axis=-1)
        remember_best(agent, float(means.max()), "training")


def remember_best(agent: AnyAgent, score: float | tuple[float, ...], by: str = "evaluation") -> bool:
    """Keeps the current weights for :meth:`Agent.restore_best` if ``score`` is the best so far; returns whether it is.

    ``learn`` calls it with the mean return of the last ``best_window`` training episodes, and
    :class:`rejeu.callbacks.Evaluate` with success rate and mean return. After the first evaluation only evaluations count.
    Scores of one kind must be comparable.
    """
    if agent.record.best is not None and agent.record.best.by == by and score <= agent.record.best.score:  # type: ignore[operator]
        return False
    finite.settle(agent)
    agent.record.best = Best(score, by, agent.run.step, agent.learner.copy(agent.run.state))
    return True
