"""The state of an agent: its configuration, learner, environments and run, and the methods that subclasses override.

The functions of this package work on a :class:`BaseAgent`. :class:`rejeu.agents.agent.Agent` adds what users call.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import math
import secrets
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.algorithms import config as configs, contract
from rejeu.algorithms.config import AlgorithmConfig
from rejeu.algorithms.rnd import with_rnd
from rejeu.callbacks.base import Stateful
from rejeu.core import devices, hardware, spaces, validation, xla
from rejeu.core.algorithm import Algorithm, Masked, names
from rejeu.core.failed_writes import FailedWrites
from rejeu.core.normalization import normalized
from rejeu.core.types import AnyArray, Observation, Settings
from rejeu.core.validation import number, whole, whole_seed
from rejeu.envs.make import Backend, VectorEnv, make_vector
from rejeu.envs.masks import make_masked, mask_leaf, n_choices
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise, check_fits
from rejeu.logs.formatting import counted, html_table
from rejeu.logs.history import History
from rejeu.logs.logging import Logger, check_logs
from rejeu.training import finite
from rejeu.training.compiled import Stops
from rejeu.training.learner import Learner, PackedState
from rejeu.training.run import Progress, Run, TrainingCall, initial_run

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

READ_ONCE = ("seed", "stats_window_size", "device")
"""Arguments that cannot be set later."""


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


class BaseAgent(ABC):
    """The common base of agents. Abstract: subclass :class:`rejeu.OffPolicyAgent` or :class:`rejeu.OnPolicyAgent`."""

    algorithm: ClassVar[Any]
    """The object with ``Config`` and ``make``: a module, or a ``types.SimpleNamespace(Config=Config, make=make)``."""
    policy_name: str
    """The argument ``policy``."""
    device: str
    """Where it computes: ``"auto"``, ``"cpu"`` or ``"gpu"``."""
    on_device: bool | None = None
    """Whether ``learn`` trains in one program on the device: True requires it, False uses the loop of the host. None uses the
    device where the environments are JAX environments and the settings allow it; see ``docs/device.md``."""
    stops: Stops | None = None
    """During a ``learn`` on the device: where the program returns to the host. None with the loop of the host."""
    run: Run
    """The state that every step changes: environments, buffer, counters, and the state of the algorithm."""
    run_id: str
    """Identifies the run in its checkpoints."""
    is_learning: bool = False
    """Whether ``learn`` is running."""
    n_together: int = 1
    """Runs in the program of the current or last ``learn``."""
    training_call: TrainingCall | None = None
    """The current or last call of ``learn``: its limits and progress."""
    interrupted: bool = False
    """Whether Ctrl-C or SIGTERM ended the last ``learn``."""
    interrupted_by: int | None = None
    """The number of that signal."""
    reset_step: int = 0
    """Total environment steps when the last ``learn`` with ``reset_num_timesteps=True`` started."""
    reset_episode: int = 0
    """Total finished episodes at that time."""
    reset_seconds: float = 0.0
    """Total training time at that time, in seconds."""
    history: History
    """Every episode of training."""
    ep_info_buffer: deque[dict[str, float]]
    """The last episodes, each ``{"r": return, "l": length, "t": seconds}``."""
    ep_success_buffer: deque[float]
    """Whether the last episodes succeeded, of those for which that is known."""
    steps_per_second: float = math.nan
    """Environment steps per second in the current or last ``learn``."""
    verbose: int = 0
    """Whether a table of statistics is printed while it learns."""
    log: tuple[str, ...] = ()
    """Names of the logs to which rows of statistics are written."""
    tensorboard_log: str | Path | None = None
    """Folder of the folders of these logs; None for ``logs``."""
    logger: Logger
    """Accepts further numbers for the rows of statistics."""
    best: Best | None = None
    """The best weights so far, by mean training return or by evaluation."""
    callbacks: Sequence[Stateful] = ()
    """The callbacks of the current or last ``learn`` whose state a checkpoint contains."""
    saved_callbacks: list[tuple[str, Any]] | None = None
    """Class names and states of callbacks in a resumed checkpoint, until ``learn`` restores them."""
    resumed: Resumed | None = None
    """Where :meth:`resume` continued the run; None for a new or loaded agent."""
    checkpoint_folders: dict[Path, Any]
    """Folders that contain its checkpoints, by path."""
    failed_writes: FailedWrites
    """The files that ``learn`` could not write, such as checkpoints and log rows when the disk is full."""
    notes: list[str]
    """The notes of :func:`rejeu.sb3.load_zip` about the file; only of agents that it read."""
    predict: Callable[..., Any]
    last_saved: Path | None = None
    """The newest file that :meth:`save` wrote."""
    report_folder: Path | None = None
    """Where batches that led to a non-finite number are saved; None: see :func:`rejeu.training.finite.folder_of`."""
    made_from_id: bool = False
    """Whether the environments were made from an id."""
    trained_on: tuple[str, Mapping[str, Any]] | None = None
    """Id and keyword arguments of the environments a loaded agent was trained on, if its file contains them."""
    n_predictions: int = 0
    """Calls of ``predict`` that drew from the policy; each draws with a key of its own."""
    carry_shapes: Any = None
    """Shapes of a recurrent policy's state for one episode; computed when they are first needed."""

    @staticmethod
    def converted(settings: Mapping[str, object]) -> Settings:
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
        self.configure(policy, config, seed, stats_window_size, success_threshold, best_window, device)
        self.set_outputs(verbose, log, tensorboard_log)
        self.made_from_id = isinstance(env, str)
        vector = self.make_envs(env, 1, seed=self.seed)
        spaces.check_policy(policy, vector.observation_space, self.config.policy_kwargs.normalize_images)
        self.build(vector.observation_space, vector.action_space)
        xla.start_device(self.n_threads(vector.n_envs))
        self.start_run(vector)

    def configure(
        self,
        policy: str,
        config: Any,
        seed: int | None = None,
        stats_window_size: int = 100,
        success_threshold: float | None = None,
        best_window: int = BEST_WINDOW,
        device: str = "auto",
    ) -> None:
        """Sets what does not depend on the environment; raises ``ValueError`` for an invalid value."""
        contract.check_config(config)
        self.policy_name, self.config = policy, config
        self.seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else whole_seed(seed)
        self.stats_window_size = whole("stats_window_size", stats_window_size, least=1)
        self.success_threshold = None if success_threshold is None else number("success_threshold", success_threshold)
        self.best_window = whole("best_window", best_window, least=1)
        self.device, self.run_id = devices.named(device), secrets.token_hex(8)
        self.history, self.logger, self.failed_writes = History(), Logger(), FailedWrites()
        self.ep_info_buffer = deque(maxlen=self.stats_window_size)
        self.ep_success_buffer = deque(maxlen=self.stats_window_size)
        self.checkpoint_folders = {}
        xla.enable_cache()

    def set_outputs(
        self, verbose: int = 0, log: str | Sequence[str] = (), tensorboard_log: str | Path | None = None
    ) -> None:
        """Sets where rows of statistics go; raises ``ValueError`` for an unknown log."""
        logs = check_logs("log", log) if tensorboard_log is None else (*check_logs("log", log), "tensorboard")
        self.verbose, self.log, self.tensorboard_log = verbose, tuple(dict.fromkeys(logs)), tensorboard_log

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
            BaseAgent.assign(self, name, value)

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
        kept_in_buffer = {
            "buffer_size",
            "demonstration_share",
            "demonstrations",
            "frame_stack",
            "n_episodes",
            "n_steps",
        }
        kept_in_buffer |= {"offline", "priorities", "replay_buffer_class", "replay_buffer_kwargs"}
        try:
            self.config = new
            self.build(self.observation_space, self.action_space)
            arrays, others = (
                dict(zip(names(x), jax.tree.leaves(x), strict=True)) for x in (learner.shapes, self.learner.shapes)
            )
            if arrays != others or "action_masks" in changed:
                raise ValueError(
                    f"{', '.join(changed)} cannot be set on a {self.name} whose networks were made without"
                )
            if changed & kept_in_buffer and run.replay is not None:
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
        if any(leaf.kind == "image" for leaf in self.obs_leaves):
            return hardware.cores()
        weights = [leaf.size for leaf in jax.tree.leaves(self.learner.shapes) if len(leaf.shape) > 1]
        return xla.threads_for(self.gradient_batch_size(n_envs) * max(weights, default=0))

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
        return (make_masked if self.takes_masks else make_vector)(env, n_envs, backend, seed)

    @abstractmethod
    def make_noise(self) -> Noise | None:
        """Returns the exploration noise, None for none."""

    @abstractmethod
    def gradient_batch_size(self, n_envs: int) -> int:
        """Returns the number of transitions in the batch of one gradient step."""

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

    @abstractmethod
    def start_episodes(self) -> None:
        """Starts a new episode in every environment."""

    def abandon_episodes(self) -> None:
        """Abandons the running episodes, because their environments were used for something else.

        During ``learn`` new episodes start at once, so that a checkpoint of this step contains them; otherwise they start
        with the next ``learn``.
        """
        self.run.obs = self.run.action = None
        if self.is_learning:
            self.start_episodes()

    @property
    def name(self) -> str:
        """The algorithm's name."""
        return self.algorithm.Config.name

    @property
    def policy(self) -> Any:
        """The name of its policy."""
        return self.policy_name

    @property
    def env(self) -> VectorEnv | None:
        """The environments it trains on; None after ``load`` without one."""
        return self.run.env

    @property
    def origin(self) -> tuple[str, Mapping[str, Any]] | None:
        """Id and keyword arguments of its environments or those it was trained on; None if they were not made from an id."""
        return self.trained_on if self.run.env is None else self.run.env.made_from

    @property
    def _place(self) -> str:
        """The id of its environments; of a loaded agent, that of the environments it was trained on, if it is known."""
        if self.run.env is not None:
            return self.run.env.env_id
        return "no environment" if self.trained_on is None else f"no environment, trained on {self.trained_on[0]}"

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
    def num_timesteps(self) -> int:
        """Environment steps since the last ``learn`` with ``reset_num_timesteps=True`` started."""
        return self.run.step - self.reset_step

    @property
    def n_updates(self) -> int:
        """Total gradient steps."""
        return self.run.n_updates

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time spent training, in seconds: ``total``, and of it ``env``, ``replay`` and ``update``."""
        return dict(self.run.seconds)

    @property
    def takes_masks(self) -> bool:
        """Whether its policy takes masks of the allowed actions."""
        return self.config.action_masks

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

    def get_vec_normalize_env(self) -> Any:
        """Returns the ``VecNormalize`` around the training environments, or None."""
        env = self.run.env
        return None if env is None else env.vec_normalize

    def check_spaces(self, vector: VectorEnv, source: str) -> None:
        """Raises ``ValueError`` if environments, called ``source`` in the message, have other spaces than the agent."""
        for name in ("observation", "action"):
            ours, theirs = getattr(self, f"{name}_space"), getattr(vector, f"{name}_space")
            if not spaces.same(ours, theirs, bounds=name == "action"):
                raise ValueError(f"{source} has the {name} space {theirs}, and this agent was made for {ours}")

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
            cls.__signature__ = Signature(inspect.signature(BaseAgent.__init__))  # type: ignore[attr-defined]


class Documentation:
    """A class attribute ``__doc__``: the docstring of the class, of its configuration and of every hyperparameter."""

    def __init__(self, text: str | None) -> None:
        self.text = inspect.cleandoc(text or "")

    def __get__(self, instance: object, owner: type) -> str:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        docs = validation.field_docs(config)
        lines = [f"    {key}: {text}" for key, text in AGENT_ARGUMENTS.items()]
        for key, default in validation.field_defaults(config).items():
            text = f"{docs[key]} " if key in docs else ""
            lines.append(
                f"    {key}: {text}" + ("" if default is inspect.Parameter.empty else f"Default: {default!r}.")
            )
        config_text = inspect.cleandoc(config.__doc__ or "")
        return "\n".join([self.text, "", config_text, "", "Args:", *lines])


class Signature:
    """A class attribute ``__signature__``: what every agent takes, then the hyperparameters."""

    def __init__(self, common: inspect.Signature) -> None:
        self.common = common
        """Of an agent's constructor, whose last parameter stands for the hyperparameters."""

    def __get__(self, instance: object, owner: type) -> inspect.Signature:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        hyperparameters = [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default)
            for key, default in validation.field_defaults(config).items()
        ]
        return inspect.Signature([*list(self.common.parameters.values())[1:-1], *hyperparameters])


def fill_windows(agent: BaseAgent) -> None:
    """Fills the buffers of recent episodes from the history."""
    episodes = agent.history.last(agent.stats_window_size)
    agent.ep_info_buffer.extend({"r": e.episode_return, "l": e.length, "t": e.seconds} for e in episodes)
    successes = agent.history["success"]
    agent.ep_success_buffer.extend(successes[~np.isnan(successes)][-agent.stats_window_size :].tolist())
