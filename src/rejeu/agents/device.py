"""Whether an agent trains on the device, with which memory, and where the program must return to the host."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.callbacks.base import Periodic, TrainingCallback
from rejeu.checkpoints.agent_state import AnyAgent
from rejeu.core import devices
from rejeu.envs.functional.vector import reset_all
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.rollout import RolloutBuffer
from rejeu.replay.uniform import ReplayBuffer
from rejeu.training.compiled import Stops
from rejeu.training.compiled.off_policy import most_updates
from rejeu.training.compiled.program import MAX_TURNS
from rejeu.training.compiled.trainer import vector_of
from rejeu.training.learner import Learner
from rejeu.training.run import Progress, Run, TrainingCall

GIB = 2**30
COPIES = 3
"""How often networks and optimizers are in memory during an update: before it, after it, and the gradients."""


def stops_of(agent: AnyAgent, call: TrainingCall, callbacks: Sequence[object]) -> Stops | None:
    """Returns where the program returns to the host in a ``learn``, None if the agent trains with the loop of the host.

    Raises:
        ValueError: if ``agent.on_device`` is True and that is not possible, with the reason.
    """
    if agent.on_device is False:
        return None
    reason = reason_against(agent, callbacks)
    if reason is None:
        return stops_at(call, callbacks)
    if agent.on_device:
        raise ValueError(
            f"on_device=True is not possible: {reason}; leave it at None to train with the loop of the host"
        )
    if agent.run.env.backend == "jax":
        warnings.warn(
            f"{agent.run.env.env_id} trains with the loop of the host, which is slower than one on the device: {reason}; "
            "set agent.on_device = False to say that this is intended",
            UserWarning,
            stacklevel=5,
        )
    return None


def require_memory(agent: AnyAgent, n_runs: int = 1) -> None:
    """Checks that the device has room for so many runs like that of an agent, whose training has not begun.

    Raises:
        MemoryError: if it has not, with the numbers and what to lower.
    """
    run, on = agent.run, devices.local(agent.identity.device)[0]
    free = devices.room(on)
    if free is None:
        return
    is_cpu = on.platform == "cpu"  # whose memory is that of the host
    of_one = of_run(run, agent.learner, agent.gradient_batch_size(agent.n_envs)) + is_cpu * unwritten(run)
    needed = of_one * n_runs
    if needed > free:
        runs, seeds = (f"{n_runs} runs", " or the number of seeds") if n_runs > 1 else ("the run", "")
        raise MemoryError(
            f"{runs} would need about {needed / GIB:.1f} GiB on {on}, which has {free / GIB:.1f} GiB free; lower "
            f"{reducible(run)}{seeds}"
        )


def of_run(run: Run, learner: Learner, batch_size: int) -> int:
    """Returns about how many bytes a run takes on the device: networks, an update, and what is not on the host."""
    leaves = jax.tree.leaves(learner.shapes)
    # The state holds each network several times, with the moments of its optimizer. So the outputs of all its layers are
    # about as large as the activations of a network with their gradients.
    outputs = sum(math.prod(leaf.shape[:-2]) * leaf.shape[-1] for leaf in leaves if len(leaf.shape) > 1)
    rows = run.replay.n_steps * run.env.n_envs if isinstance(run.replay, RolloutBuffer) else batch_size
    update = COPIES * total(leaves) + 4 * rows * outputs
    if run.env.backend != "jax":
        return update
    episodes = jax.eval_shape(lambda: reset_all(vector_of(run).env, jax.random.key(0), run.env.n_envs))
    return update + total(jax.tree.leaves(episodes)) + of_experience(run.replay)


def of_experience(buffer: Any) -> int:
    """Returns the bytes of a replay buffer or rollout buffer on the device."""
    if isinstance(buffer, RolloutBuffer):
        return buffer.nbytes
    n = len(buffer.ring.kind)
    tables = 3 * 4 * n if buffer.ring.counters else 0  # instead of the counters: the tables of episodes
    return buffer.ring.nbytes + tables + (0 if buffer.priorities is None else 4 * n)


def unwritten(run: Run) -> int:
    """Returns the bytes of the buffer on the host that the system will only give when they are written to."""
    if isinstance(run.replay, RolloutBuffer):
        return run.replay.nbytes
    ring = run.replay.ring
    return int(ring.nbytes * (1 - np.mean(np.clip((ring.head + 1) / ring.rows, 0, 1))))


def reducible(run: Run) -> str:
    """Returns the setting on which the memory of a run depends most, with its value."""
    if isinstance(run.replay, RolloutBuffer):
        return f"n_steps (it is {run.replay.n_steps:,}) or the number of environments (it is {run.env.n_envs:,})"
    return f"buffer_size (it is {run.replay.ring.rows * run.replay.ring.n_envs:,})"


def total(leaves: Sequence[jax.ShapeDtypeStruct]) -> int:
    """Returns the bytes of arrays of these shapes and dtypes."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)


