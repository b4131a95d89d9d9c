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
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import gymnasium as gym
import jax
import numpy as np

from rejeu import spaces, validation, xla
from rejeu.agents import model_files, policy as policies, resume, training
from rejeu.agents.description import ClassOnly, Documentation, Signature
from rejeu.agents.model_files import AGENT_ARGUMENTS, BEST_WINDOW, whole_seed
from rejeu.agents.policy import check_policy
from rejeu.agents.resume import Resumed
from rejeu.agents.run_files import RowFiles
from rejeu.agents.training import Best, Call
from rejeu.algorithms import config as configs
from rejeu.envs.adapters import vec_env_view
from rejeu.envs.make import Backend, VectorEnv
from rejeu.envs.masks import split
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise, check_fits
from rejeu.hooks import BaseCallback
from rejeu.io import checkpoint
from rejeu.io.failed_writes import FailedWrites
from rejeu.loops import finite
from rejeu.loops.learner import Learner, PackedState
from rejeu.loops.run import Progress, Run, initial_run
from rejeu.normalization import normalised
from rejeu.reporting import summary
from rejeu.reporting.evaluation import Evaluation
from rejeu.reporting.history import History
from rejeu.reporting.logging import Logger, Sink

Callback = Callable[["Agent", Progress], bool | None]
"""Called after every step of the environments; ``False``, and nothing else, stops training."""


