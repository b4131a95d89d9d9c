"""sb3-contrib's API at its own module paths.

To port a script, replace ``sb3_contrib`` by ``rejeu.sb3_contrib`` in its imports.

>>> from rejeu.sb3_contrib import TQC
>>> from rejeu.sb3_contrib.common.wrappers import TimeFeatureWrapper
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.algorithms.catalog import CATALOG
from rejeu.core.types import Action, Info, Observation
from rejeu.sb3.algorithms import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from rejeu.sb3.common.callbacks import EvalCallback
from rejeu.sb3.common.envs import IdentityEnv
from rejeu.sb3.common.evaluation import evaluate_policy as evaluate_by_masks
from rejeu.sb3.common.policies import ActorCriticPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv
from rejeu.sb3.modules import HOMES, alias, define
from rejeu.sb3.policy import Actor, ContinuousCritic, DQNPolicy, QNetwork, SACPolicy

__all__ = ["ARS", "QRDQN", "TQC", "TRPO", "CrossQ", "MaskablePPO", "MaskableRecurrentPPO", "RecurrentPPO"]

MaskableRecurrentPPO: Any = partial(RecurrentPPO, action_masks=True)
"""RecurrentPPO with masks of the allowed actions."""
MaskableRecurrentPPO.load = RecurrentPPO.load


class ActionMasker(gym.Wrapper):
    """Gives an environment the method ``action_masks``.

    Args:
        env: the environment.
        action_mask_fn: function of the environment that returns the mask, or the name of a method that takes it, or nothing.
    """

    def __init__(self, env: gym.Env, action_mask_fn: str | Callable[[Any], Any]) -> None:
        super().__init__(env)
        mask_function: Any = env.get_wrapper_attr(action_mask_fn) if isinstance(action_mask_fn, str) else action_mask_fn
        self._mask = partial(mask_function, env) if inspect.signature(mask_function).parameters else mask_function

    def action_masks(self) -> np.ndarray:
        """Returns which actions are allowed, ``bool (n,)``."""
        return np.asarray(self._mask(), bool)


class TimeFeatureWrapper(gym.Wrapper):
    """Adds the remaining share of an episode's time, from 1 to 0, to the observations.

    Args:
        env: an environment with Box observations, or a Dict with a Box ``observation``.
        max_steps: steps of an episode, where no ``TimeLimit`` says.
        test_mode: always show 1.
    """

    def __init__(self, env: gym.Env, max_steps: int = 1000, test_mode: bool = False) -> None:
        super().__init__(env)
        self._max_steps = getattr(env.spec, "max_episode_steps", None) or max_steps
        self._test_mode, self._step = test_mode, 0
        space = env.observation_space
        box = space["observation"] if isinstance(space, spaces.Dict) else space
        if not isinstance(box, spaces.Box) or len(box.shape) != 1:
            raise ValueError(f"TimeFeatureWrapper adds to a Box of one axis, or to one at 'observation'; got {space}")
        low, high = np.append(box.low, 0.0), np.append(box.high, 1.0)
        longer = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.observation_space = longer
        if isinstance(space, spaces.Dict):
            self.observation_space = spaces.Dict({**space.spaces, "observation": longer})

    def reset(self, **kwargs: Any) -> tuple[Observation, Info]:
        self._step = 0
        obs, info = self.env.reset(**kwargs)
        return self._with_time(obs), info

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        self._step += 1
        obs, *others = self.env.step(action)
        return (self._with_time(obs), *others)

    def _with_time(self, obs: Observation) -> Any:
        time_left = 1.0 if self._test_mode else 1.0 - self._step / self._max_steps
        if isinstance(obs, dict):
            return {**obs, "observation": np.append(obs["observation"], time_left).astype(np.float32)}
        return np.append(obs, time_left).astype(np.float32)


class MaskableEvalCallback(EvalCallback):
    """``EvalCallback``, which gives a policy the masks of the environment.

    Args:
        args: those of ``EvalCallback``.
        use_masking: only True.
        kwargs: those of ``EvalCallback``.
    """

    def __init__(self, *args: Any, use_masking: bool = True, **kwargs: Any) -> None:
        _require_masking(use_masking)
        super().__init__(*args, **kwargs)


class MaskableActorCriticPolicy(ActorCriticPolicy):
    """Policy and value of MaskablePPO."""


def evaluate_policy(*args: Any, use_masking: bool = True, **kwargs: Any) -> Any:
    """Returns the result of :func:`rejeu.sb3.common.evaluation.evaluate_policy`, which gives a policy the masks.

    Raises:
        ValueError: if the environment has no masks.
    """
    env = kwargs.get("env", args[1] if len(args) > 1 else None)
    if not use_masking and args and isinstance(args[0], MaskablePPO):
        return evaluate_by_masks(_WithoutMasks(args[0]), *args[1:], **kwargs)
    if not is_masking_supported(env):
        raise ValueError("the environment has no method action_masks; wrap it in ActionMasker, or use PPO")
    return evaluate_by_masks(*args, **kwargs)


class _WithoutMasks:
    """The ``predict`` of a model, to which all actions are allowed."""

    def __init__(self, model: Any) -> None:
        self.predict = model.predict


def _require_masking(use_masking: bool) -> None:
    if not use_masking:
        raise ValueError("use_masking=False: MaskablePPO needs masks; use PPO for environments without")


def get_action_masks(env: Any) -> np.ndarray:
    """Returns the masks of an environment, ``bool (n,)``, or of a vector environment, ``bool (num_envs, n)``."""
    return (
        np.stack(env.env_method("action_masks")) if isinstance(env, VecEnv) else env.get_wrapper_attr("action_masks")()
    )


def is_masking_supported(env: Any) -> bool:
    """Returns whether an environment has a method ``action_masks``."""
    if isinstance(env, VecEnv):
        return env.has_attr("action_masks")
    return not isinstance(env, gym.Env) or env.has_wrapper_attr("action_masks")


class InvalidActionEnvDiscrete(IdentityEnv):
    """An :class:`IdentityEnv` of ``dim`` choices, of which ``n_invalid_actions`` wrong ones are masked."""

    def __init__(self, dim: int | None = None, ep_length: int = 100, n_invalid_actions: int = 0) -> None:
        super().__init__(dim, ep_length=ep_length)
        self.n_invalid_actions = n_invalid_actions

    def action_masks(self) -> np.ndarray:
        """Returns which choices are allowed, ``bool (dim,)``; the right one always is."""
        n = self.action_space.n  # type: ignore[attr-defined]
        wrong = np.delete(np.arange(n), self.state)
        return ~np.isin(np.arange(n), self.np_random.choice(wrong, self.n_invalid_actions, replace=False))


MODULES: dict[str, dict[str, Any]] = {
    "common": {},
    "common.envs": {"InvalidActionEnvDiscrete": InvalidActionEnvDiscrete},
    "common.wrappers": {"ActionMasker": ActionMasker, "TimeFeatureWrapper": TimeFeatureWrapper},
    "common.wrappers.action_masker": {"ActionMasker": ActionMasker},
    "common.wrappers.time_feature": {"TimeFeatureWrapper": TimeFeatureWrapper},
    "common.maskable": {},
    "common.maskable.callbacks": {"MaskableEvalCallback": MaskableEvalCallback},
    "common.maskable.evaluation": {"evaluate_policy": evaluate_policy},
    "common.maskable.utils": {"get_action_masks": get_action_masks, "is_masking_supported": is_masking_supported},
    "common.maskable.policies": {
        "MaskableActorCriticPolicy": MaskableActorCriticPolicy,
        "MaskableActorCriticCnnPolicy": CnnPolicy,
        "MaskableMultiInputActorCriticPolicy": MultiInputPolicy,
    },
    "common.recurrent": {},
    "common.recurrent.policies": {
        "RecurrentActorCriticPolicy": ActorCriticPolicy,
        "RecurrentActorCriticCnnPolicy": CnnPolicy,
        "RecurrentMultiInputActorCriticPolicy": MultiInputPolicy,
    },
}
"""Names by the module in which sb3-contrib has them."""
policies = {"CnnPolicy": CnnPolicy, "MlpPolicy": MlpPolicy, "MultiInputPolicy": MultiInputPolicy}
for algorithm in (QRDQN, TQC, CrossQ, MaskablePPO, TRPO):
    parts = {f"{algorithm.__name__}Policy": SACPolicy, "Actor": Actor, "Critic": ContinuousCritic}
    parts |= {"QRDQNPolicy": DQNPolicy, "QuantileNetwork": QNetwork, "CrossQCritic": ContinuousCritic}
    folder = CATALOG[algorithm.__name__].original.rpartition(".")[2]
    MODULES[folder] = {
        algorithm.__name__: algorithm,
        **policies,
        **(parts if CATALOG[algorithm.__name__].policy else {}),
    }
linear = dict.fromkeys(("LinearPolicy", "ARSLinearPolicy"), "LinearPolicy")
MODULES["ars"] = {"ARS": ARS, **linear, **dict.fromkeys(("MlpPolicy", "ARSPolicy"), "MlpPolicy")}
lstm = {"CnnLstmPolicy": CnnPolicy, "MlpLstmPolicy": MlpPolicy, "MultiInputLstmPolicy": MultiInputPolicy}
MODULES["ppo_recurrent"] = {"RecurrentPPO": RecurrentPPO, **lstm}

for path, names in MODULES.items():
    define(f"{__name__}.{path}", names)
    HOMES.append(f"{__name__}.{path}")
    if "." not in path and path != "common":
        alias(f"{__name__}.{path}", path, "policies")
alias(f"{__name__}.common.envs", "invalid_actions_env")
