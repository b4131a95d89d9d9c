"""The base classes of callbacks with Stable-Baselines3's interface, and how training calls them.

A subclass of :class:`BaseCallback` implements ``_on_step``, which returns whether to continue, and any of
``_on_training_start``, ``_on_rollout_start``, ``_on_rollout_end`` and ``_on_training_end``.

A rollout is the experience between two updates: ``n_steps`` calls with PPO and A2C, ``train_freq`` calls with the others.
Unlike in Stable-Baselines3, the update after a rollout has already started when ``_on_step`` and ``_on_rollout_end`` of its
last step are called. Import the classes from :mod:`rejeu.sb3.common.callbacks`, as in Stable-Baselines3.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import jax
import numpy as np

from rejeu.agents import Agent
from rejeu.callbacks.base import TrainingCallback
from rejeu.core.types import Info, JsonObject, Variables
from rejeu.envs.base import each_info
from rejeu.logs.logging import Logger
from rejeu.sb3.common.vec_env.base_vec_env import TERMINAL_OBSERVATION, TIME_LIMIT_TRUNCATED, VecEnv
from rejeu.training.run import Progress


class Locals(dict[str, Any]):
    """The variables of the loop by name."""

    def __missing__(self, name: str) -> Any:
        raise KeyError(f"locals has no {name!r}, but {', '.join(self)}; model.rollout_buffer has values and log_probs")


class BaseCallback(TrainingCallback):
    """Base class of the callbacks of ``learn``. Abstract: subclasses implement ``_on_step``.

    Args:
        verbose: 0 prints nothing, 1 prints messages, 2 prints more.

    >>> import rejeu
    >>> class Count(BaseCallback):
    ...     def _on_step(self):
    ...         return self.num_timesteps < 60
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0).learn(100, Count())
    >>> agent.num_timesteps
    60
    """

    model: Agent
    """The agent."""

    every_step: ClassVar[bool] = True

    carried: ClassVar[tuple[str, ...]] = ("n_calls",)
    """Names of the attributes that a checkpoint contains: numbers, strings, lists, dicts and arrays. Subclasses with further
    state extend them."""

    def __init__(self, verbose: int = 0) -> None:
        self.verbose = verbose
        self.n_calls = 0
        """Number of calls of ``on_step`` since construction."""
        self.num_timesteps = 0
        """Number of environment steps, as ``model.num_timesteps``."""
        self.locals: Variables = {}
        """Variables of the loop, such as ``actions``, ``new_obs``, ``rewards``, ``dones``, ``infos``, ``self`` and ``env``."""
        self.globals: Variables = {}
        self.parent: BaseCallback | None = None
        """The callback that calls this one, if there is one."""

    def before_training(self, agent: Agent) -> None:
        """Calls ``init_callback``, ``on_training_start`` and ``on_rollout_start``."""
        call = agent.call.training_call
        assert call is not None
        self.init_callback(agent)
        attributes = Locals(
            self=agent,
            env=agent.get_env(),
            callback=self,
            total_timesteps=None if call.n_steps is None else call.steps_before + call.n_steps,
            log_interval=call.log_interval,
            reset_num_timesteps=call.steps_before == 0,
        )
        self.on_training_start(attributes, globals())
        self.on_rollout_start()

    def __call__(self, agent: Agent, progress: Progress) -> bool:
        """Calls ``update_locals``, ``on_step`` and, around an update, ``on_rollout_end`` and ``on_rollout_start``."""
        call, result = agent.call.training_call, progress.result
        assert call is not None
        assert result is not None
        self.update_locals(
            {
                "progress": progress,
                "actions": progress.action,
                "clipped_actions": progress.action,
                "new_obs": agent.run.obs,
                "rewards": result.reward,
                "dones": result.terminated | result.truncated,
                "infos": env_infos(agent, progress),
            }
        )
        if not self.on_step():
            return False
        is_last = call.is_over(agent.run)
        if progress.rollout_ended or is_last:
            self.on_rollout_end()
            if not is_last:
                self.on_rollout_start()
        return True

    def after_training(self, agent: Agent, error: BaseException | None) -> None:
        """Calls ``on_training_end``, unless an exception ended training."""
        if error is None:
            self.on_training_end()

    @property
    def training_env(self) -> VecEnv:
        """The environments that the agent trains in; they must not be stepped."""
        env = self.model.get_env()
        assert env is not None, "training needs environments"
        return env

    @property
    def logger(self) -> Logger:
        """Records values for the next row of statistics: ``self.logger.record("group/name", value)``."""
        return self.model.logger

    def state_dict(self) -> JsonObject:
        """Returns the attributes named in ``carried``, for a checkpoint."""
        return {name: getattr(self, name) for name in self.carried}

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Restores what :meth:`state_dict` returned."""
        for name in self.carried:
            setattr(self, name, state[name])

    def init_callback(self, model: Agent) -> None:
        """Sets the agent, also of the child callbacks."""
        self.model = model
        self._init_callback()
        for child in self._children():
            child.init_callback(model)

    def on_training_start(self, locals_: Variables, globals_: Variables) -> None:
        """Called before the first step."""
        self.locals, self.globals = locals_, globals_
        self.num_timesteps = self.model.num_timesteps
        self._on_training_start()
        for child in self._children():
            child.on_training_start(locals_, globals_)

    def on_rollout_start(self) -> None:
        """Called before the first step after an update."""
        self._on_rollout_start()

    def on_step(self) -> bool:
        """Called after each step of the environments; returns whether to continue. None stops, with a warning."""
        self.n_calls += 1
        self.num_timesteps = self.model.num_timesteps
        continues = self._on_step()
        if continues is None:
            text = "returned None, which stops training as False does; return True to continue"
            warnings.warn(f"{type(self).__name__}._on_step {text}", UserWarning, 2)
        return bool(continues)

    def on_rollout_end(self) -> None:
        """Called after the last step before an update."""
        self._on_rollout_end()

    def on_training_end(self) -> None:
        """Called after the last step."""
        self._on_training_end()

    def update_locals(self, locals_: Variables) -> None:
        """Updates ``locals``, also of the child callbacks."""
        self.locals.update(locals_)
        self.update_child_locals(locals_)

    def update_child_locals(self, locals_: Variables) -> None:
        """Updates ``locals`` of the child callbacks."""
        for child in self._children():
            child.update_locals(locals_)

    def _children(self) -> list[BaseCallback]:
        return []

    def _init_callback(self) -> None:
        """Override it to act once the agent is known."""

    def _on_training_start(self) -> None:
        """Override it to act before the first step."""

    def _on_rollout_start(self) -> None:
        """Override it to act before the first step after an update."""

    @abstractmethod
    def _on_step(self) -> bool:
        """Implement it to act after each step of the environments; returns whether to continue."""

    def _on_rollout_end(self) -> None:
        """Override it to act after the last step before an update."""

    def _on_training_end(self) -> None:
        """Override it to act after the last step."""


