"""What agents read from files of Stable-Baselines3 do, compared with what ``trials/sb3_models.py`` recorded there."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from rejeu.agents.zip_files import load_zip
from rejeu.algorithms.sac.continuous import policy as squashed_normal
from rejeu.core import normalization
from rejeu.core.algorithm import Masked
from rejeu.core.distributions import Normal, TanhNormal
from rejeu.core.spaces import groups, unscale_action


def loaded(path: Path) -> Any:
    """Returns the agent of a zip file, with the ``VecNormalize`` beside it if there is one."""
    scaler = path.with_name(f"{path.name}.pkl")
    return load_zip(path.with_name(f"{path.name}.zip"), vecnormalize=scaler if scaler.exists() else None)


def difference_from(agent: Any, data: Any) -> dict[str, float]:
    """Returns the largest differences between an agent and a record: of actions, values and log-probabilities.

    Discrete actions count where their values differ by more than the limit.
    """
    keys = [key for key in data if key.startswith("obs.")]
    obs: Any = {key.removeprefix("obs."): data[key] for key in keys} if keys else data["obs"]
    space = agent.action_space
    shapes = [leaf.shape for leaf in agent.obs_leaves]
    is_first = any(len(shape) == 3 and shape[0] == min(shape) for shape in shapes)
    obs = jax.tree.map(lambda x: x.transpose(0, 3, 1, 2) if x.ndim == 4 and is_first else x, obs)
    state = agent.state
    learner = state.learner if hasattr(state, "learner") else state
    values: Any
    if "starts" in data:
        memory, actions, values, log_probs = None, [], [], []
        for i, start in enumerate(data["starts"]):
            row = jax.tree.map(lambda x, i=i: x[i : i + 1], obs)
            values.append(agent.value(row, memory, [start]))
            action, after = agent.predict(row, memory, [start], deterministic=True)
            distribution = learner.network.policy(after)
            log_probs.append(distribution.log_prob(jnp.asarray(unit(space, data["sampled"][i : i + 1]))))
            actions.append(action)
            memory = after
        acts, values, log_prob = np.concatenate(actions), np.concatenate(values), np.concatenate(log_probs)
    else:
        masks = data.get("masks")
        acts = agent.predict(obs, deterministic=True, **({} if masks is None else {"action_masks": masks}))[0]
        is_on_policy = hasattr(agent, "value") and agent.name != "PQN"
        if is_on_policy:
            values = agent.value(obs)
        else:
            box_actions = None if isinstance(space, spaces.Discrete) else data["actions"]
            values = agent.q_values(obs, box_actions, "all")
            values = values[0] if isinstance(space, spaces.Discrete) else values
        log_prob = None
        if "log_probs" in data:
            actor = agent.learner.algorithm.actor(state)
            actor, policy_obs = (actor[0], scaled(agent, actor[1], obs)) if isinstance(actor, tuple) else (actor, obs)
            policy_obs = policy_obs if masks is None else Masked(policy_obs, masks)
            if is_on_policy:
                distribution = actor.policy(policy_obs)
                squashes = agent.config.policy_kwargs.squash_output
                sampled = data["sampled"] if squashes else unit(space, data["sampled"])
            else:
                distribution, sampled = squashed_normal(actor, policy_obs), data["sampled"]
            if isinstance(distribution, TanhNormal):
                distribution = Normal(distribution.mean, distribution.log_std)
            log_prob = np.asarray(distribution.log_prob(jnp.asarray(sampled)))
    recorded = clipped(space, data["actions"])
    differences = {"values": float(np.abs(values - data["values"]).max())}
    if isinstance(space, spaces.Box):
        differences["actions"] = float(np.abs(acts - recorded).max())
    else:
        differences["actions"] = float((acts != recorded).mean())
    if log_prob is not None:
        squashed = getattr(agent.config.policy_kwargs, "squash_output", True)
        shift = 0.0 if squashed or not isinstance(space, spaces.Box) else np.log((space.high - space.low) / 2).sum()
        differences["log_probs"] = float(np.abs(np.asarray(log_prob) - shift - data["log_probs"]).max())
    return differences


def scaled(agent: Any, statistics: Any, obs: Any) -> Any:
    """Returns normalized observations."""
    indices = groups(agent.obs_leaves)
    shapes = {g: leaf.shape for g, leaf in zip(indices, agent.obs_leaves, strict=True) if g is not None}
    return normalization.Normalizer(indices, shapes, agent.config.normalize, 1.0).obs(statistics, obs)


def unit(space: Any, action: np.ndarray) -> np.ndarray:
    """Returns actions in the algorithm's range."""
    return unscale_action(space, action) if isinstance(space, spaces.Box) else action


def clipped(space: Any, action: np.ndarray) -> np.ndarray:
    """Returns actions within the bounds, as both libraries hand them to an environment."""
    return action.clip(space.low, space.high) if hasattr(space, "low") else action


class MadeUp(gym.Env):
    """Samples observations; the reward is 0."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.observation_space, self.action_space, self.t = observation_space, action_space, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self.observation_space.sample(), 0.0, False, self.t == 20, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.linalg.norm(np.asarray(achieved) - np.asarray(desired), axis=-1)
