"""What a callback with hooks is, and how several, or others within it, are called."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from rejeu.callbacks.base import TrainingCallback
from rejeu.hooks.calling import infos_of
from rejeu.loops.run import Progress
from rejeu.reporting.logging import Logger
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv

if TYPE_CHECKING:
    from rejeu.agents import Agent


class BaseCallback(TrainingCallback):
    """What ``learn`` calls while it trains. Abstract: an heir defines ``_on_step``.

    Args:
        verbose: 0 is silent, 1 prints what happens, 2 more.

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

    carried: ClassVar[tuple[str, ...]] = ("n_calls",)
    """Names of the attributes that a checkpoint of the run keeps: numbers, texts, lists, dicts and arrays. An heir that
    remembers more adds to them."""

    def __init__(self, verbose: int = 0) -> None:
        self.verbose = verbose
        self.n_calls = 0
        """Steps of all environments together since it was made."""
        self.num_timesteps = 0
        """Environment steps, as ``model.num_timesteps``."""
        self.locals: dict[str, Any] = {}
        """What the loop knows: ``actions``, ``new_obs``, ``rewards``, ``dones``, ``infos``, ``self`` and ``env``."""
        self.globals: dict[str, Any] = {}
        self.parent: BaseCallback | None = None
        """What calls it, where that is a callback itself."""

    def before_training(self, agent: Agent) -> None:
        """Calls ``init_callback``, ``on_training_start`` and ``on_rollout_start``."""
        call = agent.training_call
        assert call is not None
        self.init_callback(agent)
        known = {
            "self": agent,
            "env": agent.get_env(),
            "callback": self,
            "total_timesteps": None if call.last_step is None else call.last_step - agent.run.step,
            "log_interval": call.log_interval,
            "reset_num_timesteps": call.steps_before == 0,
        }
        self.on_training_start(known, globals())
        self.on_rollout_start()

    def __call__(self, agent: Agent, progress: Progress) -> bool:
        """Calls ``update_locals``, ``on_step`` and, around an update, ``on_rollout_end`` and ``on_rollout_start``."""
        call, result = agent.training_call, progress.result
        assert call is not None
        assert result is not None
        self.update_locals(
            {
                "progress": progress,
                "actions": progress.action,
                "new_obs": agent.run.obs,
                "rewards": result.reward,
                "dones": result.terminated | result.truncated,
                "infos": infos_of(agent, progress),
            }
        )
        if not self.on_step():
            return False
        is_last = call.last_step is not None and progress.step >= call.last_step
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
        """The environments that the agent trains on; to be looked at, not to be stepped."""
        env = self.model.get_env()
        assert env is not None, "training needs environments"
        return env

    @property
    def logger(self) -> Logger:
        """Takes numbers for the next row of statistics: ``self.logger.record("group/name", value)``."""
        return self.model.logger

    def state_dict(self) -> dict[str, Any]:
        """Returns what ``carried`` names, for a checkpoint."""
        return {name: getattr(self, name) for name in self.carried}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes back what :meth:`state_dict` returned."""
        for name in self.carried:
            setattr(self, name, state[name])

    def init_callback(self, model: Agent) -> None:
        """Tells it the agent."""
        self.model = model
        self._init_callback()

    def on_training_start(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Is called before the first step."""
        self.locals, self.globals = locals_, globals_
        self.num_timesteps = self.model.num_timesteps
        self._on_training_start()

    def on_rollout_start(self) -> None:
        """Is called before the first step after an update."""
        self._on_rollout_start()

    def on_step(self) -> bool:
        """Is called after each step of the environments; returns whether to go on.

        Raises:
            TypeError: if ``_on_step`` returns nothing.
        """
        self.n_calls += 1
        self.num_timesteps = self.model.num_timesteps
        goes_on = self._on_step()
        if goes_on is None:
            raise TypeError(f"{type(self).__name__}._on_step returned None; return True to go on, False to stop")
        return bool(goes_on)

    def on_rollout_end(self) -> None:
        """Is called after the last step before an update."""
        self._on_rollout_end()

    def on_training_end(self) -> None:
        """Is called after the last step."""
        self._on_training_end()

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Tells it what the loop knows."""
        self.locals.update(locals_)
        self.update_child_locals(locals_)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Hands that on to what it calls."""

    def _init_callback(self) -> None:
        """For heirs: once the agent is known."""

    def _on_training_start(self) -> None:
        """For heirs: before the first step."""

    def _on_rollout_start(self) -> None:
        """For heirs: before the first step after an update."""

    @abstractmethod
    def _on_step(self) -> bool:
        """For heirs: after each step of the environments; returns whether to go on."""

    def _on_rollout_end(self) -> None:
        """For heirs: after the last step before an update."""

    def _on_training_end(self) -> None:
        """For heirs: after the last step."""