class Agent(ABC):
    """What all agents share. Abstract: use SAC, PPO and their kin."""

    takes_masks: ClassVar[bool] = False
    """Whether it asks the environment which actions are allowed."""
    algorithm: ClassVar[Any]
    """What has ``Config`` and ``make``: a module, or a ``types.SimpleNamespace(Config=Config, make=make)``."""
    _learning: bool = False
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
        self._set_up(
            policy,
            self.algorithm.Config(**hyperparameters),
            int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else whole_seed(seed),
            verbose,
            tensorboard_log,
            validation.whole("stats_window_size", stats_window_size, least=1),
            None if success_threshold is None else validation.number("success_threshold", success_threshold),
            validation.whole("best_window", best_window, least=1),
        )
        self._own_env = isinstance(env, str)
        vector = self._vector(env, 1, seed=self.seed)
        check_policy(policy, vector.observation_space)
        self._build(vector.observation_space, vector.action_space)
        xla.start_device(self._threads(vector.n_envs))
        self._start(vector)

    def _set_up(
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
        self._run_id = secrets.token_hex(8)
        self._rows: dict[Path, RowFiles] = {}
        self._call: Call | None = None
        self._callbacks: list[Any] = []
        self._saved_callbacks: list[Any] | None = None
        self._steps_before = 0
        """Environment steps taken in all when the last ``learn`` with ``reset_num_timesteps=True`` began."""
        self._episodes_before = 0
        """Episodes finished in all at that time."""
        self._seconds_before = 0.0
        """Training time in all at that time."""
        self._n_predictions = 0
        self._memory_form: Any = None
        """The form of what the policy remembers of one episode, once somebody has given it."""
        self._trained_on: tuple[str, Mapping[str, Any]] | None = None
        """Id and keyword arguments of the environments that a loaded agent was trained on, where its file says."""
        self._own_env = False
        """Whether the environment was given by its id."""
        xla.enable_cache()

    def _build(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        """Compiles the algorithm for these spaces."""
        self.observation_space, self.action_space = observation_space, action_space
        self._obs_leaves = spaces.leaves(observation_space)
        self.config = configs.with_widths(self.config, self._obs_leaves)
        noise = self._noise()
        if noise is not None:
            check_fits(noise, action_space)
        algorithm = self.algorithm.make(self.config, observation_space, action_space)
        if self.config.normalize is not None:
            explorer = exploration.make(algorithm, noise)
            algorithm = normalised(algorithm, explorer, self._obs_leaves, self.config.normalize, self.config.gamma)
        self.learner = Learner(algorithm, noise, self.config.nonfinite == "skip")

    def _threads(self, n_envs: int) -> int:
        """Returns how many threads suit updates on ``n_envs`` environments, by the largest layer; for images all."""
        if any(leaf.kind == "image" for leaf in self._obs_leaves):
            return xla.cores()
        weights = [leaf.size for leaf in jax.tree.leaves(self.learner.shapes) if len(leaf.shape) > 1]
        return xla.threads_for(self._batch_size(n_envs) * max(weights, default=0))

    def _start(self, env: VectorEnv | None, state: PackedState | None = None) -> None:
        """Begins a run on ``env`` with a fresh state, or the given one, and an empty buffer; None only predicts."""
        buffer, learn_from = (None, 0) if env is None else (self._make_buffer(env), self._learn_from(0))
        self.run: Run = initial_run(env, buffer, self.learner, learn_from, self.seed, state)

    @abstractmethod
    def _vector(self, env: Any, n_envs: int = 1, backend: Backend = "auto", seed: int | None = None) -> VectorEnv:
        """Returns environments as this agent needs them, from what :func:`make_vector` takes."""

    @abstractmethod
    def _noise(self) -> Noise | None:
        """Returns the noise that exploration adds to actions."""

    @abstractmethod
    def _batch_size(self, n_envs: int) -> int:
        """Returns how many steps of ``n_envs`` environments a gradient is taken on."""

    @abstractmethod
    def _make_buffer(self, env: VectorEnv) -> Any:
        """Returns an empty buffer for the experience of ``env``."""

    @abstractmethod
    def _keep_buffer(self, env: VectorEnv) -> None:
        """Prepares the buffer for a new environment of the same number and spaces."""

    @abstractmethod
    def _drop_rollout(self) -> None:
        """Forgets experience that only the policy may learn from that collected it."""

    @abstractmethod
    def _learn_from(self, step: int) -> int:
        """Returns the step from which on a run that begins at ``step`` takes gradients."""

    @abstractmethod
    def _turns(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        """Returns the loop."""

    @abstractmethod
    def _begin_episodes(self) -> None:
        """Begins an episode in every environment."""

    def _give_up_episodes(self) -> None:
        """Gives up the running episodes, of whose environments somebody else has made use.

        New ones begin with the next ``learn``; within one at once, so that a checkpoint of this step can hold them.
        """
        self.run.obs = self.run.action = None
        if self._learning:
            self._begin_episodes()

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
        return self.run.step - self._steps_before

    @property
    def n_updates(self) -> int:
        """Gradient steps taken in all."""
        return self.run.n_updates

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time spent training, in all and by what it went into: ``env``, ``replay``, ``update``, ``total``."""
        return dict(self.run.seconds)

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: Callback | BaseCallback | Iterable[Callback | BaseCallback] | None = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        episodes: int | None = None,
        minutes: float | None = None,
        sinks: Iterable[Sink] = (),
    ) -> Self:
        """Trains, and returns the agent.

        Args:
            total_timesteps: environment steps to take, over all environments; exactly so many are taken. None with
                ``episodes`` or ``minutes``.
            callback: called after every step as ``callback(agent, progress)``, or several; ``False`` stops training.
                Objects with hooks as in Stable-Baselines3 are taken too, see :mod:`rejeu.hooks`.
            log_interval: episodes between two rows of statistics.
            tb_log_name: name of the run in ``tensorboard_log``; None: the algorithm's.
            reset_num_timesteps: count steps from 0 and begin schedules (learning rate, exploration, clip range, beta)
                again. With False both continue as in Stable-Baselines3: steps taken before count as done and as part of
                the whole, so ``learn(300, reset_num_timesteps=False)`` after 100 steps moves schedules from 1/4 of their
                way to the end. Learning itself continues in either case.
            progress_bar: show one.
            episodes: stop when so many episodes have ended, over all environments.
            minutes: stop after so much wall time. Schedules follow whichever limit is nearest; episodes and training time
                before this call count as steps do.
            sinks: further places for the rows of statistics, such as ``rejeu.reporting.logging.CsvFile(path)``.

        Without any limit, an agent from :meth:`resume` goes on with the ``learn`` that was cut off, to its end; arguments
        that count steps and rows are then those of that call.

        Ctrl-C and SIGTERM end training after the step it is in, with everything consistent; ``interrupted`` is then True.

        Raises:
            ValueError: without an environment, or if no limit is given.
        """
        call = training.begin(self, total_timesteps, episodes, minutes, log_interval, reset_num_timesteps)
        arguments = {"log_interval": log_interval, "reset_num_timesteps": reset_num_timesteps}
        training.carry_out(self, call, callback, tb_log_name, progress_bar, sinks, arguments)
        return self

    def _fill_windows(self) -> None:
        """Fills the windows of statistics from the history."""
        training.fill_windows(self)

    def remember_best(self, score: float | tuple[float, ...], by: str = "evaluation") -> bool:
        """Keeps the present weights for :meth:`restore_best` if ``score`` is the best so far; returns whether it is.

        ``learn`` calls it with the mean return of the last ``best_window`` training episodes (20, or 1 for the best single
        episode), :class:`rejeu.callbacks.Evaluate` with success rate and mean return; once it was called with the score of
        an evaluation, evaluations alone count. Scores of one kind must compare with each other.
        """
        return training.remember_best(self, score, by)

    def _put_best(self, score: float | tuple[float, ...], by: str, step: int, state: PackedState) -> None:
        self.best = Best(score, by, step, state)

    def restore_best(self) -> Self:
        """Puts back the best weights so far: actor, critics, their targets and optimizers as they were together.

        Raises:
            ValueError: if none were kept yet, which takes ``best_window`` finished episodes or one evaluation.
        """
        training.restore_best(self)
        return self

    def statistics(self) -> dict[str, float]:
        """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
        return training.statistics_row(self)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[np.ndarray, Any]:
        """Returns actions in the environment's own range, and what a policy with a memory remembers (without, ``state``).

        Args:
            observation: one observation of the environment's space, or a batch of them with a leading axis; the action
                has a leading axis if and only if the observation has.
            state: what the last call returned, for a policy with a memory; None where episodes begin.
            episode_start: where an episode begins with this observation, ``bool (batch,)``, so that what was remembered
                is forgotten there; None for nowhere.
            deterministic: the policy's mode; False draws from the policy, which gives the same action again where the policy
                is deterministic (DDPG, TD3). ``action_noise`` is never added: it belongs to training.
            action_masks: which actions are allowed, ``bool (batch, n)`` or ``(n,)``, for agents that take masks; None
                allows all.

        Raises:
            ValueError: if the observation or the mask does not have the space's structure or shape, or ``state`` that of
                the policy's memory.
        """
        if self.takes_masks:
            observation, action_masks = split(observation, action_masks)
        batch, single = policies.as_batch(observation, self.observation_space, self._obs_leaves)
        batch = self._with_masks(batch, action_masks)
        n = len(jax.tree.leaves(batch)[0])
        ended = np.zeros(n, bool) if episode_start is None else np.asarray(episode_start, bool).reshape(n)
        action, memory = policies.act(self, batch, deterministic, state, ended)
        scaled = spaces.scale_action(self.action_space, action)
        return (scaled[0] if single else scaled), state if memory is None else memory

    @abstractmethod
    def _with_masks(self, obs: Any, masks: Any) -> Any:
        """Returns a batch of observations as the algorithm takes it, with the given masks where it takes any."""

    def evaluate(
        self,
        episodes: int | None = None,
        env: Any = None,
        deterministic: bool = True,
        seed: int | None = None,
        success_threshold: float | None = None,
        *,
        minutes: float | None = None,
    ) -> Evaluation:
        """Plays whole episodes and returns their returns, lengths, successes and 95 % intervals.

        Args:
            episodes: how many; None: 100, or with ``minutes`` as many as there is time for.
            env: where, as for the constructor; None: new environments like the agent's own if it was given an id,
                else the agent's own, whose running episodes are then given up.
            deterministic: the policy's mode; False draws from the policy, as :meth:`predict` does.
            seed: of the environments, the agent's own included; None draws one for new environments, and lets the
                random numbers of others go on.
            success_threshold: return from which on an episode counts as a success where the environment does not say;
                None takes the agent's own.
            minutes: of wall time; when they are over, no further episode begins. Episodes that have begun are played to
                their end and count, so that long ones are not left out: it takes up to one episode longer, and every
                environment plays at least one. None for no limit.

        It may be called by a callback while the agent learns. Where it plays in the environments that the agent trains
        on, be they given or not, training goes on in new episodes.
        """
        return policies.play(self, episodes, env, deterministic, seed, success_threshold, minutes)

    def get_env(self) -> Any:
        """Returns the environments it trains on, to be stepped by hand as in Stable-Baselines3; None if it has none.

        That is the vector environment it was given, if it was given one that resets itself; around a Gymnasium environment
        it is a :class:`DummyVecEnv`. The episodes that ran there are given up: the next ``learn`` begins new ones. While
        it learns they are to be looked at only.
        """
        env = self.run.env
        if env is None:
            return None
        if not self._learning:
            self._give_up_episodes()
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
        if self._learning:
            raise RuntimeError(
                "set_env was called while the agent learns; stop training first (a callback that returns False), then "
                "call set_env and learn(..., reset_num_timesteps=False)"
            )
        vector = self._vector(env, 1, seed=self.seed)
        self._check_spaces(vector, "the new environment")
        self._own_env = isinstance(env, str)
        run = self.run
        if run.env is None or run.env.n_envs != vector.n_envs:
            run.replay = self._make_buffer(vector)
            run.td_errors = []
            run.carry = self.learner.initial_carry(vector.n_envs)
            run.learn_from = self._learn_from(run.step)
        else:
            self._keep_buffer(vector)
        run.env = vector
        run.obs = run.action = None
        run.ended = np.ones(vector.n_envs, bool)

    def _check_spaces(self, vector: VectorEnv, what: str) -> None:
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
        self._drop_rollout()

    def save(self, path: str | Path) -> Path:
        """Writes the model to one safetensors file and returns its path; the replay buffer is not part of it.

        ``.safetensors`` is added to a path without a suffix. The file holds everything learnt, the hyper-parameters, the
        spaces and the counters. An older file at that path is replaced only once the new one is complete.
        """
        return self.snapshot(path)()

    def snapshot(self, path: str | Path) -> Callable[[], Path]:
        """Returns a function that does what :meth:`save` does, with the model as it is now, whenever it is called."""
        arrays, header = self.get_parameters(), model_files.header(self)

        def write() -> Path:
            self.last_saved = checkpoint.write(path, "agent", arrays, header)
            return self.last_saved

        return write

    @classmethod
    def load(cls, path: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of a model file. Runs nothing that the file holds; it supplies numbers only.

        Args:
            path: as given to :meth:`save`, or a run folder, whose best model is taken.
            env: where it continues to learn; None for an agent that only predicts. Such an agent still evaluates in
                environments like those that it was trained on, where they were made from a registered id.
            changes: constructor arguments or hyper-parameters to set otherwise than they were saved.

        Raises:
            FileNotFoundError: if there is no such file.
            CheckpointError: if the file is damaged, of another algorithm, environment, schema or shape; it says which.
        """
        with checkpoint.opened(model_files.find(path), "agent") as file:
            agent = model_files.load(
                cls, file, lambda agent: None if env is None else agent._vector(env, seed=agent.seed), changes
            )
        agent._own_env = isinstance(env, str)
        return agent

    @classmethod
    def resume(cls, folder: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of a run as its newest checkpoint holds it; ``learn()`` then goes on to the end that was set.

        Everything stands as it stood: what was learnt, the replay buffer, running episodes, exploration, random numbers,
        counters, statistics, callbacks' own memory (give ``learn`` the same callbacks). Where the environments
        can be saved (see :mod:`rejeu.envs.snapshot`) or repeat their episodes (EnvPool), the run that follows is the same,
        bit for bit, that would have followed without a break; elsewhere new episodes begin, and a warning says so.
        ``resumed`` tells which.

        Args:
            folder: as given to :class:`rejeu.callbacks.Checkpoint`.
            env: as for the constructor; None makes environments of the id and number that the run had.
            changes: hyper-parameters to set otherwise than they were.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if the checkpoints are damaged, or of another algorithm or environment.
        """
        return resume.resume(cls, Path(folder), env, changes)

    def summary(self) -> str:
        """Returns a text drawing of the networks with their numbers of parameters; see :mod:`rejeu.reporting.summary`."""
        return summary.describe(self.learner.shapes, self._obs_leaves)

    def __repr__(self) -> str:
        where = self.run.env.env_id if self.run.env is not None else "no environment"
        return f"<rejeu.{self.name} on {where}, {self.run.step} steps, {self.run.n_updates} updates>"

    def __init_subclass__(cls) -> None:
        """Adds the hyperparameters of the configuration to docstring and signature, which are made when asked for."""
        if "algorithm" in cls.__dict__:
            cls.__doc__ = Documentation(cls.__doc__)  # type: ignore[assignment]
            cls.__signature__ = Signature(inspect.signature(Agent.__init__))  # type: ignore[attr-defined]


Agent.load = ClassOnly(Agent.__dict__["load"])  # type: ignore[method-assign,assignment]
