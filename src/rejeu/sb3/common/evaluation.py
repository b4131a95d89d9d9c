"""Evaluation of a policy."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np

from rejeu.agents import Agent
from rejeu.agents.policy import lent
from rejeu.core import interrupt
from rejeu.core.algorithm import Masked
from rejeu.core.types import Variables
from rejeu.envs.make import make_vector
from rejeu.envs.masks import make_masked
from rejeu.logs.evaluation import MOST_STEPS, cut_off
from rejeu.sb3.modules import passes_on


def evaluate_policy(
    model: Any,
    env: Any,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    render: bool = False,
    callback: Callable[[Variables, Variables], object] | None = None,
    reward_threshold: float | None = None,
    return_episode_rewards: bool = False,
    warn: bool = True,
) -> tuple[float, float] | tuple[list[float], list[int]]:
    """Runs complete episodes and returns mean and standard deviation of the episode return.

    Where vector wrappers such as ``VecNormalize`` change rewards, the returns are those recorded by a ``Monitor`` inside
    them, if there is one.

    An agent with action masks receives those of the environment. If an agent trains in the same environments, its training
    continues with new episodes.

    Args:
        model: anything with ``predict(obs, state=..., episode_start=..., deterministic=...) -> (action, state)``.
        env: a Gymnasium environment, a vector environment, an id, or a function that makes an environment.
        n_eval_episodes: number of episodes, at least 1, distributed evenly over the environments of a vector.
        deterministic: use the mode of the policy; False samples actions.
        render: render the environment; it must have been made with ``render_mode="human"``.
        callback: called after every step of an environment with ``locals()`` and ``globals()``.
        reward_threshold: minimum mean return.
        return_episode_rewards: return the lists of episode returns and lengths instead.
        warn: accepted and ignored. Episodes are counted here, so a missing ``Monitor`` does not affect the result.

    Raises:
        AssertionError: if the mean return is not above ``reward_threshold``.
        TypeError: if the model uses action masks and those of the environment cannot be accessed.
    """
    agent = model if isinstance(model, Agent) else None
    vector = make_masked(env) if agent is not None and agent.takes_masks else make_vector(env)
    if n_eval_episodes < 1:
        raise ValueError(f"n_eval_episodes={n_eval_episodes} must be at least 1")
    if agent is not None and agent.get_vec_normalize_env() is not None and vector.vec_normalize is None:
        warnings.warn("the agent learns in a VecNormalize, and is evaluated without; wrap env alike", UserWarning, 2)
    longest = max(MOST_STEPS, vector.max_episode_steps or 0)
    share = (n_eval_episodes + np.arange(vector.n_envs)) // vector.n_envs
    current_rewards, current_lengths = np.zeros(vector.n_envs), np.zeros(vector.n_envs, int)
    episode_counts = np.zeros(vector.n_envs, int)
    episode_rewards: list[float] = []
    episode_lengths: list[int] = []
    with nullcontext() if agent is None else lent(agent, vector):
        observations, dones, states = vector.reset(), np.ones(vector.n_envs, bool), None
        while (episode_counts < share).any():
            obs, masks = observations if isinstance(observations, Masked) else (observations, None)
            arguments = {"state": states, "episode_start": dones, "deterministic": deterministic}
            actions, states = model.predict(obs, **arguments if masks is None else arguments | {"action_masks": masks})
            if (signal := interrupt.requested()) is not None:
                raise interrupt.Stopped(signal)
            step = vector.step(actions)
            rewards, dones, infos = step.reward, step.terminated | step.truncated, step.info
            current_rewards += rewards
            current_lengths += 1
            endless = ~dones & (episode_counts < share) & (current_lengths >= longest)
            for i in range(vector.n_envs):
                if callback is not None and episode_counts[i] < share[i]:
                    reward, done, info = rewards[i], dones[i], infos[i] if isinstance(infos, list) else infos
                    callback(locals(), globals())
                if dones[i] or endless[i]:
                    if episode_counts[i] < share[i]:
                        episode_rewards.append(step.return_of(i, current_rewards[i]))
                        episode_lengths.append(int(current_lengths[i]))
                        episode_counts[i] += share[i] + 1 if endless[i] else 1  # more than its share: cut off
                    current_rewards[i] = current_lengths[i] = 0
            observations = vector.reset_done(dones) if dones.any() else step.obs
            if render and hasattr(env, "render"):
                env.render()
    if cut := int((episode_counts > share).sum()):
        cut_off(cut)
    mean, std = float(np.mean(episode_rewards)), float(np.std(episode_rewards))
    if reward_threshold is not None and not mean > reward_threshold:
        raise AssertionError(f"the mean return {mean:.2f} is not above reward_threshold={reward_threshold:.2f}")
    return (episode_rewards, episode_lengths) if return_episode_rewards else (mean, std)


passes_on(__name__)
