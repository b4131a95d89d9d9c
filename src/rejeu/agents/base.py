"""What all agents share: they own an environment and a learner, under Stable-Baselines3's names.

An agent holds what changes and calls what computes; it contains no mathematics. Its hyper-parameters are those of its
algorithm's configuration.
"""

from __future__ import annotations

import inspect
import math
import secrets
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu import spaces, validation, xla
from rejeu.agents.description import AGENT_ARGUMENTS, Documentation, Signature
from rejeu.algorithms import config as configs
from rejeu.callbacks.base import RunFolder, Stateful
from rejeu.envs.adapters import vec_env_view
from rejeu.envs.make import Backend, VectorEnv
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise, check_fits
from rejeu.io import checkpoint
from rejeu.io.failed_writes import FailedWrites
from rejeu.loops import finite
from rejeu.loops.learner import Learner, PackedState
from rejeu.loops.run import Progress, Run, initial_run
from rejeu.loops.training_call import TrainingCall
from rejeu.normalization import normalised
from rejeu.reporting.history import History
from rejeu.reporting.logging import Logger

BEST_WINDOW = 20
"""Training episodes over whose mean return the best weights are judged by default."""
POLICIES = ("MlpPolicy", "MultiInputPolicy", "CnnPolicy")


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


class Resumed(NamedTuple):
    """Where a run was resumed."""

    step: int
    """Environment steps that had been taken."""
    exact: bool
    """Whether the run continues as it would have without the break, bit for bit."""
    reason: str
    """What differs otherwise; empty where it is exact."""
    skipped: tuple[str, ...] = ()
    """What was wrong with each newer checkpoint, which could not be read; newest first."""

    def __str__(self) -> str:
        return f"resumed at step {self.step:,}, {'exactly where it stood' if self.exact else self.reason}"


