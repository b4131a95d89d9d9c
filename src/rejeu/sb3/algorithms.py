"""The algorithms with Stable-Baselines3's arguments, attributes and methods.

They are the agents of :mod:`rejeu` and learn alike. Functions given as schedules take the remaining progress, from 1 to 0.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np

from rejeu import agents
from rejeu.agents.agent import Agent
from rejeu.agents.off_policy import OffPolicyAgent
from rejeu.agents.zip_files import load_zip, restore_windows
from rejeu.agents.zoo import statistics_beside
from rejeu.algorithms import config as configs
from rejeu.algorithms.actor_critic.network import ActorCritic
from rejeu.algorithms.actor_critic.steps import samples
from rejeu.algorithms.catalog import CATALOG
from rejeu.callbacks.base import Callback, TrainingCallback
from rejeu.checkpoints import model_files
from rejeu.checkpoints.agent_state import AGENT_ARGUMENTS
from rejeu.core import checkpoint, schedules, validation
from rejeu.core.algorithm import Rollout
from rejeu.core.errors import CheckpointError
from rejeu.core.types import Action, AnyArray, Observation, PyTree, Settings
from rejeu.envs.masks import split
from rejeu.envs.registry import register
from rejeu.envs.wrappers import TimeLimitTerminates
from rejeu.exploration.noise import ActionNoise
from rejeu.logs import logging
from rejeu.sb3 import arguments, policy as policies
from rejeu.sb3.common import base_callback, buffers, logger as loggers, utils
from rejeu.sb3.common.env_util import is_wrapped, make_vec_env
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.preprocessing import is_image_space, is_image_space_channels_first, maybe_transpose
from rejeu.sb3.common.torch_layers import register_again
from rejeu.sb3.common.vec_env.vec_normalize import VecNormalize
from rejeu.sb3.common.vec_env.vec_transpose import VecTransposeImage
from rejeu.sb3.policy import BasePolicy
from rejeu.training import finite

__all__ = [name for name, entry in CATALOG.items() if entry.original]

RUN = {"_last_obs": "obs", "_last_episode_starts": "ended", "_n_updates": "n_updates", "_episode_num": "episode"}
"""Attributes of a run by the names that scripts read of an agent."""
FIXED = {
    **dict.fromkeys(RUN, "learn(..., reset_num_timesteps=...)"),
    "_logger": "set_logger(...)",
    "_vec_normalize_env": "set_env(...)",
    **dict.fromkeys(("log_ent_coef", "ent_coef_tensor"), "ent_coef"),
    "env": "set_env(...)",
}
"""Attributes that are computed, and the way to change each."""
PARTS = {
    "optimizer": "policy.optimizer",
    "actor_optimizer": "actor.optimizer",
    **dict.fromkeys(("critic_optimizer", "critics_optimizer"), "critic.optimizer"),
    **dict.fromkeys(("alpha_optimizer", "log_alpha"), "ent_coef_optimizer"),
}
"""Where :meth:`Original.get_parameters` has the fields of the algorithms' states that are no networks."""
SHAPING = {
    "action_masks",
    "dueling",
    "ent_coef",
    "n_critics",
    "n_quantiles",
    "normalize",
    "optimizer",
    "policy_kwargs",
    "rnd",
    "use_rms_prop",
    "use_sde",
}
"""Hyperparameters that the arrays of a file depend on."""


OUTPUTS = {"verbose": int, "tensorboard_log": str}
"""Attributes that say where statistics go, which every file has, with their types."""


class InvalidSetting(ValueError, AssertionError):
    """A setting or a space that an algorithm does not take: scripts catch either error."""


class Mismatch(CheckpointError, RuntimeError):
    """Parameters that do not fit an agent: scripts catch ``ValueError`` or ``RuntimeError``."""