class ParentCallback(BaseCallback):
    """A callback that contains others. Abstract: subclasses define ``_children``."""

    def state_dict(self) -> JsonObject:
        """Returns its own state, and that of each callback in it with the name of its class."""
        parts = [[type(child).__name__, child.state_dict()] for child in self._children()]
        return {"self": super().state_dict(), "inside": parts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if the callbacks differ.
        """
        super().load_state_dict(state["self"])
        types, saved = [type(child).__name__ for child in self._children()], [name for name, _ in state["inside"]]
        if types != saved:
            raise ValueError(f"the run was saved with the callbacks {', '.join(saved)}, but has {', '.join(types)}")
        for child, (_, child_state) in zip(self._children(), state["inside"], strict=True):
            child.load_state_dict(child_state)


class EventCallback(ParentCallback):
    """Calls another callback on an event. Abstract: subclasses call ``_on_event`` in ``_on_step``.

    Args:
        callback: the callback, or a function of ``(locals, globals)``; None for none.
        verbose: see :class:`BaseCallback`.
    """

    def __init__(self, callback: BaseCallback | Callable[..., Any] | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.callback = None if callback is None else to_callback(callback)
        if self.callback is not None:
            self.callback.parent = self

    def _children(self) -> list[BaseCallback]:
        return [] if self.callback is None else [self.callback]

    def _on_event(self) -> bool:
        return True if self.callback is None else self.callback.on_step()


class CallbackList(ParentCallback):
    """Several callbacks as one; training stops when one of them returns False.

    Args:
        callbacks: callbacks, or functions of ``(locals, globals)``.
    """

    def __init__(self, callbacks: Iterable[BaseCallback | Callable[..., Any]]) -> None:
        super().__init__()
        self.callbacks = [to_callback(callback) for callback in callbacks]

    def _children(self) -> list[BaseCallback]:
        return self.callbacks

    def _init_callback(self) -> None:
        for callback in self.callbacks:
            callback.parent = self.parent

    def _on_rollout_start(self) -> None:
        for callback in self.callbacks:
            callback.on_rollout_start()

    def _on_step(self) -> bool:
        return all([callback.on_step() for callback in self.callbacks])  # noqa: C419 - every one is called

    def _on_rollout_end(self) -> None:
        for callback in self.callbacks:
            callback.on_rollout_end()

    def _on_training_end(self) -> None:
        for callback in self.callbacks:
            callback.on_training_end()


class ConvertCallback(BaseCallback):
    """A function of ``(locals, globals)`` as a callback; a false value stops training, None with a warning.

    ``learn`` calls a plain function as ``callback(agent, progress)``; wrap one of ``(locals, globals)`` in this class.

    Args:
        callback: the function.
        verbose: see :class:`BaseCallback`.
    """

    def __init__(self, callback: Callable[[Variables, Variables], Any] | None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.callback = callback

    def _on_step(self) -> bool:
        return self.callback is None or self.callback(self.locals, self.globals)


def to_callback(callback: BaseCallback | Callable[..., Any]) -> BaseCallback:
    """Returns a callback unchanged, and a function of ``(locals, globals)`` as a callback."""
    return callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)


def env_infos(agent: Agent, progress: Progress) -> list[Info]:
    """Returns one info for each environment, with the keys that Stable-Baselines3's ``VecEnv`` and ``Monitor`` add."""
    result, env = progress.result, agent.run.env
    assert result is not None
    assert env is not None
    infos = [
        {**info, TIME_LIMIT_TRUNCATED: bool(result.truncated[i] and not result.terminated[i])}
        for i, info in enumerate(each_info(result.info, env.n_envs))
    ]
    for i in np.flatnonzero(result.terminated | result.truncated).tolist():
        if progress.last_obs is not None:
            infos[i].setdefault(TERMINAL_OBSERVATION, jax.tree.map(lambda leaf, i=i: leaf[i], progress.last_obs))
        if not np.isnan(success := env.success(result, i)):
            infos[i].setdefault("is_success", bool(success))
    for episode in progress.episodes:
        entry = {"r": episode.episode_return, "l": episode.length, "t": episode.seconds}
        infos[episode.env].setdefault("episode", entry)
    return infos
