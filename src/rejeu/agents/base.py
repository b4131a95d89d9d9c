"""The state of an agent: its configuration, learner, environments and run, and the methods that subclasses override.

The functions of this package work on a :class:`BaseAgent`. :class:`rejeu.agents.agent.Agent` adds what users call.
"""

from __future__ import annotations

import inspect
import math
import secrets
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu import devices, spaces, validation, xla
from rejeu.algorithms import config as configs, contract
from rejeu.callbacks.base import RunFolder, Stateful
from rejeu.core import Algorithm
from rejeu.envs.make import Backend, VectorEnv
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise, check_fits
from rejeu.io.failed_writes import FailedWrites
from rejeu.loops import finite
from rejeu.loops.device.driver import Stops
from rejeu.loops.learner import Learner
from rejeu.loops.packing import PackedState
from rejeu.loops.run import Progress, Run, initial_run
from rejeu.loops.training_call import TrainingCall
from rejeu.normalization import normalized
from rejeu.reporting.history import History
from rejeu.reporting.logging import Logger, check_logs
from rejeu.reporting.text import counted, html_table

BEST_WINDOW = 20
"""Default number of training episodes over whose mean return the best weights are chosen."""
POLICIES = ("MlpPolicy", "MultiInputPolicy", "CnnPolicy")
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
    """What differs; empty if it is exact."""
    skipped: tuple[str, ...] = ()
    """Errors of the newer checkpoints that could not be read, newest first."""

    def __str__(self) -> str:
        return f"resumed at step {self.step:,}, {'exactly as it was saved' if self.exact else self.reason}"