class BaseAgent(ABC):
    """What all agents share. Abstract: use SAC, PPO and their kin."""

    takes_masks: ClassVar[bool] = False
    """Whether it asks the environment which actions are allowed."""
    algorithm: ClassVar[Any]
    """What has ``Config`` and ``make``: a module, or a ``types.SimpleNamespace(Config=Config, make=make)``."""
    is_learning: bool = False
    """Whether ``learn`` is under way."""
    report_folder: Path | None = None
    """Where a batch that broke something is saved; None: see :func:`rejeu.loops.finite.folder_of`."""
    last_saved: Path | None = None
    """The newest file that :meth:`save` wrote."""

    def __init__(
        self,
        policy: str,
        env: Any,
        *,
        seed: int | None = None,
        verbose: int = 0,
        tensorboard_log: str | Path | None = None,
        stats_window_size: int = 100,
        success_threshold: float | None = None,
        best_window: int = BEST_WINDOW,
        device: str = "auto",
        **hyperparameters: Any,
    ) -> None:
        known = [*validation.field_names(self.algorithm.Config), *AGENT_ARGUMENTS]
        for key in hyperparameters:
            if key not in known:
                raise TypeError(validation.unknown_name(key, known, self.name))
        self.configure(
            policy,
            self.algorithm.Config(**hyperparameters),
            int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else whole_seed(seed),
            verbose,
            tensorboard_log,
            validation.whole("stats_window_size", stats_window_size, least=1),
            None if success_threshold is None else validation.number("success_threshold", success_threshold),
            validation.whole("best_window", best_window, least=1),
        )
        self.made_from_id = isinstance(env, str)
        vector = self.make_envs(env, 1, seed=self.seed)
        check_policy(policy, vector.observation_space)
        self.build(vector.observation_space, vector.action_space)
        xla.start_device(self.n_threads(vector.n_envs))
        self.start_run(vector)

    def configure(
        self,
        policy: str,
        config: Any,
        seed: int,
        verbose: int,
        tensorboard_log: str | Path | None,
        stats_window_size: int,
        success_threshold: float | None,
        best_window: int,
    ) -> None:
        """Sets everything that does not depend on the environment."""
        self.policy, self.config, self.seed, self.verbose = policy, config, seed, verbose
        self.tensorboard_log = tensorboard_log
        self.stats_window_size, self.success_threshold = stats_window_size, success_threshold
        self.best_window = best_window
        self.history = History()
        self.ep_info_buffer: deque[dict[str, float]] = deque(maxlen=stats_window_size)
        """The last episodes, each ``{"r": return, "l": length, "t": seconds}``."""
        self.ep_success_buffer: deque[float] = deque(maxlen=stats_window_size)
        self.interrupted = False
        """Whether the last ``learn`` was ended by Ctrl-C or SIGTERM."""
        self.interrupted_by: int | None = None
        """The number of that signal."""
        self.logger = Logger()
        """Takes further numbers for the rows of statistics."""
        self.failed_writes = FailedWrites()
        """What ``learn`` could not write, such as checkpoints and log rows on a full disk; training continues without."""
        self.best: Best | None = None
        """The best weights so far, by smoothed training return or by evaluation."""
        self.steps_per_second = math.nan
        """Environment steps per second of the present or last ``learn``."""
        self.resumed: Resumed | None = None
        """Where :meth:`resume` took up the run; None for an agent that began here or was loaded."""
        self.run_id = secrets.token_hex(8)
        self.training_call: TrainingCall | None = None
        """The present or last call of ``learn``: its limits and how far it has come."""
        self.callbacks: list[Stateful] = []
        """The callbacks of the present or last ``learn`` whose state a checkpoint contains."""
        self.saved_callbacks: list[tuple[str, Any]] | None = None
        """Class names and states of callbacks in a resumed checkpoint, until ``learn`` restores them."""
        self.run_folders: dict[Path, RunFolder] = {}
        """Folders that contain its checkpoints, by path."""
        self.reset_step = 0
        """Environment steps taken in all when the last ``learn`` with ``reset_num_timesteps=True`` began."""
        self.reset_episode = 0
        """Episodes finished in all at that time."""
        self.reset_seconds = 0.0
        """Training time in all at that time."""
        self.n_predictions = 0
        self.carry_shapes: Any = None
        """The form of what the policy remembers of one episode, once somebody has given it."""
        self.trained_on: tuple[str, Mapping[str, Any]] | None = None
        """Id and keyword arguments of the environments that a loaded agent was trained on, where its file says."""
        self.made_from_id = False
        """Whether the environment was given by its id."""
        xla.enable_cache()

    def build(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        """Compiles the algorithm for these spaces."""
        self.observation_space, self.action_space = observation_space, action_space
        self.obs_leaves = spaces.leaves(observation_space)
        self.config = configs.with_widths(self.config, self.obs_leaves)
        noise = self.make_noise()
        if noise is not None:
            check_fits(noise, action_space)
        algorithm = self.algorithm.make(self.config, observation_space, action_space)
        if self.config.normalize is not None:
            explorer = exploration.make(algorithm, noise)
            algorithm = normalised(algorithm, explorer, self.obs_leaves, self.config.normalize, self.config.gamma)
        self.learner = Learner(algorithm, noise, self.config.nonfinite == "skip")

    def n_threads(self, n_envs: int) -> int:
        """Returns how many threads suit updates on ``n_envs`` environments, by the largest layer; for images all."""
        if any(leaf.kind == "image" for leaf in self.obs_leaves):
            return xla.cores()
        weights = [leaf.size for leaf in jax.tree.leaves(self.learner.shapes) if len(leaf.shape) > 1]
        return xla.threads_for(self.gradient_batch_size(n_envs) * max(weights, default=0))

    def start_run(self, env: VectorEnv | None, state: PackedState | None = None) -> None:
        """Begins a run on ``env`` with a fresh state, or the given one, and an empty buffer; None only predicts."""
        buffer, learn_from = (None, 0) if env is None else (self.make_buffer(env), self.first_learning_step(0))
        self.run: Run = initial_run(env, buffer, self.learner, learn_from, self.seed, state)

    @abstractmethod
    def make_envs(self, env: Any, n_envs: int = 1, backend: Backend = "auto", seed: int | None = None) -> VectorEnv:
        """Returns environments as this agent needs them, from what :func:`make_vector` takes."""

    @abstractmethod
    def make_noise(self) -> Noise | None:
        """Returns the noise that exploration adds to actions."""

    @abstractmethod
    def gradient_batch_size(self, n_envs: int) -> int:
        """Returns how many steps of ``n_envs`` environments a gradient is taken on."""

    @abstractmethod
    def make_buffer(self, env: VectorEnv) -> Any:
        """Returns an empty buffer for the experience of ``env``."""

    @abstractmethod
    def keep_buffer(self, env: VectorEnv) -> None:
        """Prepares the buffer for a new environment of the same number and spaces."""

    @abstractmethod
    def drop_rollout(self) -> None:
        """Forgets experience that only the policy may learn from that collected it."""

    @abstractmethod
    def first_learning_step(self, step: int) -> int:
        """Returns the step from which on a run that begins at ``step`` takes gradients."""

    @abstractmethod
    def loop(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        """Returns the loop."""

    @abstractmethod
    def start_episodes(self) -> None:
        """Begins an episode in every environment."""

    def abandon_episodes(self) -> None:
        """Gives up the running episodes, of whose environments somebody else has made use.

        New ones begin with the next ``learn``; within one at once, so that a checkpoint of this step can hold them.
        """
        self.run.obs = self.run.action = None
        if self.is_learning:
            self.start_episodes()

    @property
    def name(self) -> str:
        """The algorithm's name."""
        return self.algorithm.Config.name

    @property
    def env(self) -> VectorEnv | None:
        """The environments it trains on; None after ``load`` without one."""
        return self.run.env

    @property
    def n_envs(self) -> int:
        """How many environments it steps at once."""
        return self.run.env.n_envs if self.run.env is not None else 1

    @property
    def state(self) -> Any:
        """Everything learnt, as the algorithm's own class; a copy. Waits for the updates under way."""
        finite.settle(self)
        return self.learner.state(self.run.state)

    @property
    def num_timesteps(self) -> int:
        """Environment steps taken since the last ``learn`` with ``reset_num_timesteps=True`` began."""
        return self.run.step - self.reset_step

    @property
    def n_updates(self) -> int:
        """Gradient steps taken in all."""
        return self.run.n_updates

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time spent training, in all and by what it went into: ``env``, ``replay``, ``update``, ``total``."""
        return dict(self.run.seconds)

    @abstractmethod
    def with_masks(self, obs: Any, masks: Any) -> Any:
        """Returns a batch of observations as the algorithm takes it, with the given masks where it takes any."""

    def get_env(self) -> Any:
        """Returns the environments it trains on, to be stepped by hand as in Stable-Baselines3; None if it has none.

        That is the vector environment it was given, if it was given one that resets itself; around a Gymnasium environment
        it is a :class:`DummyVecEnv`. The episodes that ran there are given up: the next ``learn`` begins new ones. While
        it learns they are to be looked at only.
        """
        env = self.run.env
        if env is None:
            return None
        if not self.is_learning:
            self.abandon_episodes()
        if env.venv is None:
            env.venv = vec_env_view(env)
        return env.venv

    def set_logger(self, logger: Logger) -> None:
        """Lets rows of statistics go to the outputs of a logger, in place of console and TensorBoard."""
        self.logger = logger

    def get_vec_normalize_env(self) -> Any:
        """Returns the ``VecNormalize`` around the environments it trains on, or None."""
        env = self.run.env
        return None if env is None else env.vec_normalize

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Gives the agent another environment of the same spaces; its episodes start anew.

        With another number of environments a replay buffer starts empty, and ``learning_starts`` steps are taken before
        the next gradient step, as after ``load``; otherwise it is kept.

        Raises:
            ValueError: if the spaces differ.
            RuntimeError: while it learns.
        """
        if self.is_learning:
            raise RuntimeError(
                "set_env was called while the agent learns; stop training first (a callback that returns False), then "
                "call set_env and learn(..., reset_num_timesteps=False)"
            )
        vector = self.make_envs(env, 1, seed=self.seed)
        self.check_spaces(vector, "the new environment")
        self.made_from_id = isinstance(env, str)
        run = self.run
        if run.env is None or run.env.n_envs != vector.n_envs:
            run.replay = self.make_buffer(vector)
            run.td_errors = []
            run.carry = self.learner.initial_carry(vector.n_envs)
            run.learn_from = self.first_learning_step(run.step)
        else:
            self.keep_buffer(vector)
        run.env = vector
        run.obs = run.action = None
        run.ended = np.ones(vector.n_envs, bool)

    def check_spaces(self, vector: VectorEnv, what: str) -> None:
        for kind in ("observation", "action"):
            own, other = getattr(self, f"{kind}_space"), getattr(vector, f"{kind}_space")
            if not spaces.same(own, other, bounds=kind == "action"):
                raise ValueError(f"{what} has the {kind} space {other}, and this agent was made for {own}")

    def get_parameters(self) -> dict[str, np.ndarray]:
        """Returns everything learnt as arrays by name, copied: networks, targets, optimizers, temperature, counters."""
        return {key: value.copy() for key, value in checkpoint.tree_to_arrays(self.state).items()}

    def set_parameters(
        self, load_path_or_dict: Mapping[str, np.ndarray] | str | Path, exact_match: bool = True
    ) -> None:
        """Puts parameters in place, from :meth:`get_parameters` or from a model file.

        Args:
            load_path_or_dict: arrays by name, or a path.
            exact_match: require all of them; False takes those that are given and keeps the rest.

        Raises:
            CheckpointError: if a name, shape or dtype does not match; nothing is then changed.
        """
        source = load_path_or_dict
        if isinstance(source, str | Path):
            path = source
            with checkpoint.opened(path, "agent") as file:
                shapes = self.learner.shapes
                own = {} if exact_match else dict(zip(checkpoint.names(shapes), jax.tree.leaves(shapes), strict=True))
                checkpoint.match(shapes, {**own, **file.specs}, path)
                source = file.read()
            checkpoint.require_finite(source, path)
        arrays = {key: np.asarray(value) for key, value in source.items()}
        if not exact_match:
            arrays = self.get_parameters() | arrays
        state = checkpoint.arrays_to_tree(self.learner.shapes, arrays, "set_parameters: the source")
        self.run.state = self.learner.pack(state)
        self.drop_rollout()

    def __repr__(self) -> str:
        where = self.run.env.env_id if self.run.env is not None else "no environment"
        return f"<rejeu.{self.name} on {where}, {self.run.step} steps, {self.run.n_updates} updates>"

    def __init_subclass__(cls) -> None:
        """Adds the hyperparameters of the configuration to docstring and signature, which are made when asked for."""
        if "algorithm" in cls.__dict__:
            cls.__doc__ = Documentation(cls.__doc__)  # type: ignore[assignment]
            cls.__signature__ = Signature(inspect.signature(BaseAgent.__init__))  # type: ignore[attr-defined]


def whole_seed(seed: Any) -> int:
    """Returns a seed as an int in [0, 2^32).

    Raises:
        ValueError: otherwise.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**32 - 1")
    return int(seed)


def check_policy(policy: str, space: gym.Space) -> None:
    """Raises ``ValueError`` if there is no such policy, or if it is not for observations of ``space``."""
    if policy not in POLICIES:
        raise ValueError(f"policy={policy!r} must be one of {', '.join(POLICIES)}")
    is_dict = isinstance(space, gym.spaces.Dict)
    if policy == "MlpPolicy" and is_dict:
        raise ValueError("policy='MlpPolicy' does not fit a Dict observation; use 'MultiInputPolicy'")
    if policy == "MultiInputPolicy" and not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        raise ValueError(f"policy='MultiInputPolicy' needs a Dict or Tuple observation, got {space}; use 'MlpPolicy'")
    if policy == "CnnPolicy" and not any(leaf.kind == "image" for leaf in spaces.leaves(space)):
        raise ValueError(f"policy='CnnPolicy' needs a uint8 image observation, got {space}; use 'MlpPolicy'")
