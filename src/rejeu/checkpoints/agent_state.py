"""The values of an agent besides networks and environments, which training changes and files hold.

:class:`AnyAgent` is the interface of :class:`rejeu.agents.agent.Agent` for the functions that train, play, save and resume it.
"""

from __future__ import annotations

import math
import secrets
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import gymnasium as gym
import numpy as np

from rejeu.callbacks.base import Stateful
from rejeu.core import devices, spaces
from rejeu.core.failed_writes import FailedWrites
from rejeu.core.spaces import Leaf
from rejeu.core.validation import coerce, number, whole, whole_seed
from rejeu.envs.make import Backend, VectorEnv
from rejeu.logs.history import History
from rejeu.logs.logging import Logger
from rejeu.training import finite
from rejeu.training.compiled import Stops
from rejeu.training.learner import Learner, PackedState
from rejeu.training.run import Episode, Progress, Run, TrainingCall

BEST_WINDOW = 20
"""Default number of training episodes over whose mean return the best weights are chosen."""
AGENT_ARGUMENTS = {
    "policy": "``MlpPolicy``, ``MultiInputPolicy`` (Dict observations) or ``CnnPolicy`` (images). All three build what "
    "the observation space needs; a name that does not fit the space is an error.",
    "env": "An id, a Gymnasium environment, a function that makes one, or a vector environment.",
    "seed": "Seed of networks, exploration, batches and environments. None draws one.",
    "verbose": "0 is silent, 1 prints a table of statistics every ``log_interval`` episodes.",
    "log": "Where rows of statistics go: any of ``csv``, ``json``, ``tensorboard``, ``wandb``, ``mlflow`` and ``trackio``, "
    "one or several. Files are written to a new folder ``logs/NAME_1``, ``NAME_2``, ...",
    "tensorboard_log": "Folder of the folders ``NAME_k`` instead of ``logs``; adds ``tensorboard`` to ``log``.",
    "stats_window_size": "Episodes over which reported means are taken.",
    "success_threshold": "Least return of a successful episode where the environment does not report success; None: "
    "the environment's own reward threshold, if it has one.",
    "best_window": "Training episodes over whose mean return the best weights are chosen; 1 keeps those of the best "
    "episode. A larger value is less affected by chance.",
    "device": "Where it computes: ``auto`` (JAX's default device, a GPU if JAX has one), ``cpu`` or ``gpu``. Files do not "
    "contain it.",
}
"""Arguments of every agent in addition to its hyperparameters, with their meanings."""


class Best(NamedTuple):
    """The best weights of a run so far."""

    score: float | tuple[float, ...]
    """Mean training return, or the success rate and mean return of an evaluation."""
    by: str
    """``"training"`` or ``"evaluation"``."""
    step: int
    """Total environment steps at that time."""
    state: PackedState
    """The complete state of the algorithm at that time, packed."""

    def __repr__(self) -> str:
        return f"<Best: {self.by} {self.score} at step {self.step:,}>"


class Resumed(NamedTuple):
    """Where a run was resumed."""

    step: int
    """Total environment steps at that time."""
    exact: bool
    """Whether the run continues bit for bit as it would have without the interruption."""
    reason: str
    """The difference; empty if it is exact."""
    skipped: tuple[str, ...] = ()
    """Errors of the newer checkpoints that could not be read, newest first."""

    def __str__(self) -> str:
        return f"resumed at step {self.step:,}, {'exactly as it was saved' if self.exact else self.reason}"


@dataclass
class Identity:
    """Properties that tell one agent from another with the same hyperparameters. Training does not change it."""

    policy_name: str
    """The argument ``policy``."""
    seed: int
    """Of networks, exploration, batches and environments."""
    stats_window_size: int = 100
    """Episodes over which reported means are taken."""
    success_threshold: float | None = None
    """Least return of a successful episode where the environment does not report success."""
    best_window: int = BEST_WINDOW
    """Training episodes over whose mean return the best weights are chosen."""
    device: str = "auto"
    """Where it computes: ``"auto"``, ``"cpu"`` or ``"gpu"``."""
    run_id: str = field(default_factory=partial(secrets.token_hex, 8))
    """Identifies the run in its checkpoints."""
    made_from_id: bool = False
    """Whether the environments were made from an id."""
    trained_on: tuple[str, Mapping[str, Any]] | None = None
    """Id and keyword arguments of the environments a loaded agent was trained on, if its file contains them."""

    @classmethod
    def of(cls, policy: str, seed: int | None = None, *args: Any, **settings: Any) -> Identity:
        """Returns the identity for arguments of an agent, which are checked; a seed that is None is drawn."""
        drawn = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else whole_seed(seed)
        identity = cls(policy, drawn, *args, **settings)
        coerce(identity, ("stats_window_size", "best_window"), whole, least=1)
        coerce(identity, "success_threshold", number, optional=True)
        identity.device = devices.named(identity.device)
        return identity


