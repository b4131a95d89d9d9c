"""The policy of an agent played for whole episodes, without disturbing its training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rejeu.agents import predicting
from rejeu.envs.auto_reset import identities
from rejeu.envs.envpool import envpool_knows
from rejeu.envs.make import VectorEnv
from rejeu.envs.registry import maker, register
from rejeu.envs.vec_normalize import unwrap_vec_normalize
from rejeu.reporting.evaluation import Evaluation, evaluate
from rejeu.validation import number, whole

if TYPE_CHECKING:
    from rejeu.agents.base import Agent


USUAL_EPISODES = 100
"""How many are played if neither a number nor a time is given."""
MOST_ENVS = 16
"""Most environments that are made to play in."""


def play(
    agent: Agent,
    episodes: int | None,
    env: Any,
    deterministic: bool,
    seed: int | None,
    success_threshold: float | None,
    minutes: float | None,
) -> Evaluation:
    """Returns what whole episodes came to; the arguments are those of :meth:`Agent.evaluate`.

    Raises:
        ValueError: without environments, or in those of other spaces or without the agent's ``VecNormalize``.
    """
    threshold = agent.success_threshold if success_threshold is None else success_threshold
    run = agent.run
    if episodes is None and minutes is None:
        episodes = USUAL_EPISODES
    episodes = None if episodes is None else whole("episodes", episodes, least=1)
    seconds = None if minutes is None else 60 * number("minutes", minutes, above=0)
    n_envs = MOST_ENVS if episodes is None else min(episodes, MOST_ENVS)
    made_here = isinstance(env, str) or callable(env)
    if env is not None:
        vector = agent._vector(env, n_envs if isinstance(env, str) else 1, seed=seed)
    elif run.env is None:
        vector = agent._vector(trained_on(agent), n_envs, seed=seed)
        made_here = True
    elif agent._own_env:
        vector = agent._vector(run.env.env_id, n_envs, run.env.backend, seed)
        made_here = True
    else:
        vector = run.env
    try:
        agent._check_spaces(vector, "the environment to evaluate in")
        check_scaled(agent, vector)
        again = None if made_here else seed  # others have just been made with it
        with lent(agent, vector, seeded=again is not None):
            return evaluate(policy(agent, deterministic), vector, episodes, threshold, again, seconds)
    finally:
        if made_here:
            vector.close()


def trained_on(agent: Agent) -> str | Callable[[], gym.Env]:
    """Returns what a loaded agent was trained on, as ``make_vector`` takes it.

    Raises:
        ValueError: if its file does not say, or if that is not registered here.
    """
    if agent._trained_on is None:
        raise ValueError("this agent has no environment; give one: evaluate(env=...)")
    env_id, env_kwargs = agent._trained_on
    if not register(env_id) and not envpool_knows(env_id):
        raise ValueError(
            f"this agent was trained on {env_id}, which is not registered here; import the module that registers it, or give "
            "an environment: evaluate(env=...)"
        )
    return maker(env_id, **env_kwargs) if env_kwargs else env_id


@contextmanager
def lent(agent: Agent, vector: VectorEnv, seeded: bool = False) -> Iterator[None]:
    """While entered, ``vector`` may be played in: if the agent trains on the same environments, its episodes are given up.

    Training goes on in new ones, whether it is under way or still to come; ``seeded`` says that the environments were seeded
    for the play, and gives them a seed of training again.
    """
    run = agent.run
    shared = run.env is not None and not identities(run.env).isdisjoint(identities(vector))
    if shared:
        run.obs = run.action = None  # also if playing fails
    yield
    if shared:
        if seeded:
            run.seed = int(np.random.SeedSequence([agent.seed, run.step]).generate_state(1)[0])
        agent._give_up_episodes()


def policy(agent: Agent, deterministic: bool) -> Callable[[Any, np.ndarray], np.ndarray]:
    """Returns the policy as :func:`rejeu.reporting.evaluation.evaluate` takes it; it remembers from call to call."""
    memory: Any = None

    def act(obs: Any, ended: np.ndarray) -> np.ndarray:
        nonlocal memory
        action, memory = predicting.act(agent, obs, deterministic, memory, ended)
        return action

    return act


def check_scaled(agent: Agent, vector: VectorEnv) -> None:
    """Raises ``ValueError`` if the agent learns from a ``VecNormalize`` and ``vector`` is none."""
    has_statistics = vector.venv is not None and unwrap_vec_normalize(vector.venv) is not None
    if agent.get_vec_normalize_env() is not None and not has_statistics:
        raise ValueError(
            "this agent learns in a VecNormalize, so it must be evaluated in one that has the same statistics; wrap the "
            "environment alike and use sync_envs_normalization, or let the agent scale: normalize=True"
        )