class Original(Agent):
    """An agent with Stable-Baselines3's arguments, attributes and methods. Abstract.

    Hyperparameters are attributes (``model.gamma``) that can be set, which compiles the agent again.
    """

    exploration_rate_set: float | None = None
    """The value that was assigned to ``exploration_rate``."""
    has_own_logger: bool = False
    """Whether :meth:`set_logger` was called."""
    policy_object: BasePolicy | None = None
    """The object that ``policy`` returns."""
    STORED: ClassVar[tuple[str, ...]] = ("replay_buffer", "policy", "exploration_rate", "num_timesteps", "lr_schedule")
    """Properties that can be set."""

    def __init__(self, policy: Any, env: Any, *args: Any, **settings: Any) -> None:
        """Takes the arguments of Stable-Baselines3's class of this name, and those of rejeu's.

        Args:
            policy: name or class of the policy.
            env: id, environment or vector environment.
            args: the first hyperparameters by position.
            settings: hyperparameters.
        """
        settings |= zip(arguments.POSITIONAL.get(self.name, arguments.OFF_POLICY), args, strict=False)
        instance = None
        if isinstance(policy, type):
            env, policy, instance = self._prepared(policy, env, settings)
        replay = settings.get("replay_buffer_kwargs") or {}
        if replay.get("handle_timeout_termination", True) is False and isinstance(env, str | gym.Env):
            env = TimeLimitTerminates(gym.make(env) if isinstance(env, str) else env)
            settings["replay_buffer_kwargs"] = {**replay, "handle_timeout_termination": True}
        name = policy.replace("LstmPolicy", "Policy") if isinstance(policy, str) else policy
        if self.name == "ARS":  # whose policy is linear without hidden layers
            widths, name = ([], "MlpPolicy") if name == "LinearPolicy" else ([64, 64], name)
            settings["policy_kwargs"] = {"net_arch": widths, **(settings.get("policy_kwargs") or {})}
        try:
            super().__init__(name, env, **settings)
        except ValueError as error:
            raise (InvalidSetting(*error.args) if type(error) is ValueError else error) from None
        self.device = utils.Device(self.device)
        if instance is not None:
            instance.model, instance.observation_space = self, self.observation_space
            instance.action_space = self.action_space
            self.policy_object = instance
        if settings.get("seed") is not None:
            utils.set_random_seed(self.seed)

    @staticmethod
    def _prepared(policy_class: type[Any], env: Any, settings: Settings) -> tuple[Any, str, BasePolicy | None]:
        """Returns the environment, the name of the policy and the policy, for a class of policies."""
        if not issubclass(policy_class, BasePolicy):
            raise TypeError(f"policy={policy_class.__name__} must be a name, or a class derived from BasePolicy")
        mine = [base for base in policy_class.__mro__ if base.__module__ != policies.__name__]
        for name in ("forward", "_predict", "evaluate_actions", "predict_values", "get_distribution"):
            if any(name in vars(base) for base in mine):
                arguments.unsupported(
                    f"{policy_class.__name__}.{name}", "your own", "is called neither in training nor by model.predict"
                )
        instance = None
        env = make_vec_env(env) if isinstance(env, str) else env
        space = getattr(env, "single_observation_space", env.observation_space)
        if policy_class.__init__ is not BasePolicy.__init__:
            action_space = getattr(env, "single_action_space", env.action_space)
            rate = utils.FloatSchedule(settings.get("learning_rate", 3e-4))
            instance = policy_class(space, action_space, rate, **(settings.get("policy_kwargs") or {}))
            settings["policy_kwargs"] = instance.settings
        elif policy_class.__module__ != policies.__name__:
            instance = policy_class(space, env.action_space)
        by_space = "MultiInputPolicy" if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) else "MlpPolicy"
        return env, policy_class.policy_name or by_space, instance

    @classmethod
    def converted(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Converts keyword arguments of Stable-Baselines3's classes."""
        return arguments.converted(cls, settings)

    @property
    def policy(self) -> BasePolicy:
        """The policy, with the networks as its parts."""
        if self.policy_object is None:
            self.policy_object = getattr(policies, CATALOG[self.name].policy or "ActorCriticPolicy").of(self)
        return self.policy_object

    @policy.setter
    def policy(self, value: Any) -> None:
        self.policy_object = value

    def __getattr__(self, name: str) -> Any:
        """Returns a hyperparameter, or a network of the policy."""
        config = self.__dict__.get("config")
        if config is None:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        if name in ("clip_range", "clip_range_vf") and hasattr(config, name):
            value = getattr(config, name)
            return None if value is None else utils.FloatSchedule(utils.of_remaining(value))
        if name in validation.field_names(type(config)):
            value = getattr(config, name)
            if isinstance(value, schedules.Live):
                return value.value
            is_schedule = configs.takes_schedule(type(config), name) and callable(value)
            return utils.of_remaining(value) if is_schedule else value
        if name in policies.NETWORKS:
            return getattr(self.policy, name)
        if name in RUN:
            return getattr(self.run, RUN[name])
        if name == "_total_timesteps":
            call = self.call.training_call
            return 0 if call is None or call.n_steps is None else call.steps_before + call.n_steps
        if name in ("_logger", "_vec_normalize_env"):
            return self.logger if name == "_logger" else self.get_vec_normalize_env()
        if name in ("log_ent_coef", "ent_coef_tensor") and hasattr(self.learner.shapes, "log_alpha"):
            log_alpha = utils.Tensor.of(np.array(self.state.log_alpha))
            if name == "log_ent_coef":
                return log_alpha if config.learns_temperature else None
            return np.exp(log_alpha)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __setattr__(self, name: str, value: Any) -> None:
        """Sets an attribute; a hyperparameter from the next update on, see :meth:`rejeu.agents.agent.Agent.change`.

        Attributes of your own can be set too. A name that is nearly that of a hyperparameter warns.

        Raises:
            AttributeError: for what is computed from something else, such as a network.
            ValueError: for a hyperparameter that networks or buffer depend on.
        """
        config: Any = self.__dict__.get("config")
        settings = () if config is None or name in self.STORED else validation.field_names(type(config))
        if name in settings:
            new = dataclasses.replace(config, **self.converted({name: value}))
            old, number = getattr(config, name), getattr(new, name)
            if isinstance(old, schedules.Live) and isinstance(number, int | float):
                finite.settle(self)
                old.value = number
            elif "run" in self.__dict__ and new != config:
                if (
                    self.call.is_learning
                    and configs.takes_schedule(type(config), name)
                    and isinstance(number, int | float)
                ):
                    with suppress(TypeError, ValueError):  # what is set once may be set at every step
                        new = dataclasses.replace(config, **{name: schedules.Live(number)})
                self.change(new)
            return
        if settings and name in (fixed := {**FIXED, **dict.fromkeys(policies.NETWORKS, "set_parameters(...)")}):
            raise AttributeError(f"{name} of {self.name} cannot be set; use {fixed[name]}")
        if settings and not hasattr(self, name) and (near := difflib.get_close_matches(name, settings, 1, 0.85)):
            warnings.warn(
                f"{name} is an attribute of your own now; is the hyperparameter {near[0]} meant?", UserWarning, 2
            )
        object.__setattr__(self, name, value)

    @property
    def lr_schedule(self) -> utils.FloatSchedule:
        """The learning rate as a function of the remaining progress."""
        return utils.FloatSchedule(utils.of_remaining(self.config.learning_rate))

    @lr_schedule.setter
    def lr_schedule(self, value: Any) -> None:
        self.learning_rate = value

    def _setup_lr_schedule(self) -> None:
        """Does nothing: what ``learning_rate`` is set to counts at once."""

    @property
    def exploration_rate(self) -> float:
        """Epsilon of DQN and QR-DQN now; 0 before the first step."""
        if self.exploration_rate_set is not None:
            return self.exploration_rate_set
        if not hasattr(self.config, "exploration_final_eps"):
            raise AttributeError(f"{self.name} has no exploration_rate")
        if self.run.step == 0:
            return 0.0
        config = self.config
        first, last = config.exploration_initial_eps, config.exploration_final_eps
        return float(schedules.Linear(first, last, config.exploration_fraction)(1.0 - self._current_progress_remaining))

    @exploration_rate.setter
    def exploration_rate(self, value: float) -> None:
        if self.call.is_learning:
            arguments.unsupported(
                "exploration_rate", value, "follows exploration_initial_eps and ..._final_eps in learn; set these"
            )
        self.exploration_rate_set = float(value)

    @property
    def replay_buffer(self) -> Any:
        """The replay buffer with Stable-Baselines3's attributes; ``run.replay`` is the one that batches are drawn from."""
        if not isinstance(self, OffPolicyAgent) or "replay_buffer_deleted" in self.__dict__:
            raise AttributeError(f"{self.name} has no replay buffer")
        is_her, buffer_class = self.config.hindsight is not None, buffers.ReplayBuffer
        if isinstance(self.observation_space, gym.spaces.Dict):
            buffer_class = buffers.HerReplayBuffer if is_her else buffers.DictReplayBuffer
        return (buffers.NStepReplayBuffer if self.config.n_steps > 1 and not is_her else buffer_class).of(self)

    @replay_buffer.setter
    def replay_buffer(self, value: Any) -> None:
        if not isinstance(value, buffers.ReplayBuffer):
            raise TypeError(f"replay_buffer={value!r:.60} must be the replay buffer of an agent, or a copy of it")
        self.__dict__.pop("replay_buffer_deleted", None)
        if value.core is self.run.replay:
            return
        steps = [getattr(value, name) for name in value.SHOWN]
        self.run.replay = self.make_buffer(self.run.env)
        buffer = self.replay_buffer
        for i in range(value.pos):
            obs, following, action, reward, done, timeout = (
                buffers.by_leaf(lambda leaf, i=i: leaf[i], leaves) for leaves in steps
            )
            buffer.add(obs, following, action, reward, done, [{"TimeLimit.truncated": bool(cut)} for cut in timeout])

    @replay_buffer.deleter
    def replay_buffer(self) -> None:
        self.__dict__["replay_buffer_deleted"] = True

    @property
    def rollout_buffer(self) -> buffers.RolloutBuffer:
        """A copy of the steps since the last update, or right after it of those that it learned from; actions in [-1, 1].

        ``values``, ``log_probs``, ``advantages`` and ``returns`` are by the network as it is now: the one that acted, and
        right after an update the new one. Agents with memory, ``normalize`` or ``rnd``, and ARS, do not have them.

        Raises:
            AttributeError: for an agent with a replay buffer.
        """
        core = self.run.replay
        if isinstance(self, OffPolicyAgent):
            raise AttributeError(f"{self.name} has no rollout buffer")
        shape = (core.n_steps, core.n_envs)
        is_dict = isinstance(self.observation_space, gym.spaces.Dict)
        shown = (buffers.DictRolloutBuffer if is_dict else buffers.RolloutBuffer).of(self)
        (shown.buffer_size, shown.n_envs), shown.gamma = shape, self.config.gamma
        shown.gae_lambda = getattr(self.config, "gae_lambda", 1.0)
        shown.pos = core.length or int(core.valid.any(axis=1).sum())
        shown.full = shown.pos == core.n_steps
        obs, next_obs = (jax.tree.unflatten(core.obs_structure, leaves) for leaves in (core.obs, core.next_obs))
        valid = core.valid & (np.arange(core.n_steps) < shown.pos)[:, None]
        rollout = Rollout(obs, core.action, core.reward, next_obs, core.discount, core.ended, valid, (), (), ())
        rollout = jax.tree.map(np.copy, rollout)
        shown.observations, shown.rewards = buffers.by_leaf(buffers.fixed, rollout.obs), buffers.fixed(rollout.reward)
        shown.actions = buffers.fixed(rollout.action.reshape(*shape, -1))
        first = core.started if core.length else core.previously_started
        shown.episode_starts = buffers.fixed(np.concatenate([first[None], rollout.ended[:-1]]).astype(np.float32))
        network = getattr(self.state, "network", None)
        if not isinstance(network, ActorCritic):
            return shown
        data = samples(network, jax.tree.map(jnp.asarray, rollout), self.config.gae_lambda)
        shown.log_probs, shown.values, shown.advantages, shown.returns = (
            buffers.fixed(np.where(valid, np.reshape(x, shape), 0.0)) for x in data[2:6]
        )
        return shown

    def make_envs(self, env: Any, *args: Any, **kwargs: Any) -> Any:
        """Returns vector environments; Gymnasium environments are in a ``Monitor``, ids with ``render_mode="rgb_array"``.

        Of those that :meth:`get_env` returned, the images are as they were given before.
        """
        mine = self.__dict__.get("observation_space")
        if isinstance(env, str) and args in ((), (1,)) and {*kwargs} <= {"seed"} and register(env):
            env = make_vec_env(env)  # as the original: Gymnasium's, which can be rendered to images
        if isinstance(env, gym.Env) and not is_wrapped(env, Monitor):
            env = Monitor(env)
        if isinstance(env, VecTransposeImage) and mine is not None and env.venv.observation_space == mine:
            env = env.venv
        return super().make_envs(env, *args, **kwargs)

    @property
    def env(self) -> Any:
        """The training environments, as :meth:`get_env` returns them; ``run.env`` is rejeu's vector environment."""
        return self.get_env()

    def get_env(self) -> Any:
        """Returns the training environments; images with the channels last are shown with the channels first."""
        env = super().get_env()
        return env if env is None or not has_channels_last(env.observation_space) else VecTransposeImage(env)

    def start_run(self, env: Any, state: PyTree = None) -> None:
        """Starts a run; without a GPU on the CPU, whatever ``device`` is."""
        if self.device == "gpu" and jax.default_backend() != "gpu":
            self.device = "cpu"
        super().start_run(env, state)

    def make_buffer(self, env: Any) -> Any:
        """Returns a new buffer; one for ``VecNormalize`` stores what was not normalized, and scales what is drawn."""
        scales = self._asks_for_originals(env)
        buffer: Any = super().make_buffer(env)  # type: ignore[safe-super]
        return scaled(buffer, self) if scales else buffer

    def keep_buffer(self, env: Any) -> None:
        """Keeps the buffer for other environments."""
        self._asks_for_originals(env)
        super().keep_buffer(env)  # type: ignore[safe-super]

    def _asks_for_originals(self, env: Any) -> bool:
        """Returns whether ``VecNormalize`` is the outermost wrapper of an off-policy agent, and asks for original values."""
        asks = isinstance(self, OffPolicyAgent) and isinstance(getattr(env, "venv", None), VecNormalize)
        if asks:
            env.gives_originals = True
        return asks

    def make_noise(self) -> Any:
        """Returns the noise of the actions; noise of one component is that of every action dimension."""
        noise, n = getattr(self.config, "action_noise", None), np.prod(self.action_space.shape or (1,), dtype=int)
        if isinstance(noise, ActionNoise) and len(noise.mean) == 1 < n:
            each: Any = {"mean": noise.mean * int(n), "sigma": noise.sigma * int(n)}
            self.config = dataclasses.replace(self.config, action_noise=dataclasses.replace(noise, **each))  # type: ignore[type-var]
        return super().make_noise()  # type: ignore[safe-super]

    @property
    def num_timesteps(self) -> int:
        """Environment steps so far, over all environments."""
        return super().num_timesteps

    @num_timesteps.setter
    def num_timesteps(self, value: int) -> None:
        self.run.step = self.call.reset_step + int(value)

    @property
    def _current_progress_remaining(self) -> float:
        call = self.call.training_call
        return 1.0 if call is None else 1.0 - float(call.progress(self.run.step, self.run.episode))

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seeds Python, NumPy, the batches and the next reset of the environments; None does nothing."""
        if seed is not None:
            utils.set_random_seed(seed)
            self.run.rng, self.run.seed = np.random.default_rng(seed), seed
            self.run.key = jax.random.key_data(jax.random.key(seed))

    def predict(
        self,
        observation: Observation,
        state: PyTree = None,
        episode_start: AnyArray = None,
        deterministic: bool = False,
        action_masks: AnyArray = None,
    ) -> tuple[np.ndarray, PyTree]:
        """Returns actions in the environment's range, and the next state of a recurrent policy; see :meth:`Agent.predict`.

        DQN and QR-DQN act at random with the probability ``exploration_rate`` unless ``deterministic``. Images may have their
        channels first or last.

        Raises:
            ValueError: if the observation has the wrong structure or shape, such as what ``env.reset()`` of Gymnasium returns.
        """
        if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
            raise ValueError(
                "predict got a tuple (obs, info): you are mixing Gym API with SB3 VecEnv API; give it obs only, of "
                "obs, info = env.reset()"
            )
        if isinstance(self.observation_space, gym.spaces.Box):
            observation = maybe_transpose(np.asarray(observation), self.observation_space)
        explores = hasattr(self.config, "exploration_final_eps") and not deterministic
        action, memory = super().predict(observation, state, episode_start, deterministic or explores, action_masks)
        if explores and self.run.rng.random() < self.exploration_rate:
            masks = split(observation, action_masks)[1]
            each = (
                [None] * np.size(action) if masks is None else np.asarray(masks, np.int8).reshape(np.size(action), -1)
            )
            self.action_space.seed(int(self.run.rng.integers(2**31)))
            sampled = [self.action_space.sample(mask) for mask in each]
            action = np.asarray(sampled, action.dtype).reshape(np.shape(action))
        return action if isinstance(action, dict | tuple) else np.asarray(action), memory

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: Any = None,
        log_interval: int | None = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        use_masking: bool = True,
        **limits: Any,
    ) -> Self:
        """Trains, and returns the agent; see :meth:`Agent.learn`.

        Functions as ``callback`` are called with ``(locals, globals)``; a false value stops training.

        Raises:
            ValueError: with ``use_masking=False``: use PPO.
        """
        if not use_masking:
            raise ValueError("use_masking=False: MaskablePPO needs masks; use PPO for environments without")
        callback_list = [] if callback is None else [*callback] if isinstance(callback, list | tuple) else [callback]
        interval = 2**62 if log_interval is None else log_interval
        if not self.has_own_logger:
            folder = tb_log_name or self.name
            only = {*self.log} <= {"tensorboard"}
            arguments = (self.verbose, self.tensorboard_log, folder, reset_num_timesteps)
            logger: Any = utils.configure_logger(*arguments) if only else logging.Logger()
            self.logger = logger
            if only and not logger.output_formats:  # statistics that nothing shows need not be computed
                logger.outputs = []
        if isinstance(self.logger, loggers.Logger):  # where scripts look for what the last update said
            self.logger.latest = self.statistics
        self.exploration_rate_set = None
        if reset_num_timesteps:
            self.ep_info_buffer.clear()
            self.ep_success_buffer.clear()
        callbacks = [as_callback(original) for original in callback_list]
        flags = (reset_num_timesteps, progress_bar)
        return super().learn(total_timesteps, callbacks, interval, tb_log_name, *flags, **limits)

    def get_parameters(self) -> dict[str, dict[str, utils.Tensor]]:  # type: ignore[override]
        """Returns a copy of the algorithm's state: for the networks and for each optimizer the arrays by name.

        The networks are ``"policy"``; the optimizers ``"policy.optimizer"``, or ``"actor.optimizer"``, ``"critic.optimizer"``
        and ``"ent_coef_optimizer"``, which has the temperature too. Counters and all else are with the first optimizer.
        """
        parts: dict[str, dict[str, utils.Tensor]] = {"policy": {}}
        arrays = super().get_parameters()
        first = PARTS["actor_optimizer" if any("actor_optimizer" in name for name in arrays) else "optimizer"]
        for name, array in arrays.items():
            fields = name.split(".")
            group_names = [PARTS[field] for field in fields if field in PARTS]
            group = group_names[0] if group_names else "policy" if policies.ALL_NETWORKS & {*fields} else first
            parts.setdefault(group, {})[name] = utils.Tensor.of(array)
        return parts

    def set_parameters(self, load_path_or_dict: Any, exact_match: bool = True, device: Any = "auto") -> None:
        """Sets parameters from :meth:`get_parameters`, of this class or of rejeu's agents, or from a model file.

        Args:
            load_path_or_dict: arrays by part and name, arrays by name, or a path.
            exact_match: require all parameters; False sets those that are given and keeps the others.
            device: accepted.

        Raises:
            ValueError: if a part, name, shape or dtype does not match; the agent is then unchanged.
            RuntimeError: the same error.
        """
        parameters = load_path_or_dict
        if isinstance(parameters, Mapping) and any(isinstance(group, Mapping) for group in parameters.values()):
            unknown = [*parameters.keys() - (current := self.get_parameters()).keys()]
            if unknown:
                raise Mismatch(f"set_parameters got {unknown[0]!r}, and {self.name} has {', '.join(current)}")
            parameters = {name: array for group in parameters.values() for name, array in group.items()}
        try:
            super().set_parameters(parameters, exact_match)
        except CheckpointError as error:
            raise Mismatch(*error.args) from None

    def set_logger(self, logger: Any) -> None:
        """Replaces the logger for all further training."""
        self.logger, self.has_own_logger = logger, True

    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> Any:
        """Writes the model to exactly this path, or to a file object; ``.zip`` is added to a path without a suffix.

        The file is rejeu's, whatever its suffix: arrays and JSON.

        Args:
            path: of the file, or a file object.
            exclude: hyperparameters of which the file gets the default. Those that the networks depend on are kept, and names
                that are in no file, such as ``verbose``, are ignored.
            include: further attributes, such as ``verbose`` or some of your own, with values that JSON has; in spite of
                ``exclude``.

        Raises:
            TypeError: if JSON has no such value; ``save_replay_buffer`` writes the replay buffer.
        """
        included = {*(include or ())}
        return written(lambda file: self.snapshot(file, {*(exclude or ())} - included, included)(), path, ".zip")

    def snapshot(self, path: Any, exclude: Iterable[str] = (), include: Iterable[str] = ()) -> Callable[[], Path]:
        """Returns a function that writes the model as it is now, as :meth:`save` does."""
        arrays, header = super().get_parameters(), model_files.header(self)
        defaults = configs.to_json(type(self.config)())
        header["config"] |= {key: defaults[key] for key in {*exclude} & defaults.keys() - SHAPING}
        others = {*OUTPUTS, *include} - {*exclude} - defaults.keys()
        folder = {"tensorboard_log": self.tensorboard_log and str(self.tensorboard_log)}
        header["attributes"] = {key: folder.get(key, getattr(self, key)) for key in sorted(others)}
        windows = {"ep_info_buffer", "ep_success_buffer"} - {*exclude}
        header["attributes"] |= {key: [*getattr(self, key)] for key in sorted(windows)}

        def write() -> Path:
            self.last_saved = checkpoint.write(path, "agent", arrays, header)
            return self.last_saved

        return write

    def save_replay_buffer(self, path: Any) -> Any:
        """Writes the replay buffer to exactly this path, or to a file object; ``.pkl`` is added to a path without a suffix."""
        return written(super().save_replay_buffer, path, ".pkl")  # type: ignore[misc]

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """Replaces the replay buffer by a saved one; see :meth:`rejeu.OffPolicyAgent.load_replay_buffer`."""
        self.__dict__.pop("replay_buffer_deleted", None)
        with readable(path, ".pkl") as exact_path:
            if self.run.replay is None and self.config.hindsight is None:  # loaded without environments
                with checkpoint.opened(exact_path, "replay") as file:
                    n_envs = file.specs["head"].shape[0]
                settings = {"observation_space": self.observation_space, "action_space": self.action_space}
                like: Any = SimpleNamespace(n_envs=n_envs, **settings)
                self.run.replay = self.make_buffer(like)
            super().load_replay_buffer(exact_path)  # type: ignore[misc]

    @classmethod
    def load(
        cls,
        path: Any,
        env: Any = None,
        device: Any = "auto",
        custom_objects: Mapping[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Returns the agent of a model file, or of a zip file that Stable-Baselines3 itself saved; no code from it is run.

        Args:
            path: as given to :meth:`save`, or a file object.
            env: environments to continue training in.
            device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
            custom_objects: hyperparameters that replace the saved ones; other names are ignored.
            print_system_info: print the versions of packages.
            force_reset: accepted; new episodes start with the next ``learn``.
            kwargs: hyperparameters and arguments that replace the saved ones.
        """
        if print_system_info:
            utils.get_system_info()
        setting_names = {*validation.field_names(cls.algorithm.Config), *AGENT_ARGUMENTS}
        objects = {key: value for key, value in (custom_objects or {}).items() if key in setting_names}
        has_gpu = utils.Device(str(device)).type == "cuda" and utils.get_device(device).type == "cuda"
        device_name = str(device) if has_gpu or str(device) in ("auto", "cpu") else "auto"
        changes = {**objects, "device": device_name, **kwargs}
        with readable(path, ".zip") as file:
            agent: Any
            if zipfile.is_zipfile(file):
                statistics = statistics_beside(file) if isinstance(path, str | Path) else None
                if statistics is not None and not isinstance(env, VecNormalize):
                    warnings.warn(
                        f"{statistics} lies beside the model, whose observations were normalized by it; use "
                        f"env = VecNormalize.load({str(statistics)!r}, env), and give the model its observations",
                        stacklevel=2,
                    )
                agent = load_zip(file, env, False, cls, **cls.converted(changes))
            else:
                header = checkpoint.read_header(file, "agent")
                shape = header.get("config", {}).get("policy_kwargs")
                register_again(shape.get("encoder") if isinstance(shape, dict) else None)
                agent = super().load(file, env, **changes)
                attributes = header["attributes"] if isinstance(header.get("attributes"), dict) else {}
                restore_windows(agent, attributes.get)
                for name in attributes.keys() - {*OUTPUTS}:
                    if not hasattr(agent, name):
                        setattr(agent, name, attributes[name])
                outputs = {
                    key: attributes[key]
                    for key in attributes.keys() & OUTPUTS.keys()
                    if type(attributes[key]) is OUTPUTS[key]
                }
                agent.set_outputs(**outputs | {key: changes[key] for key in OUTPUTS if key in changes})
        if changes.get("seed") is not None:
            utils.set_random_seed(agent.seed)
        agent.device = utils.Device(agent.device)
        return agent


def scaled(buffer: Any, agent: Original) -> Any:
    """Returns a replay buffer that now stores original observations and rewards, and draws them normalized."""
    buffer_class = type(buffer)

    def begin(obs: Observation, which: Any = None) -> None:
        buffer_class.begin(buffer, agent.run.env.original_obs(final=False), which)

    def add(action: Action, reward: Any, terminated: Any, obs: Observation) -> None:
        env: Any = agent.run.env
        original = env.vec_normalize.get_original_reward()
        buffer_class.add(buffer, action, original, terminated, env.original_obs(final=True))

    def draw(*args: Any) -> Any:
        batch, drawn = buffer_class.draw(buffer, *args)
        scale: Any = agent.run.env.vec_normalize
        obs, following = scale.normalize_obs(batch.obs), scale.normalize_obs(batch.next_obs)
        return batch._replace(obs=obs, next_obs=following, reward=scale.normalize_reward(batch.reward)), drawn

    buffer.begin, buffer.add, buffer.draw = begin, add, draw
    return buffer


def written(write: Callable[[Path], Path], path: Any, suffix: str) -> Any:
    """Writes to a path, to which ``suffix`` is added if it has none, or to a file object; returns the path."""
    if path is not None and not isinstance(path, str | Path):
        with tempfile.TemporaryDirectory() as folder:
            path.write(write(Path(folder) / f"file{suffix}").read_bytes())
        return None
    return write(checkpoint.resolve(validation.as_path(path), suffix))


@contextmanager
def readable(path: Any, suffix: str) -> Iterator[Path]:
    """Yields a path that can be opened: the given one, or with ``suffix``; the content of a file object as a file."""
    if path is None or isinstance(path, str | Path):
        exact_path = validation.as_path(path)
        with_suffix = checkpoint.resolve(exact_path, suffix)
        is_there = exact_path.exists() or (not with_suffix.is_file() and checkpoint.resolve(exact_path).is_file())
        yield exact_path if is_there else with_suffix
        return
    path.seek(0)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / f"file{suffix}"
        copy.write_bytes(path.read())
        yield copy


def as_callback(callback: Any) -> Callback:
    """Returns a function of ``(locals, globals)`` as a callback; one of ``(agent, progress)`` unchanged."""
    if isinstance(callback, TrainingCallback) or not inspect.isroutine(callback):
        return callback
    is_own = [*inspect.signature(callback).parameters][:1] == ["agent"]
    return callback if is_own else base_callback.ConvertCallback(callback)


def has_channels_last(space: gym.Space) -> bool:
    """Returns whether observations are, or contain, images with the channels last."""
    parts: Any = space.spaces.values() if isinstance(space, gym.spaces.Dict) else [space]
    return any(is_image_space(leaf) and not is_image_space_channels_first(leaf) for leaf in parts)


class A2C(Original, agents.A2C):
    """:class:`rejeu.A2C` with Stable-Baselines3's arguments, attributes and methods."""


class DDPG(Original, agents.DDPG):
    """:class:`rejeu.DDPG` with Stable-Baselines3's arguments, attributes and methods."""


class DQN(Original, agents.DQN):
    """:class:`rejeu.DQN` with Stable-Baselines3's arguments, attributes and methods."""


class PPO(Original, agents.PPO):
    """:class:`rejeu.PPO` with Stable-Baselines3's arguments, attributes and methods."""


class SAC(Original, agents.SAC):
    """:class:`rejeu.SAC` with Stable-Baselines3's arguments, attributes and methods."""


class TD3(Original, agents.TD3):
    """:class:`rejeu.TD3` with Stable-Baselines3's arguments, attributes and methods."""


class QRDQN(Original, agents.QRDQN):
    """:class:`rejeu.QRDQN` with Stable-Baselines3's arguments, attributes and methods."""


class TQC(Original, agents.TQC):
    """:class:`rejeu.TQC` with Stable-Baselines3's arguments, attributes and methods."""


class CrossQ(Original, agents.CrossQ):
    """:class:`rejeu.CrossQ` with Stable-Baselines3's arguments, attributes and methods."""


class TRPO(Original, agents.TRPO):
    """:class:`rejeu.TRPO` with Stable-Baselines3's arguments, attributes and methods."""


class ARS(Original, agents.ARS):
    """:class:`rejeu.ARS` with Stable-Baselines3's arguments, attributes and methods."""


class RecurrentPPO(Original, agents.RecurrentPPO):
    """:class:`rejeu.RecurrentPPO` with Stable-Baselines3's arguments, attributes and methods."""


class MaskablePPO(Original, agents.MaskablePPO):
    """:class:`rejeu.MaskablePPO` with Stable-Baselines3's arguments, attributes and methods."""


def load_any(path: Any, device: Any) -> Any:
    """Returns the agent of a model file, whatever its algorithm."""
    with readable(path, ".zip") as file:
        name = checkpoint.read_header(file, "agent").get("algorithm")
    return globals()[str(name)].load(path, device=device)


policies.BaseModel.load_agent = staticmethod(load_any)