@dataclass
class Outputs:
    """Where rows of statistics go."""

    verbose: int = 0
    """Whether a table of statistics is printed while it learns."""
    log: tuple[str, ...] = ()
    """Names of the logs to which rows of statistics are written."""
    tensorboard_log: str | Path | None = None
    """Folder of the folders of these logs; None for ``logs``."""


@dataclass
class CallState:
    """The current or last call of ``learn``, and what it counts from. Mutable."""

    training_call: TrainingCall | None = None
    """Its limits and progress."""
    is_learning: bool = False
    """Whether ``learn`` is running."""
    interrupted_by: int | None = None
    """The number of the signal that ended it, of Ctrl-C or SIGTERM."""
    stops: Stops | None = None
    """On the device: where the program returns to the host. None with the loop of the host."""
    n_together: int = 1
    """Runs in its program."""
    callbacks: Sequence[Stateful] = ()
    """Its callbacks whose state a checkpoint contains."""
    saved_callbacks: list[tuple[str, Any]] | None = None
    """Class names and states of callbacks in a resumed checkpoint, until ``learn`` restores them."""
    reset_step: int = 0
    """Total environment steps when the last ``learn`` with ``reset_num_timesteps=True`` started."""
    reset_episode: int = 0
    """Total finished episodes at that time."""
    reset_seconds: float = 0.0
    """Total training time at that time, in seconds."""


class TrainingRecord:
    """The episodes of training, the speed, and the best weights. Mutable.

    Args:
        window: number of recent episodes that are kept for means.
    """

    def __init__(self, window: int) -> None:
        self.window = window
        self.history = History()
        """Every episode of training."""
        self.ep_info_buffer: deque[dict[str, float]] = deque(maxlen=window)
        """The last episodes, each ``{"r": return, "l": length, "t": seconds}``."""
        self.ep_success_buffer: deque[float] = deque(maxlen=window)
        """Whether the last episodes succeeded, of those for which that is known."""
        self.steps_per_second = math.nan
        """Environment steps per second in the current or last ``learn``."""
        self.best: Best | None = None
        """The best weights so far, by mean training return or by evaluation."""

    def add(self, episode: Episode) -> None:
        """Adds an episode to the history and to the buffers of recent episodes."""
        self.history.append(episode)
        self.ep_info_buffer.append({"r": episode.episode_return, "l": episode.length, "t": episode.seconds})
        if not math.isnan(episode.success):
            self.ep_success_buffer.append(episode.success)

    def restore(self, table: np.ndarray) -> None:
        """Replaces the episodes by those of :meth:`History.table`."""
        self.history.replace(table)
        episodes, successes = self.history.last(self.window), self.history["success"]
        self.ep_info_buffer.extend({"r": e.episode_return, "l": e.length, "t": e.seconds} for e in episodes)
        self.ep_success_buffer.extend(successes[~np.isnan(successes)][-self.window :].tolist())


@dataclass
class Files:
    """The files that training writes, and those that it could not write."""

    checkpoint_folders: dict[Path, Any] = field(default_factory=dict)
    """Folders that contain its checkpoints, by path."""
    failed_writes: FailedWrites = field(default_factory=FailedWrites)
    """The files that ``learn`` could not write, such as checkpoints and log rows when the disk is full."""
    last_saved: Path | None = None
    """The newest file that ``save`` wrote."""
    report_folder: Path | None = None
    """Where batches that led to a non-finite number are saved; None: see :func:`rejeu.training.finite.folder_of`."""


