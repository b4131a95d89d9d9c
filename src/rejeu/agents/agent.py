"""The class of all agents: what they consist of, what subclasses override, and what users call."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar, overload

import gymnasium as gym
import jax
import numpy as np

from rejeu.agents import policy as playing, summary, training
from rejeu.agents.signature import Documentation, Signature
from rejeu.algorithms import config as configs, contract
from rejeu.algorithms.config import AlgorithmConfig
from rejeu.algorithms.rnd import with_rnd
from rejeu.callbacks.base import Callback
from rejeu.checkpoints import model_files, resume
from rejeu.checkpoints.agent_state import (
    AGENT_ARGUMENTS,
    BEST_WINDOW,
    AnyAgent,
    Best,
    CallState,
    Files,
    Identity,
    Outputs,
    TrainingRecord,
)
from rejeu.checkpoints.run_files import CheckpointFolder, folder_of
from rejeu.checkpoints.run_folder import find_model
from rejeu.core import checkpoint, devices, hardware, spaces, validation, xla
from rejeu.core.algorithm import Algorithm, Masked, names
from rejeu.core.failed_writes import FailedWrites
from rejeu.core.normalization import normalized
from rejeu.core.types import AnyArray, Observation, PyTree, Settings
from rejeu.core.validation import as_path, number, whole
from rejeu.envs.base import seed_of_run
from rejeu.envs.make import Backend, VectorEnv, make_vector
from rejeu.envs.masks import make_masked, mask_leaf, n_choices, split
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise, check_fits
from rejeu.logs.evaluation import Evaluation, evaluate
from rejeu.logs.formatting import counted, html_table
from rejeu.logs.history import History
from rejeu.logs.logging import Logger, Sink, check_logs
from rejeu.training import finite
from rejeu.training.learner import Learner, PackedState
from rejeu.training.run import initial_run

if TYPE_CHECKING:
    from rejeu.agents.exporting import Exported

T = TypeVar("T")
READ_ONCE = ("seed", "stats_window_size", "device")
"""Arguments that cannot be set later."""
IN_BUFFER = {"buffer_size", "demonstration_share", "demonstrations", "frame_stack", "n_episodes", "n_steps", "offline"}
IN_BUFFER |= {"priorities", "replay_buffer_class", "replay_buffer_kwargs"}
"""Hyperparameters that a buffer which holds steps depends on."""


class PartOf(Generic[T]):
    """An attribute of an agent that is one of the values that it consists of, such as its ``identity``."""

    def __init__(self, owner: str) -> None:
        self.owner = owner

    def __set_name__(self, agent_class: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, agent: None, agent_class: type) -> Self: ...
    @overload
    def __get__(self, agent: Agent, agent_class: type) -> T: ...
    def __get__(self, agent: Agent | None, agent_class: type) -> Any:
        return self if agent is None else getattr(getattr(agent, self.owner), self.name)

    def __set__(self, agent: Agent, value: T) -> None:
        setattr(getattr(agent, self.owner), self.name, value)


class ClassOnly:
    """Makes ``load`` raise an error on an instance, where it would silently leave that instance as it was."""

    def __init__(self, method: Any) -> None:
        self.method = method
        self.__doc__ = method.__func__.__doc__

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is not None:
            raise TypeError(
                f"load is called on the class and returns a new agent: agent = {owner.__name__}.load(path); "
                "to change this one in place use agent.set_parameters(path)"
            )
        return self.method.__get__(None, owner)


class Agent(AnyAgent):
    """The base class of all agents. Abstract: use SAC, PPO or another algorithm.

    To add an algorithm, subclass :class:`rejeu.OffPolicyAgent` or :class:`rejeu.OnPolicyAgent`. Values that belong together
    are one: ``identity``, ``outputs``, the ``call`` of ``learn``, the ``record`` of training, ``files``.
    """

    algorithm: ClassVar[Any]
    """The object with ``Config`` and ``make``: a module, or a ``types.SimpleNamespace(Config=Config, make=make)``."""
    notes: list[str]
    """The notes of :func:`rejeu.sb3.load_zip` about the file; only of agents that it read."""

    policy_name = PartOf[str]("identity")
    """The argument ``policy``."""
    seed = PartOf[int]("identity")
    """Of networks, exploration, batches and environments."""
    stats_window_size = PartOf[int]("identity")
    """Episodes over which reported means are taken."""
    success_threshold = PartOf[float | None]("identity")
    """Least return of a successful episode where the environment does not report success."""
    best_window = PartOf[int]("identity")
    """Training episodes over whose mean return the best weights are chosen."""
    device = PartOf[str]("identity")
    """Where it computes: ``"auto"``, ``"cpu"`` or ``"gpu"``."""
    run_id = PartOf[str]("identity")
    """Identifies the run in its checkpoints."""
    made_from_id = PartOf[bool]("identity")
    """Whether the environments were made from an id."""
    trained_on = PartOf[tuple[str, Mapping[str, Any]] | None]("identity")
    """Id and keyword arguments of the environments a loaded agent was trained on, if its file contains them."""
    verbose = PartOf[int]("outputs")
    """Whether a table of statistics is printed while it learns."""
    log = PartOf[tuple[str, ...]]("outputs")
    """Names of the logs to which rows of statistics are written."""
    tensorboard_log = PartOf[str | Path | None]("outputs")
    """Folder of the folders of these logs; None for ``logs``."""
    history = PartOf[History]("record")
    """Every episode of training."""
    ep_info_buffer = PartOf[deque[dict[str, float]]]("record")
    """The last episodes, each ``{"r": return, "l": length, "t": seconds}``."""
    ep_success_buffer = PartOf[deque[float]]("record")
    """Whether the last episodes succeeded, of those for which that is known."""
    steps_per_second = PartOf[float]("record")
    """Environment steps per second in the current or last ``learn``."""
    best = PartOf[Best | None]("record")
    """The best weights so far, by mean training return or by evaluation."""
    failed_writes = PartOf[FailedWrites]("files")
    """The files that ``learn`` could not write, such as checkpoints and log rows when the disk is full."""
    last_saved = PartOf[Path | None]("files")
    """The newest file that :meth:`save` wrote."""
    report_folder = PartOf[str | Path | None]("files")
    """Where batches that led to a non-finite number are saved; None: see :func:`rejeu.training.finite.folder_of`."""

    @classmethod
    def converted(cls, settings: Mapping[str, object]) -> Settings:
        """Converts keyword arguments of the constructor and of ``load`` from another form, such as Stable-Baselines3's."""
        return dict(settings)

    def __init__(
        self,
        policy: str,
        env: Any,
        *,
        seed: int | None = None,
        verbose: int = 0,
        log: str | Sequence[str] = (),
        tensorboard_log: str | Path | None = None,
        stats_window_size: int = 100,
        success_threshold: float | None = None,
        best_window: int = BEST_WINDOW,
        device: str = "auto",
        **hyperparameters: Any,
    ) -> None:
        hyperparameters = self.converted(hyperparameters)
        names = [*validation.field_names(self.algorithm.Config), *AGENT_ARGUMENTS]
        shape = validation.field_names(self.algorithm.Config.policy_kwargs_class)
        validation.check_names(hyperparameters, names, self.name, shape)
        config = self.algorithm.Config(**hyperparameters)
        self.configure(config, Identity.of(policy, seed, stats_window_size, success_threshold, best_window, device))
        self.set_outputs(verbose, log, tensorboard_log)
        self.made_from_id = isinstance(env, str)
        vector = self.make_envs(env, 1, seed=self.seed)
        spaces.check_policy(policy, vector.observation_space, self.config.policy_kwargs.normalize_images)
        self.build(vector.observation_space, vector.action_space)
        xla.start_device(self.n_threads(vector.n_envs))
        self.start_run(vector)

    def configure(self, config: Any, identity: Identity) -> None:
        """Sets what does not depend on the environment."""
        contract.check_config(config)
        self.config, self.identity = config, identity
        self.logger, self.call, self.files = Logger(), CallState(), Files()
        self.record = TrainingRecord(identity.stats_window_size)
        xla.enable_cache()

    def set_outputs(
        self, verbose: int = 0, log: str | Sequence[str] = (), tensorboard_log: str | Path | None = None
    ) -> None:
        """Sets where rows of statistics go; raises ``ValueError`` for an unknown log."""
        logs = check_logs("log", log) if tensorboard_log is None else (*check_logs("log", log), "tensorboard")
        self.outputs = Outputs(verbose, tuple(dict.fromkeys(logs)), tensorboard_log)

    def build(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        """Makes the algorithm for these spaces, and its learner."""
        self.observation_space, self.action_space = observation_space, action_space
        self.obs_leaves = spaces.leaves(observation_space)
        self.config = configs.with_widths(self.config, self.obs_leaves)
        noise = self.make_noise()
        if noise is not None:
            check_fits(noise, action_space)
        self.learner = Learner(self.algorithm_of(self.config), noise, self.config.nonfinite == "skip")

    if not TYPE_CHECKING:  # so that a misspelt name is found by a type checker

        def __getattr__(self, name: str) -> Any:
            """Returns a hyperparameter."""
            hyperparameters = validation.field_names(type(self).algorithm.Config)
            if name in hyperparameters and "config" in self.__dict__:
                return getattr(self.config, name)
            public = [attribute for attribute in dir(type(self)) if not attribute.startswith("_")]
            near = difflib.get_close_matches(name, [*hyperparameters, *public], 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}{hint}")

    def __setattr__(self, name: str, value: object) -> None:
        """Sets an attribute; one that agents do not have by :meth:`assign`."""
        has_it = name not in READ_ONCE and (name in self.__dict__ or hasattr(type(self), name))
        if has_it or "run" not in self.__dict__:
            object.__setattr__(self, name, value)
        else:
            Agent.assign(self, name, value)

    def assign(self, name: str, value: object) -> None:
        """Sets a hyperparameter, which counts from the next update on, or an attribute of a class of your own.

        Raises:
            AttributeError: for a name that agents do not have, or that only the constructor takes.
            ValueError: for a hyperparameter that networks or buffer depend on.
        """
        if name in READ_ONCE:
            raise AttributeError(f"{name} of {self.name} is read when it is made; give it to the constructor or load")
        if name in validation.field_names(self.algorithm.Config):
            self.change(dataclasses.replace(self.config, **self.converted({name: value})))
        elif type(self).__module__.startswith("rejeu."):
            getattr(self, name)  # raises
        else:
            object.__setattr__(self, name, value)

    def change(self, new: AlgorithmConfig) -> None:
        """Replaces the hyperparameters; the new ones count from the next update on, also within ``learn``, and are compiled.

        Args:
            new: its configuration with other values, from ``dataclasses.replace``.

        Raises:
            ValueError: if one does not fit the networks, the optimizers or what the buffer holds; nothing has changed then.
        """
        finite.settle(self)
        old, learner, run = self.config, self.learner, self.run
        changed = {key for key in validation.field_names(type(old)) if getattr(old, key) != getattr(new, key)}
        try:
            self.config = new
            self.build(self.observation_space, self.action_space)
            trees = learner.shapes, self.learner.shapes
            arrays, others = (dict(zip(names(tree), jax.tree.leaves(tree), strict=True)) for tree in trees)
            if arrays != others or changed & {"action_masks", "action_repeat", "action_share"}:
                raise ValueError(
                    f"{', '.join(changed)} cannot be set on a {self.name} whose networks were made without"
                )
            if changed & IN_BUFFER and run.replay is not None:
                if run.replay.size():
                    raise ValueError(f"{', '.join(changed)} cannot be set on a {self.name} whose buffer holds steps")
                run.replay, run.obs, run.action = self.make_buffer(run.env), None, None
        except ValueError as error:
            self.config, self.learner = old, learner
            raise ValueError(f"{error}; give it to the constructor or load") from None
        if "gamma" in changed and run.replay is not None:
            run.replay.set_gamma(self.config.gamma)
        if "action_noise" in changed:
            run.carry = self.learner.initial_carry(self.n_envs)
        if "learning_starts" in changed:
            run.learn_from += self.config.learning_starts - old.learning_starts

    def algorithm_of(self, config: Any) -> Algorithm:
        """Returns the algorithm for the agent's spaces and a configuration, on raw observations and rewards."""
        unchecked = self.algorithm.make(config, self.observation_space, self.action_space)
        algorithm = contract.checked(unchecked, self.action_space)
        if config.rnd is not None:
            algorithm = with_rnd(algorithm, self.obs_leaves, config.rnd)
        if config.normalize is None:
            return algorithm
        explorer = exploration.make(algorithm, None if algorithm.recall else self.make_noise())
        return normalized(algorithm, explorer, self.obs_leaves, config.normalize, config.gamma)

    def n_threads(self, n_envs: int) -> int:
        """Returns how many threads JAX should use: all for images and large layers, else one."""
        weights = [leaf.size for leaf in jax.tree.leaves(self.learner.shapes) if len(leaf.shape) > 1]
        is_much = self.gradient_batch_size(n_envs) * max(weights, default=0) > xla.LITTLE_WORK
        return hardware.cores() if is_much or any(leaf.kind == "image" for leaf in self.obs_leaves) else 1

    def start_run(self, env: VectorEnv | None, state: PackedState | None = None) -> None:
        """Starts a run on ``env`` with an empty buffer; without ``env`` the agent only predicts.

        Args:
            env: the environments.
            state: the state of the algorithm, packed; None initializes it from the seed.
        """
        buffer, learn_from = (None, 0) if env is None else (self.make_buffer(env), self.first_learning_step(0))
        with devices.chosen(self.device):
            self.run = initial_run(env, buffer, self.learner, learn_from, self.seed, state)

    def make_envs(self, env: Any, n_envs: int = 1, backend: Backend = "auto", seed: int | None = None) -> VectorEnv:
        """Returns vector environments for this agent; the arguments are those of :func:`rejeu.make_vector`."""
        vector = (make_masked if self.takes_masks else make_vector)(env, n_envs, backend, seed)
        if self.config.action_share != 1.0 or vector.own_action_space is not None:
            vector.limit_actions(self.config.action_share)
        return vector

    @abstractmethod
    def make_noise(self) -> Noise | None:
        """Returns the exploration noise, None for none."""

    @abstractmethod
    def make_buffer(self, env: VectorEnv) -> Any:
        """Returns an empty buffer for transitions of ``env``."""

    @abstractmethod
    def keep_buffer(self, env: VectorEnv) -> None:
        """Called when ``env`` replaces the environments, with as many of the same spaces; the buffer is kept."""

    @abstractmethod
    def drop_rollout(self) -> None:
        """Discards transitions that only the policy that collected them can learn from."""

    @abstractmethod
    def start_episodes(self) -> None:
        """Starts a new episode in every environment."""

    def abandon_episodes(self) -> None:
        """Abandons the running episodes, because their environments were used for something else.

        During ``learn`` new episodes start at once, so that a checkpoint of this step contains them; otherwise they start
        with the next ``learn``.
        """
        self.run.obs = self.run.action = None
        if self.call.is_learning:
            self.start_episodes()

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C or SIGTERM ended the last ``learn``."""
        return self.call.interrupted_by is not None

    @property
    def policy(self) -> Any:
        """The name of its policy."""
        return self.policy_name

    @property
    def env(self) -> VectorEnv | None:
        """The environments it trains on; None after ``load`` without one."""
        return self.run.env

    @property
    def _place(self) -> str:
        """The id of its environments; of a loaded agent, that of the environments it was trained on, if it is known."""
        if self.run.env is not None:
            return self.run.env.env_id
        return "no environment" if self.trained_on is None else f"no environment, trained on {self.trained_on[0]}"

    @property
    def n_updates(self) -> int:
        """Total gradient steps."""
        return self.run.n_updates

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time spent training, in seconds: ``total``, and of it ``env``, ``replay`` and ``update``."""
        return dict(self.run.seconds)

    def with_masks(self, obs: Observation, masks: AnyArray) -> Any:
        """Returns a batch of observations together with action masks, if the agent takes any; None allows all actions.

        Raises:
            TypeError: if masks are given to an agent that takes none.
            ValueError: if their shape is not that of the actions.
        """
        if not self.takes_masks:
            if masks is not None:
                raise TypeError(f"{self.name}.predict takes no action_masks; it was made without action_masks=True")
            return obs
        n, size = len(jax.tree.leaves(obs)[0]), n_choices(self.action_space, self.name)
        mask = np.ones((n, size), bool) if masks is None else np.asarray(masks, bool)
        if mask.size != n * size:
            raise ValueError(f"action_masks has shape {mask.shape}, expected {(n, size)}")
        return Masked(obs, mask.reshape(n, size))

    def observed(self, env: VectorEnv) -> tuple[tuple[spaces.Leaf, ...], Any]:
        """Returns the leaves and the structure of what it acts on in ``env``: observations, and masks if it takes any."""
        structure = spaces.structure(env.observation_space)
        if not self.takes_masks:
            return self.obs_leaves, structure
        structure = jax.tree.structure(Masked(jax.tree.unflatten(structure, self.obs_leaves), 0))
        return (*self.obs_leaves, mask_leaf(env.action_space, env.env_id)), structure

    def __repr__(self) -> str:
        return f"<rejeu.{self.name} on {self._place}, {self.run.step} steps, {self.run.n_updates} updates>"

    def _repr_html_(self) -> str:
        """Returns a table for notebooks."""
        counts = f"{counted(self.run.step, 'step')}, {counted(self.run.n_updates, 'update')}"
        rows = [(self.name, self._place), ("seed", str(self.seed)), ("trained", counts)]
        if len(self.history):
            rows.append(("episodes", repr(self.history).removeprefix("<History: ").removesuffix(">")))
        return html_table(rows)

    def __init_subclass__(cls) -> None:
        """Adds the hyperparameters of the configuration to docstring and signature, which are made when asked for."""
        if "algorithm" in cls.__dict__:
            cls.__doc__ = Documentation(cls.__doc__)  # type: ignore[assignment]
            cls.__signature__ = Signature(inspect.signature(Agent.__init__))  # type: ignore[attr-defined]

    q_values = playing.q_values

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: Callback | Iterable[Callback] | None = None,
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
            total_timesteps: environment steps, over all environments, rounded up to whole turns or rollouts. None with
                ``episodes`` or ``minutes``.
            callback: one or several, called after every step as ``callback(agent, progress)``; ``False`` stops training.
                A :class:`rejeu.callbacks.TrainingCallback` is also called when training starts and ends, as are those
                of :mod:`rejeu.sb3.common.callbacks`.
            log_interval: episodes between two rows of statistics.
            tb_log_name: name of the folder of the logs, without its number; None: the algorithm's.
            reset_num_timesteps: count steps from 0 and restart schedules (learning rate, exploration, clip range, beta).
                With False both continue as in Stable-Baselines3: earlier steps count as done and as part of the total,
                so ``learn(300, reset_num_timesteps=False)`` after 100 steps moves schedules from 1/4 to the end.
                Weights and buffer are kept in either case.
            progress_bar: show a progress bar.
            episodes: stop after this number of episodes, over all environments.
            minutes: stop after so many, without compilation. Schedules follow the nearest limit; with
                ``reset_num_timesteps=False`` earlier episodes and training time count as earlier steps do.
            sinks: further outputs for the rows of statistics, such as ``rejeu.logs.logging.CsvFile(path)`` or
                ``rejeu.logs.trackers.WandB(project="car")``; they are not closed.

        Without any limit, an agent from :meth:`resume` completes the ``learn`` that was interrupted, with the limits and
        the ``log_interval`` of that call.

        Ctrl-C and SIGTERM end training after the current step; ``interrupted`` is then True.

        Raises:
            ValueError: without an environment or a limit.
            RuntimeError: if the agent is learning, in a callback or another thread.
        """
        call = training.start_call(self, total_timesteps, episodes, minutes, log_interval, reset_num_timesteps)
        with devices.chosen(self.device):
            training.train(self, call, callback, tb_log_name, progress_bar, sinks)
        return self

    remember_best = training.remember_best

    def restore_best(self) -> Self:
        """Restores the best weights so far: networks, targets and optimizers of one moment.

        Raises:
            ValueError: before ``best_window`` episodes have finished or one evaluation was made.
        """
        if self.best is None:
            raise ValueError(
                f"no best weights are known yet: they are kept after {counted(self.best_window, 'episode')} of training, "
                "and at every evaluation by rejeu.callbacks.Evaluate"
            )
        self.run.state = self.learner.copy(self.best.state)
        self.drop_rollout()
        return self

    def statistics(self) -> dict[str, float]:
        """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
        return training.statistics_row(self)

    def predict(
        self,
        observation: Observation,
        state: PyTree = None,
        episode_start: AnyArray = None,
        deterministic: bool = False,
        action_masks: AnyArray = None,
    ) -> tuple[np.ndarray, PyTree]:
        """Returns actions in the environment's own range, and the next state of a policy that has one (else ``state``).

        Recurrent policies have a state, and those with ``action_repeat``, which hold their last action in it.

        Args:
            observation: one observation of the environment's space, or a batch of them with a leading axis; the action
                has a leading axis if and only if the observation has.
            state: what the last call returned, for a policy that has one; None at the start of episodes.
            episode_start: whether an episode starts with this observation, ``bool (batch,)``; the state of a recurrent
                policy is reset there, and a new action chosen. None for nowhere.
            deterministic: return the mode of the policy; False samples from it, which gives the same action if the policy
                is deterministic (DDPG, TD3). ``action_noise`` is used in training only.
            action_masks: which actions are allowed, ``bool (batch, n)`` or ``(n,)``, for agents that take masks; None
                allows all.

        Raises:
            ValueError: if observation, mask or ``state`` have the wrong structure or shape.
        """
        if self.takes_masks:
            observation, action_masks = split(observation, action_masks)
        batch, single = spaces.as_batch(observation, self.observation_space, self.obs_leaves)
        batch = self.with_masks(batch, action_masks)
        n = len(jax.tree.leaves(batch)[0])
        ended = np.zeros(n, bool) if episode_start is None else np.asarray(episode_start, bool).reshape(n)
        with devices.chosen(self.device):
            action, memory = playing.act(self, batch, deterministic, state, ended)
        scaled = spaces.scale_action(self.action_space, action)
        scaled = jax.tree.map(lambda array: array[0], scaled) if single else scaled
        return scaled, state if memory is None else memory

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
            episodes: number of episodes; None: 100, or with ``minutes`` as many as there is time for.
            env: the environments, as for the constructor. None: new ones like the training environments if these were
                made from an id, else the training environments themselves, whose running episodes are then abandoned.
            deterministic: use the mode of the policy; False samples from it, as :meth:`predict` does.
            seed: of the environments; None draws one for new environments and does not seed others.
            success_threshold: least return of a successful episode where the environment does not report success; None:
                that of the agent.
            minutes: without compilation, after which no further episode starts. Episodes that have started are completed and
                count, so that long ones are not left out, and every environment plays at least one. None for no limit.

        A callback may call it during ``learn``. If it uses the training environments, training continues in new
        episodes.

        Raises:
            ValueError: if there are no environments, or their spaces or a missing ``VecNormalize`` do not match.
        """
        threshold = self.success_threshold if success_threshold is None else success_threshold
        if episodes is None and minutes is None:
            episodes = playing.USUAL_EPISODES
        episodes = None if episodes is None else whole("episodes", episodes, least=1)
        seconds = None if minutes is None else 60 * number("minutes", minutes, above=0)
        with devices.chosen(self.device), playing.evaluation_env(self, env, episodes, seed) as (vector, again):
            return evaluate(playing.policy(self, deterministic), vector, episodes, threshold, again, seconds)

    def report(self, path: str | Path, evaluations: Iterable[tuple[int, Evaluation]] = ()) -> Path:
        """Writes a page about the training so far, one HTML file that needs no network, and returns its path.

        A run of ``rejeu train`` has more to show; see :func:`rejeu.write_report`.

        Args:
            path: of the page.
            evaluations: ``(step, Evaluation)`` pairs, such as ``Evaluate.results``.

        Raises:
            MissingExtra: if plotly or jinja2 is not installed.
        """
        import rejeu  # whose wings the library does not import

        return rejeu.write_report(self, path, evaluations)

    def save(self, path: str | Path) -> Path:
        """Writes the model to one safetensors file, without the replay buffer, and returns its path.

        ``.safetensors`` is added to a path without a suffix. The file contains the parameters, optimizers,
        hyperparameters, spaces and counters. An older file at that path is replaced only when the new one is complete.
        """
        return self.snapshot(path)()

    def snapshot(self, path: str | Path) -> Callable[[], Path]:
        """Returns a function that writes the model as it is now, as :meth:`save` does."""
        arrays, header = Agent.get_parameters(self), model_files.header(self)

        def write() -> Path:
            self.last_saved = checkpoint.write(path, "agent", arrays, header)
            return self.last_saved

        return write

    def export(
        self,
        path: str | Path,
        to: str | None = None,
        *,
        noise: bool = False,
        batch: int | None = None,
        frame_stack: int | None = None,
    ) -> Exported:
        """Writes the policy to a file that acts as :meth:`predict` does, outside of rejeu.

        It takes raw observations, one input for each array, and returns actions of the environment: normalization, scaling
        and clipping are inside. The state of a recurrent policy and action masks are inputs. Before the file is kept it is
        compared with ``predict(deterministic=True)`` on 1,000 observations, recorded in a new environment, or sampled from
        the observation space if none can be made. A card in JSON is written beside it.

        Args:
            path: of the file. An older one is replaced only when the new one is complete.
            to: ``"onnx"``, ``"c"``, ``"stablehlo"``, ``"npz"`` or ``"web"``; None goes by the suffix: ``.onnx``, ``.c`` (with
                a header beside it), ``.stablehlo``, ``.npz`` (for :func:`rejeu.load_policy`) or ``.html``. A page contains the
                environment too, which must be CartPole, Pendulum, MountainCar, MountainCarContinuous, Ball or parking.
            noise: sample from the policy, with the random numbers as further inputs; else take its mode.
            batch: observations at once; None for any number. C and pages take one, NumPy any number.
            frame_stack: frames of which each observation is a stack, as of ``FrameStackObservation`` or ``VecFrameStack``. The
                file takes single frames then, and the stack is a part of its state. None for the agent's ``frame_stack``.

        Raises:
            ValueError: if a part of the policy cannot be expressed in the format, or the file acts otherwise than
                ``predict``; nothing is written then.
            MissingExtra: if ``onnx`` is not installed.
            OSError: if the file cannot be written.
        """
        from rejeu.agents import exporting

        with devices.chosen(self.device):
            return exporting.export(self, path, to, noise, batch, frame_stack=frame_stack)

    @classmethod
    def load(cls, path: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of a model file. No code from the file is run.

        Args:
            path: as given to :meth:`save`, or a run folder, whose best model is loaded.
            env: environments to continue training in; None for an agent that only predicts and evaluates. It evaluates in
                new environments like those it was trained on, if these were made from a registered id.
            changes: constructor arguments and hyperparameters that replace the saved ones.

        Raises:
            FileNotFoundError: if there is no such file.
            CheckpointError: if the file is damaged, or its algorithm, spaces, schema or shapes do not match.
        """

        def make_envs(agent: Self) -> VectorEnv | None:
            return None if env is None else agent.make_envs(env, seed=agent.identity.seed)

        with checkpoint.opened(find_model(path), "agent") as file:
            agent = model_files.load(cls, file, make_envs, changes)
        agent.made_from_id = isinstance(env, str)
        return agent

    @classmethod
    def resume(cls, folder: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of the newest checkpoint of a run; ``learn()`` then completes the run.

        Parameters, replay buffer, running episodes, exploration, random numbers, counters, statistics and the state of
        callbacks are restored (give ``learn`` the same callbacks). If the environments can be saved (see
        :mod:`rejeu.envs.snapshot`) or can repeat their episodes (EnvPool), the run continues bit for bit as it would have
        without the interruption. Otherwise new episodes start, with a warning. See ``resumed``.

        Args:
            folder: as given to :class:`rejeu.callbacks.Checkpoint`, or one of the checkpoints in it.
            env: as for the constructor; None makes as many environments of the same id.
            changes: hyperparameters that replace the saved ones.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if the checkpoints are damaged, or of another algorithm or environment.
        """
        return resume.resume(cls, as_path(folder), env, changes)

    def checkpoint_folder(self, folder: str | Path) -> CheckpointFolder:
        """Returns a folder for the checkpoints of its run, which :class:`rejeu.callbacks.Checkpoint` writes."""
        return folder_of(self, as_path(folder))

    def get_env(self) -> Any:
        """Returns the training environments with the interface of Stable-Baselines3's ``VecEnv``; None if there are none.

        That is the vector environment that was given, if it resets itself; a Gymnasium environment is returned in a
        ``DummyVecEnv``. Its running episodes are abandoned: the next ``learn`` starts new ones. Do not step it during
        ``learn``.
        """
        env = self.run.env
        if env is None:
            return None
        if not self.call.is_learning:
            self.abandon_episodes()
        if env.venv is None:
            import rejeu  # whose wings the library does not import

            env.venv = rejeu.to_vec_env(env)
        return env.venv

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Replaces the environment by another with the same spaces; new episodes start there.

        If the number of environments changes, a replay buffer starts empty, and ``learning_starts`` steps are taken before
        the next gradient step, as after ``load``. Otherwise the buffer is kept.

        The best weights are kept, and later returns are compared with theirs: set ``best`` to None if returns in the new
        environment mean something else.

        Raises:
            ValueError: if the spaces differ.
            RuntimeError: during ``learn``.
        """
        if self.call.is_learning:
            raise RuntimeError(
                "set_env was called while the agent learns; stop training first (a callback that returns False), then "
                "call set_env and learn(..., reset_num_timesteps=False)"
            )
        vector = self.make_envs(env, 1, seed=seed_of_run(self.seed))
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

    def get_parameters(self) -> dict[str, np.ndarray]:
        """Returns a copy of the algorithm's state as arrays by name: networks, targets, optimizers, counters."""
        return {key: value.copy() for key, value in checkpoint.tree_to_arrays(self.state).items()}

    def set_parameters(
        self, load_path_or_dict: Mapping[str, np.ndarray] | str | Path, exact_match: bool = True
    ) -> None:
        """Sets parameters from :meth:`get_parameters` or from a model file.

        Args:
            load_path_or_dict: arrays by name, or a path.
            exact_match: require all parameters; False sets those that are given and keeps the others.

        Raises:
            CheckpointError: if a name, shape or dtype does not match; the agent is then unchanged.
        """
        source = load_path_or_dict
        if not isinstance(source, Mapping):
            path = source
            with checkpoint.opened(path, "agent") as file:
                shapes = self.learner.shapes
                defaults = {} if exact_match else dict(zip(names(shapes), jax.tree.leaves(shapes), strict=True))
                checkpoint.match(shapes, {**defaults, **file.specs}, path)
                source = file.read()
            checkpoint.require_finite(source, path)
        arrays = {key: np.asarray(value) for key, value in source.items()}
        if not exact_match:
            arrays = Agent.get_parameters(self) | arrays
        state = checkpoint.arrays_to_tree(self.learner.shapes, arrays, "set_parameters: the source")
        self.run.state = self.learner.pack(state)
        self.drop_rollout()

    def summary(self) -> str:
        """Returns a table of the networks, their layers and numbers of parameters; see :mod:`rejeu.agents.summary`."""
        return summary.describe(self.learner.shapes, self.obs_leaves)


Agent.load = ClassOnly(Agent.__dict__["load"])  # type: ignore[method-assign,assignment]