class EventCallback(BaseCallback):
    """Calls another callback when something happens. Abstract: an heir calls ``_on_event`` in ``_on_step``.

    Args:
        callback: what is called; a function takes ``(locals, globals)``. None for nothing.
        verbose: see :class:`BaseCallback`.
    """

    def __init__(self, callback: BaseCallback | Callable[..., Any] | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.callback = None if callback is None else hooked(callback)
        if self.callback is not None:
            self.callback.parent = self

    def init_callback(self, model: Agent) -> None:
        """Tells it and what it calls the agent."""
        super().init_callback(model)
        if self.callback is not None:
            self.callback.init_callback(model)

    def state_dict(self) -> dict[str, Any]:
        """Returns what it and what it calls remember."""
        return {"self": super().state_dict(), "inside": [child.state_dict() for child in self._inside()]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes that back."""
        super().load_state_dict(state["self"])
        for child, part in zip(self._inside(), state["inside"], strict=True):
            child.load_state_dict(part)

    def _inside(self) -> list[BaseCallback]:
        return [] if self.callback is None else [self.callback]

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Tells what it calls what the loop knows."""
        if self.callback is not None:
            self.callback.update_locals(locals_)

    def _on_training_start(self) -> None:
        if self.callback is not None:
            self.callback.on_training_start(self.locals, self.globals)

    def _on_event(self) -> bool:
        return True if self.callback is None else self.callback.on_step()


class CallbackList(BaseCallback):
    """Several callbacks as one; training stops when one of them says so.

    Args:
        callbacks: those; functions take ``(locals, globals)``.
    """

    def __init__(self, callbacks: Iterable[BaseCallback | Callable[..., Any]]) -> None:
        super().__init__()
        self.callbacks = [hooked(callback) for callback in callbacks]

    def state_dict(self) -> dict[str, Any]:
        """Returns what each remembers, by kind and place."""
        parts = [[type(callback).__name__, callback.state_dict()] for callback in self.callbacks]
        return {"self": super().state_dict(), "inside": parts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes that back.

        Raises:
            ValueError: if these are other callbacks.
        """
        super().load_state_dict(state["self"])
        own, saved = [type(callback).__name__ for callback in self.callbacks], [name for name, _ in state["inside"]]
        if own != saved:
            raise ValueError(f"the run was saved with the callbacks {', '.join(saved)}, and is given {', '.join(own)}")
        for callback, (_, part) in zip(self.callbacks, state["inside"], strict=True):
            callback.load_state_dict(part)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Tells each what the loop knows."""
        for callback in self.callbacks:
            callback.update_locals(locals_)

    def _init_callback(self) -> None:
        for callback in self.callbacks:
            callback.init_callback(self.model)

    def _on_training_start(self) -> None:
        for callback in self.callbacks:
            callback.on_training_start(self.locals, self.globals)

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
    """A function of ``(locals, globals)`` as a callback; only ``False`` stops training.

    ``learn`` itself calls a function as ``callback(agent, progress)``; wrap one of Stable-Baselines3's form in this.

    Args:
        callback: the function.
        verbose: see :class:`BaseCallback`.
    """

    def __init__(self, callback: Callable[[dict[str, Any], dict[str, Any]], Any] | None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.callback = callback

    def _on_step(self) -> bool:
        return self.callback is None or self.callback(self.locals, self.globals) is not False


def hooked(callback: BaseCallback | Callable[..., Any]) -> BaseCallback:
    """Returns a callback as it is, and a function of ``(locals, globals)`` as a callback."""
    return callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)