class BaseAgent(ABC):
    """What all agents have. Abstract: subclass :class:`rejeu.OffPolicyAgent` or :class:`rejeu.OnPolicyAgent`."""

    takes_masks: ClassVar[bool] = False
    """Whether its policy takes masks of the allowed actions."""
    algorithm: ClassVar[Any]
    """What has ``Config`` and ``make``: a module, or a ``types.SimpleNamespace(Config=Config, make=make)``."""
    is_learning: bool = False
    """Whether ``learn`` is running."""
    report_folder: Path | None = None
    """Where a batch that led to a non-finite number is saved; None: see :func:`rejeu.loops.finite.folder_of`."""
    last_saved: Path | None = None
    """The newest file that :meth:`save` wrote."""
    on_device: bool | None = None
    """Whether ``learn`` trains in one program on the device: True requires it, False uses the loop of the host. None uses the
    device where the environments are JAX environments and the settings allow it; see ``docs/device.md``."""
    stops: Stops | None = None
    """During a ``learn`` on the device: where the program returns to the host. None with the loop of the host."""

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
        known = [*validation.field_names(self.algorithm.Config), *AGENT_ARGUMENTS]
        for key in hyperparameters:
            if key not in known:
                raise TypeError(validation.unknown_name(key, known, self.name))
        self.configure(
            policy,
            self.algorithm.Config(**hyperparameters),
            int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else whole_seed(seed),
            verbose,
            check_logs("log", log),
            tensorboard_log,
            validation.whole("stats_window_size", stats_window_size, least=1),
            None if success_threshold is None else validation.number("success_threshold", success_threshold),
            validation.whole("best_window", best_window, least=1),
            device,
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
        log: tuple[str, ...],
        tensorboard_log: str | Path | None,
        stats_window_size: int,
        success_threshold: float | None,
        best_window: int,
        device: str = "auto",
    ) -> None:
        """Sets the attributes that do not depend on the environment."""
        contract.check_config(config)
        self.policy, self.config, self.seed, self.verbose = policy, config, seed, verbose
        self.log = log if tensorboard_log is None else tuple(dict.fromkeys((*log, "tensorboard")))
        self.tensorboard_log = tensorboard_log
        self.stats_window_size, self.success_threshold = stats_window_size, success_threshold
        self.best_window = best_window
        self.device = devices.named(device)
        """Where it computes: ``"auto"``, ``"cpu"`` or ``"gpu"``."""
        self.history = History()
        self.ep_info_buffer: deque[dict[str, float]] = deque(maxlen=stats_window_size)
        """The last episodes, each ``{"r": return, "l": length, "t": seconds}``."""
        self.ep_success_buffer: deque[float] = deque(maxlen=stats_window_size)
        self.interrupted = False
        """Whether Ctrl-C or SIGTERM ended the last ``learn``."""
        self.interrupted_by: int | None = None
        """The number of that signal."""
        self.logger = Logger()
        """Accepts further numbers for the rows of statistics."""
        self.failed_writes = FailedWrites()
        """What ``learn`` could not write, such as checkpoints and log rows when the disk is full."""
        self.best: Best | None = None
        """The best weights so far, by mean training return or by evaluation."""
        self.steps_per_second = math.nan
        """Environment steps per second in the current or last ``learn``."""
        self.resumed: Resumed | None = None
        """Where :meth:`resume` continued the run; None for a new or loaded agent."""
        self.run_id = secrets.token_hex(8)
        """Identifies the run in its checkpoints."""
        self.training_call: TrainingCall | None = None
        """The current or last call of ``learn``: its limits and progress."""
        self.callbacks: list[Stateful] = []
        """The callbacks of the current or last ``learn`` whose state a checkpoint contains."""
        self.saved_callbacks: list[tuple[str, Any]] | None = None
        """Class names and states of callbacks in a resumed checkpoint, until ``learn`` restores them."""
        self.run_folders: dict[Path, RunFolder] = {}
        """Folders that contain its checkpoints, by path."""
        self.reset_step = 0
        """Total environment steps when the last ``learn`` with ``reset_num_timesteps=True`` started."""
        self.reset_episode = 0
        """Total finished episodes at that time."""
        self.reset_seconds = 0.0
        """Total training time at that time, in seconds."""
        self.n_predictions = 0
        """Calls of ``predict`` that drew from the policy; each draws with a key of its own."""
        self.carry_shapes: Any = None
        """Shapes of a recurrent policy's state for one episode; computed when they are first needed."""
        self.trained_on: tuple[str, Mapping[str, Any]] | None = None
        """Id and keyword arguments of the environments a loaded agent was trained on, if its file contains them."""
        self.made_from_id = False
        """Whether the environments were made from an id."""
        xla.enable_cache()

    def build(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        """Makes the algorithm for these spaces, and its learner."""
        self.observation_space, self.action_space = observation_space, action_space
        self.obs_leaves = spaces.leaves(observation_space)
        self.config = configs.with_widths(self.config, self.obs_leaves)
        noise = self.make_noise()
        if noise is not None:
            check_fits(noise, action_space)
        self.learner = Learner(self.algorithm_of(self.config), noise, self.config.nonfinite == "skip")

    def algorithm_of(self, config: Any) -> Algorithm:
        """Returns the algorithm for the agent's spaces and a configuration, on raw observations and rewards."""
        made = self.algorithm.make(config, self.observation_space, self.action_space)
        algorithm = contract.checked(made, self.action_space)
        if config.normalize is None:
            return algorithm
        explorer = exploration.make(algorithm, self.make_noise())
        return normalized(algorithm, explorer, self.obs_leaves, config.normalize, config.gamma)

    def n_threads(self, n_envs: int) -> int:
        """Returns how many threads JAX should use: all for images and large layers, else one."""
        if any(leaf.kind == "image" for leaf in self.obs_leaves):
            return xla.cores()
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
            self.run: Run = initial_run(env, buffer, self.learner, learn_from, self.seed, state)

    @abstractmethod
    def make_envs(
        self, env: Any, n_envs: int = 1, backend: Backend = "auto", seed: int | None = None, wait_for: int | None = None
    ) -> VectorEnv:
        """Returns vector environments for this agent; the arguments are those of :func:`rejeu.make_vector`."""

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
    def loop(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        """Trains for ``n_steps`` environment steps (None: without end); yields after each step of all environments.

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

    @abstractmethod
    def with_masks(self, obs: Any, masks: Any) -> Any:
        """Returns a batch of observations together with action masks, if the algorithm takes any."""

    def get_vec_normalize_env(self) -> Any:
        """Returns the ``VecNormalize`` around the training environments, or None."""
        env = self.run.env
        return None if env is None else env.vec_normalize

    def check_spaces(self, vector: VectorEnv, what: str) -> None:
        """Raises ``ValueError`` if environments, called ``what`` in the message, have other spaces than the agent."""
        for kind in ("observation", "action"):
            own, other = getattr(self, f"{kind}_space"), getattr(vector, f"{kind}_space")
            if not spaces.same(own, other, bounds=kind == "action"):
                raise ValueError(f"{what} has the {kind} space {other}, and this agent was made for {own}")

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

    def __get__(self, instance: Any, owner: type) -> str:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        docs = validation.field_docs(config)
        lines = [f"    {key}: {text}" for key, text in AGENT_ARGUMENTS.items()]
        for key, default in validation.field_defaults(config).items():
            text = f"{docs[key]} " if key in docs else ""
            lines.append(
                f"    {key}: {text}" + ("" if default is inspect.Parameter.empty else f"Default: {default!r}.")
            )
        about = inspect.cleandoc(config.__doc__ or "")
        return "\n".join([self.text, "", about, "", "Args:", *lines])


class Signature:
    """A class attribute ``__signature__``: what every agent takes, then the hyperparameters."""

    def __init__(self, common: inspect.Signature) -> None:
        self.common = common
        """Of an agent's constructor, whose last parameter stands for the hyperparameters."""

    def __get__(self, instance: Any, owner: type) -> inspect.Signature:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        hyperparameters = [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default)
            for key, default in validation.field_defaults(config).items()
        ]
        return inspect.Signature([*list(self.common.parameters.values())[1:-1], *hyperparameters])


def whole_seed(seed: Any) -> int:
    """Returns a seed as an ``int``.

    Raises:
        ValueError: if it is not an integer in [0, 2^32).
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**32 - 1")
    return int(seed)


def check_policy(policy: str, space: gym.Space) -> None:
    """Raises ``ValueError`` if there is no such policy, or if it does not fit the observations of ``space``."""
    if policy not in POLICIES:
        raise ValueError(f"policy={policy!r} must be one of {', '.join(POLICIES)}")
    is_dict = isinstance(space, gym.spaces.Dict)
    if policy == "MlpPolicy" and is_dict:
        raise ValueError("policy='MlpPolicy' does not fit a Dict observation; use 'MultiInputPolicy'")
    if policy == "MultiInputPolicy" and not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        raise ValueError(f"policy='MultiInputPolicy' needs a Dict or Tuple observation, got {space}; use 'MlpPolicy'")
    if policy == "CnnPolicy" and not any(leaf.kind == "image" for leaf in spaces.leaves(space)):
        raise ValueError(f"policy='CnnPolicy' needs a uint8 image observation, got {space}; use 'MlpPolicy'")