def stops_at(call: TrainingCall, callbacks: Sequence[object]) -> Stops:
    """Returns where limits and callbacks need the program to return to the host."""
    every = tuple(sorted({c.every for c in callbacks if isinstance(c, Periodic) and c.every is not None}))
    return Stops(every, at_episodes=call.n_episodes is not None)


def reason_against(agent: AnyAgent, callbacks: Sequence[object]) -> str | None:
    """Returns why an agent cannot train on the device, None if it can."""
    run, config = agent.run, agent.config
    if run.env.backend != "jax":
        return f"the backend of {run.env.env_id} is {run.env.backend!r}, not 'jax'"
    if names := [type(c).__name__ for c in callbacks if isinstance(c, TrainingCallback) and c.every_step]:
        return f"the callback {names[0]} must be called after every step"
    if config.action_repeat > 1:
        return f"action_repeat={config.action_repeat}: actions are held on the host only"
    if isinstance(config, OffPolicyConfig):
        return reason_against_replay(run.replay, config)
    return None if config.n_episodes is None else "rollouts of n_episodes whole episodes exist on the host only"


def reason_against_replay(buffer: Any, config: OffPolicyConfig) -> str | None:
    """Returns why a replay buffer cannot be on the device, None if it can."""
    if config.has_memory:
        return "networks with memory learn from replay on the host only"
    if config.demonstrations is not None:
        return "demonstrations are on the host"
    if config.needs_next_action:
        return f"{config.name} learns from next actions, which batches of the host have"
    if type(buffer) not in (ReplayBuffer, HerReplayBuffer):
        return f"the replay buffer {type(buffer).__name__} is your own"
    if config.hindsight is not None and config.hindsight.copy_info_dict:
        return "copy_info_dict computes rewards from infos, which exist on the host only"
    if config.priorities is not None and most_updates(config, buffer.ring.n_envs) is None:
        return "priorities with gradient_steps=-1 after whole episodes exist on the host only"
    if config.frame_stack is not None:
        return "frame_stack exists on the host only"
    if buffer.ring.rows < 3:
        return f"buffer_size={config.buffer_size} leaves {buffer.ring.rows} rows for each environment, at least 3 are needed"
    return None


def episodes_to_judge(agent: AnyAgent, call: TrainingCall, turn: Progress) -> int:
    """Returns the number of newest episodes whose returns decide now whether the weights are the best so far.

    On the host these are the episodes that have just ended. On the device the weights are looked at once in ``MAX_TURNS``
    turns and at the end of ``learn``, since chunks end elsewhere at times that depend on the speed of the machine.
    """
    if agent.call.stops is None:
        return len(turn.episodes)
    period = MAX_TURNS * agent.n_envs
    n_periods = (turn.step - agent.n_envs) // period  # of which the episodes were judged
    if turn.step // period == n_periods and not call.is_over(agent.run):
        return 0
    return int(np.count_nonzero(agent.record.history["step"] > n_periods * period))
