"""Callbacks as objects with hooks, as Stable-Baselines3's are; ``learn`` takes them beside rejeu's own functions.

A heir of :class:`BaseCallback` defines ``_on_step``, which returns whether to go on, and any of ``_on_training_start``,
``_on_rollout_start``, ``_on_rollout_end`` and ``_on_training_end``. A *call* is one step of all environments together, so
frequencies in calls (``eval_freq``, ``save_freq``) mean ``n_envs`` times as many environment steps. New code may find
:mod:`rejeu.callbacks` simpler, whose frequencies are in environment steps.

A rollout is what comes between two updates: ``n_steps`` calls with PPO and A2C, ``train_freq`` with the others. Unlike
there, the update that a rollout ends in has been started when ``_on_step`` and ``_on_rollout_end`` of its last step are
called.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from rejeu.checkpoint import SUFFIX
from rejeu.config import whole
from rejeu.envs.auto_reset import DummyVecEnv, around
from rejeu.envs.vec_env import VecEnv
from rejeu.envs.vec_normalize import sync_envs_normalization
from rejeu.evaluation import evaluate_policy
from rejeu.logging import Logger
from rejeu.loops.host import Progress

if TYPE_CHECKING:
    from rejeu.agents import Agent, Callback


class BaseCallback(ABC):
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

    def update_child_locals(self, locals_: dict[str, Any]) -> None:  # noqa: B027 - a hook, empty by intention
        """Hands that on to what it calls."""

    def _init_callback(self) -> None:  # noqa: B027
        """For heirs: once the agent is known."""

    def _on_training_start(self) -> None:  # noqa: B027
        """For heirs: before the first step."""

    def _on_rollout_start(self) -> None:  # noqa: B027
        """For heirs: before the first step after an update."""

    @abstractmethod
    def _on_step(self) -> bool:
        """For heirs: after each step of the environments; returns whether to go on."""

    def _on_rollout_end(self) -> None:  # noqa: B027
        """For heirs: after the last step before an update."""

    def _on_training_end(self) -> None:  # noqa: B027
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


class CheckpointCallback(BaseCallback):
    """Saves the agent every so many calls to ``save_path/{name_prefix}_{steps}_steps.safetensors``.

    Args:
        save_freq: calls between two checkpoints: ``n_envs`` times as many environment steps.
        save_path: folder, made if missing.
        name_prefix: of the files' names.
        save_replay_buffer: save that too, as ``{name_prefix}_replay_buffer_{steps}_steps.safetensors``.
        save_vecnormalize: save the statistics of ``VecNormalize`` too, as ``{name_prefix}_vecnormalize_...``.
        verbose: 2 prints each path.
    """

    def __init__(
        self,
        save_freq: int,
        save_path: str | Path,
        name_prefix: str = "rl_model",
        save_replay_buffer: bool = False,
        save_vecnormalize: bool = False,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.save_freq = whole("save_freq", save_freq, least=1)
        self.save_path = Path(save_path)
        self.name_prefix = name_prefix
        self.save_replay_buffer, self.save_vecnormalize = save_replay_buffer, save_vecnormalize

    def _on_step(self) -> bool:
        from rejeu.agents.off_policy import OffPolicyAgent  # which imports this module

        if self.n_calls % self.save_freq == 0:
            self._say(self.model.save(self._path("")))
            if self.save_replay_buffer and isinstance(self.model, OffPolicyAgent):
                self._say(self.model.save_replay_buffer(self._path("replay_buffer_")))
            statistics = self.model.get_vec_normalize_env()
            if self.save_vecnormalize and statistics is not None:
                self._say(statistics.save(self._path("vecnormalize_")))
        return True

    def _path(self, kind: str) -> Path:
        return self.save_path / f"{self.name_prefix}_{kind}{self.num_timesteps}_steps{SUFFIX}"

    def _say(self, path: Path) -> None:
        if self.verbose >= 2:
            print(f"Saved {path}")


class EvalCallback(EventCallback):
    """Evaluates every so many calls, keeps the best model and writes down every result.

    If the agent trains in a ``VecNormalize``, ``eval_env`` must be wrapped alike, with ``training=False``; its statistics
    are copied before each evaluation.

    Args:
        eval_env: a Gymnasium or vector environment other than the one the agent trains on.
        callback_on_new_best: called when an evaluation was the best so far.
        callback_after_eval: called after each evaluation.
        n_eval_episodes: episodes of an evaluation.
        eval_freq: calls between two evaluations: ``n_envs`` times as many environment steps.
        log_path: folder for ``evaluations.npz`` with ``timesteps (n,)``, ``results (n, episodes)``, ``ep_lengths`` and,
            where the environment says, ``successes``; plain arrays. None writes none.
        best_model_save_path: folder for ``best_model.safetensors``. None saves none.
        deterministic: the policy's mode, or a sample.
        render: show the environment while it plays.
        verbose: 1 prints each result.
        warn: accepted and without effect; see :func:`rejeu.evaluate_policy`.

    Raises:
        TypeError: if ``eval_env`` is no environment.
    """

    carried: ClassVar[tuple[str, ...]] = (
        *BaseCallback.carried,
        "best_mean_reward",
        "last_mean_reward",
        "evaluations_timesteps",
        "evaluations_results",
        "evaluations_length",
        "evaluations_successes",
    )

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 5,
        eval_freq: int = 10_000,
        log_path: str | Path | None = None,
        best_model_save_path: str | Path | None = None,
        deterministic: bool = True,
        render: bool = False,
        verbose: int = 1,
        warn: bool = True,
    ) -> None:
        super().__init__(callback_after_eval, verbose)
        self.callback_on_new_best = None if callback_on_new_best is None else hooked(callback_on_new_best)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.parent = self
        if isinstance(eval_env, gym.Env):
            eval_env = around([eval_env])
        if not isinstance(eval_env, VecEnv):
            raise TypeError(f"eval_env must be a Gymnasium or a vector environment, got {type(eval_env).__name__}")
        self.eval_env = eval_env
        self.n_eval_episodes = whole("n_eval_episodes", n_eval_episodes, least=1)
        self.eval_freq = eval_freq
        self.log_path = None if log_path is None else str(Path(log_path) / "evaluations")
        self.best_model_save_path = best_model_save_path
        self.deterministic, self.render = deterministic, render
        self.best_mean_reward = self.last_mean_reward = -np.inf
        self.evaluations_timesteps: list[int] = []
        self.evaluations_results: list[list[float]] = []
        self.evaluations_length: list[list[int]] = []
        self.evaluations_successes: list[list[bool]] = []
        self._successes: list[bool] = []

    def _inside(self) -> list[BaseCallback]:
        return super()._inside() + ([] if self.callback_on_new_best is None else [self.callback_on_new_best])

    def init_callback(self, model: Agent) -> None:
        """Tells it the agent.

        Raises:
            ValueError: if it was given the environments that the agent trains on.
        """
        super().init_callback(model)
        if _behind(self.training_env) & _behind(self.eval_env):
            raise ValueError("EvalCallback was given the environments that the agent trains on; give it others")
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(model)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Tells what it calls what the loop knows."""
        super().update_child_locals(locals_)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.update_locals(locals_)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.on_training_start(self.locals, self.globals)

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq:
            return True
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        self._successes = []
        returns, lengths = evaluate_policy(
            self.model,
            self.eval_env,
            self.n_eval_episodes,
            self.deterministic,
            self.render,
            self._note_success,
            return_episode_rewards=True,
        )
        assert isinstance(returns, list)
        assert isinstance(lengths, list)
        self._write(returns, lengths)
        self._report(returns, lengths)
        goes_on = True
        if self.last_mean_reward > self.best_mean_reward:
            self.best_mean_reward = self.last_mean_reward
            if self.verbose >= 1:
                print("New best mean reward!")
            if self.best_model_save_path is not None:
                self.model.save(Path(self.best_model_save_path) / f"best_model{SUFFIX}")
            if self.callback_on_new_best is not None:
                goes_on = self.callback_on_new_best.on_step()
        return goes_on and self._on_event()

    def _note_success(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        if locals_["done"] and (success := locals_["info"].get("is_success")) is not None:
            self._successes.append(bool(success))

    def _write(self, returns: list[float], lengths: list[int]) -> None:
        if self.log_path is None:
            return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(returns)
        self.evaluations_length.append(lengths)
        parts: dict[str, Any] = {}
        if self._successes:
            self.evaluations_successes.append(self._successes)
            if {len(row) for row in self.evaluations_successes} == {self.n_eval_episodes}:
                parts["successes"] = np.array(self.evaluations_successes)
        Path(self.log_path).parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            self.log_path,
            timesteps=np.array(self.evaluations_timesteps),
            results=np.array(self.evaluations_results),
            ep_lengths=np.array(self.evaluations_length),
            **parts,
        )

    def _report(self, returns: list[float], lengths: list[int]) -> None:
        self.last_mean_reward = float(np.mean(returns))
        if self.verbose >= 1:
            print(
                f"Eval num_timesteps={self.num_timesteps}, "
                f"episode_reward={self.last_mean_reward:.2f} +/- {np.std(returns):.2f}"
            )
            print(f"Episode length: {np.mean(lengths):.2f} +/- {np.std(lengths):.2f}")
        self.logger.record("eval/mean_reward", self.last_mean_reward)
        self.logger.record("eval/mean_ep_length", float(np.mean(lengths)))
        if self._successes:
            self.logger.record("eval/success_rate", float(np.mean(self._successes)))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)