class AnyAgent(Protocol):
    """An agent, whatever its algorithm, and what follows from its values: see :class:`rejeu.agents.agent.Agent`."""

    algorithm: ClassVar[Any]
    config: Any
    """Its hyperparameters."""
    identity: Identity
    """Arguments that tell it from other agents of the same hyperparameters, which training does not change."""
    observation_space: gym.Space
    action_space: gym.Space
    obs_leaves: tuple[Leaf, ...]
    """The arrays of an observation."""
    learner: Learner
    """The compiled functions of the algorithm."""
    run: Run
    """The state that every step changes: environments, buffer, counters, and the state of the algorithm."""
    on_device: bool | None = None
    """Whether ``learn`` trains in one program on the device: True requires it, False uses the loop of the host. None uses the
    device where the environments are JAX environments and the settings allow it; see ``docs/device.md``."""
    outputs: Outputs
    """Where rows of statistics go."""
    logger: Logger
    """Accepts further numbers for the rows of statistics."""
    call: CallState
    """The current or last call of ``learn``, and what it counts from."""
    record: TrainingRecord
    """The episodes of training, the speed, and the best weights."""
    files: Files
    """The files that training writes, and those that it could not write."""
    resumed: Resumed | None = None
    """Where :meth:`resume` continued the run; None for a new or loaded agent."""
    n_predictions: int = 0
    """Calls of ``predict`` that drew from the policy; each draws with a key of its own."""

    @classmethod
    def converted(cls, settings: Mapping[str, Any]) -> dict[str, Any]: ...
    def configure(self, config: Any, identity: Identity) -> None: ...
    def set_outputs(self, verbose: int = 0, log: str | Sequence[str] = (), tensorboard_log: Any = None) -> None: ...
    def build(self, observation_space: gym.Space, action_space: gym.Space) -> None: ...
    def n_threads(self, n_envs: int) -> int: ...
    def start_run(self, env: VectorEnv | None, state: PackedState | None = None) -> None: ...
    def make_envs(self, env: Any, n_envs: int = 1, backend: Backend = "auto", seed: int | None = None) -> VectorEnv: ...
    def abandon_episodes(self) -> None: ...
    def predict(self, observation: Any, *args: Any, **settings: Any) -> tuple[Any, Any]: ...
    def with_masks(self, obs: Any, masks: Any) -> Any: ...

    @property
    def name(self) -> str:
        """The algorithm's name."""
        return self.algorithm.Config.name

    @property
    def n_envs(self) -> int:
        """Number of environments."""
        return self.run.env.n_envs if self.run.env is not None else 1

    @property
    def state(self) -> Any:
        """A copy of the algorithm's state. Waits for pending updates."""
        finite.settle(self)
        return self.learner.state(self.run.state)

    @property
    def origin(self) -> tuple[str, Mapping[str, Any]] | None:
        """Id and keyword arguments of its environments or those it was trained on; None if they were not made from an id."""
        return self.identity.trained_on if self.run.env is None else self.run.env.made_from

    @property
    def num_timesteps(self) -> int:
        """Environment steps since the last ``learn`` with ``reset_num_timesteps=True`` started."""
        return self.run.step - self.call.reset_step

    @property
    def takes_masks(self) -> bool:
        """Whether its policy takes masks of the allowed actions."""
        return self.config.action_masks

    def get_vec_normalize_env(self) -> Any:
        """Returns the ``VecNormalize`` around the training environments, or None."""
        env = self.run.env
        return None if env is None else env.vec_normalize

    def check_spaces(self, vector: Any, source: str) -> None:
        """Raises ``ValueError`` if environments or a dataset, called ``source``, have other spaces than the agent."""
        for name in ("observation", "action"):
            ours, theirs = getattr(self, f"{name}_space"), getattr(vector, f"{name}_space")
            if not spaces.same(ours, theirs, bounds=name == "action"):
                share = self.config.action_share if name == "action" else 1.0
                limit = "" if share == 1.0 else f", limited by action_share={share}; leave it out to use all actions"
                raise ValueError(f"{source} has the {name} space {theirs}, and this agent was made for {ours}{limit}")

    @abstractmethod
    def gradient_batch_size(self, n_envs: int) -> int:
        """Returns the number of transitions in the batch of one gradient step."""

    @abstractmethod
    def first_learning_step(self, step: int) -> int:
        """Returns the environment step of the first gradient step, for a run that starts at ``step``."""

    @abstractmethod
    def steps_to_take(self, n_steps: int) -> int:
        """Returns after how many environment steps a ``learn`` of ``n_steps`` ends."""

    @abstractmethod
    def loop(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        """Trains until ``n_steps`` environment steps are taken (None: without end), and yields after every turn.

        Args:
            n_steps: over all environments.
            progress: returns the progress of schedules, in [0, 1], after that many steps.
        """