class StopTrainingOnRewardThreshold(BaseCallback):
    """Stops once the best evaluation reaches a mean return; give it to ``EvalCallback(callback_on_new_best=...)``.

    Args:
        reward_threshold: least mean return.
        verbose: 1 says so.
    """

    def __init__(self, reward_threshold: float, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.reward_threshold = reward_threshold

    def _on_step(self) -> bool:
        goes_on = _evaluation(self).best_mean_reward < self.reward_threshold
        if self.verbose >= 1 and not goes_on:
            print(f"Stopping: the mean return has reached {self.reward_threshold}")
        return goes_on


class StopTrainingOnNoModelImprovement(BaseCallback):
    """Stops after more than so many evaluations in a row without a new best; for ``callback_after_eval``.

    Args:
        max_no_improvement_evals: so many are borne.
        min_evals: evaluations before counting begins.
        verbose: 1 says so.
    """

    carried: ClassVar[tuple[str, ...]] = (*BaseCallback.carried, "last_best_mean_reward", "no_improvement_evals")

    def __init__(self, max_no_improvement_evals: int, min_evals: int = 0, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.max_no_improvement_evals, self.min_evals = max_no_improvement_evals, min_evals
        self.last_best_mean_reward = -np.inf
        self.no_improvement_evals = 0

    def _on_step(self) -> bool:
        best, goes_on = _evaluation(self).best_mean_reward, True
        if self.n_calls > self.min_evals:
            self.no_improvement_evals = 0 if best > self.last_best_mean_reward else self.no_improvement_evals + 1
            goes_on = self.no_improvement_evals <= self.max_no_improvement_evals
        self.last_best_mean_reward = best
        if self.verbose >= 1 and not goes_on:
            print(f"Stopping: no new best model in the last {self.no_improvement_evals} evaluations")
        return goes_on


class StopTrainingOnMaxEpisodes(BaseCallback):
    """Stops once ``max_episodes`` times the number of environments have ended, over all environments.

    Args:
        max_episodes: per environment.
        verbose: 1 says so.
    """

    carried: ClassVar[tuple[str, ...]] = (*BaseCallback.carried, "n_episodes")

    def __init__(self, max_episodes: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.max_episodes = whole("max_episodes", max_episodes, least=1)
        self.n_episodes = 0

    def _on_step(self) -> bool:
        self.n_episodes += int(np.sum(self.locals["dones"]))
        goes_on = self.n_episodes < self.max_episodes * self.model.n_envs
        if self.verbose >= 1 and not goes_on:
            print(f"Stopping after {self.n_episodes} episodes in {self.num_timesteps} steps")
        return goes_on


class EveryNTimesteps(EventCallback):
    """Calls another callback every so many environment steps, at the first call after them.

    Args:
        n_steps: environment steps, over all environments.
        callback: what is called; a function takes ``(locals, globals)``.
    """

    carried: ClassVar[tuple[str, ...]] = (*EventCallback.carried, "last_time_trigger")

    def __init__(self, n_steps: int, callback: BaseCallback | Callable[..., Any]) -> None:
        super().__init__(callback)
        self.n_steps = whole("n_steps", n_steps, least=1)
        self.last_time_trigger = 0

    def _on_step(self) -> bool:
        if self.num_timesteps - self.last_time_trigger < self.n_steps:
            return True
        self.last_time_trigger = self.num_timesteps
        return self._on_event()


class ProgressBarCallback(BaseCallback):
    """Shows how far training has come, as ``learn(progress_bar=True)`` does."""

    def __init__(self) -> None:
        super().__init__()
        self._bar: Any = None

    def _on_training_start(self) -> None:
        from rejeu.callbacks import ProgressBar  # which imports the agents

        self._bar = ProgressBar(self.locals["total_timesteps"], None)

    def _on_step(self) -> bool:
        self._bar(self.model, self.locals["progress"])
        return True

    def _on_training_end(self) -> None:
        self._bar.close()


class Hooks:
    """What calls the hooks of a callback in the course of one ``learn``."""

    def __init__(self, callback: BaseCallback | None) -> None:
        self.callback = callback
        self._first = 0
        self._n_steps: int | None = None

    def begin(self, agent: Agent, n_steps: int | None, arguments: dict[str, Any]) -> None:
        """Calls what comes before the first step; ``n_steps`` will be taken, None if only something else ends the run."""
        if self.callback is None:
            return
        self._first, self._n_steps = agent.num_timesteps, n_steps
        self.callback.init_callback(agent)
        known = {"self": agent, "env": agent.get_env(), "callback": self.callback, "total_timesteps": n_steps}
        self.callback.on_training_start({**known, **arguments}, globals())
        self.callback.on_rollout_start()

    def step(self, agent: Agent, progress: Progress, obs: Any) -> bool:
        """Calls what comes after a turn of the loop; returns whether to go on.

        Args:
            agent: the agent.
            progress: what the turn did.
            obs: the observations to act on next.
        """
        if self.callback is None:
            return True
        assert progress.result is not None
        result = progress.result
        self.callback.update_locals(
            {
                "progress": progress,
                "actions": progress.action,
                "new_obs": obs,
                "rewards": result.reward,
                "dones": result.terminated | result.truncated,
                "infos": infos_of(agent, progress),
            }
        )
        if not self.callback.on_step():
            return False
        is_last = self._n_steps is not None and agent.num_timesteps - self._first >= self._n_steps
        if progress.rollout_ended or is_last:
            self.callback.on_rollout_end()
            if not is_last:
                self.callback.on_rollout_start()
        return True

    def end(self) -> None:
        """Calls what comes after the last step."""
        if self.callback is not None:
            self.callback.on_training_end()


def told_apart(callback: Any) -> tuple[Hooks, list[Callback]]:
    """Returns what was given to ``learn`` as callbacks with hooks and as functions of ``(agent, progress)``."""
    given = [callback] if callable(callback) or isinstance(callback, BaseCallback) else list(callback or ())
    with_hooks = [one for one in given if isinstance(one, BaseCallback)]
    together = CallbackList(with_hooks) if len(with_hooks) > 1 else with_hooks[0] if with_hooks else None
    return Hooks(together), [one for one in given if not isinstance(one, BaseCallback)]


def hooked(callback: BaseCallback | Callable[..., Any]) -> BaseCallback:
    """Returns a callback as it is, and a function of ``(locals, globals)`` as a callback."""
    return callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)


def infos_of(agent: Agent, progress: Progress) -> list[dict[str, Any]]:
    """Returns one info for each environment, with what Stable-Baselines3's vector environments and Monitor put there."""
    result, env = progress.result, agent.env
    assert result is not None
    assert env is not None
    said = result.info if isinstance(result.info, list) else [{} for _ in range(env.n_envs)]
    infos = [
        {**info, "TimeLimit.truncated": bool(result.truncated[i] and not result.terminated[i])}
        for i, info in enumerate(said)
    ]
    for i in np.flatnonzero(result.terminated | result.truncated).tolist():
        if progress.last_obs is not None:
            infos[i].setdefault("terminal_observation", _row(progress.last_obs, i))
        if not np.isnan(success := env.success(result, i)):
            infos[i].setdefault("is_success", bool(success))
    for episode in progress.episodes:
        counted = {"r": episode.episode_return, "l": episode.length, "t": episode.seconds}
        infos[episode.env].setdefault("episode", counted)
    return infos


def _row(batch: Any, i: int) -> Any:
    if isinstance(batch, dict):
        return {key: _row(part, i) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_row(part, i) for part in batch)
    return batch[i]


def _evaluation(callback: BaseCallback) -> EvalCallback:
    if not isinstance(callback.parent, EvalCallback):
        raise TypeError(f"{type(callback).__name__} judges evaluations; give it to EvalCallback")
    return callback.parent


def _behind(venv: VecEnv) -> set[int]:
    """Identifies the environments behind a vector environment."""
    base = venv.unwrapped
    return {id(base), *(id(env) for env in (base.envs if isinstance(base, DummyVecEnv) else ()))}
