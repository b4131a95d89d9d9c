"""The policy of an agent: its names, its actions and values for observations, and whole episodes played with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.checkpoints.agent_state import AnyAgent
from rejeu.core import devices, spaces
from rejeu.core.types import Action, Observation, PyTree
from rejeu.core.validation import choice
from rejeu.envs.envpool import envpool_knows
from rejeu.envs.make import VectorEnv
from rejeu.envs.masks import split
from rejeu.envs.registry import maker, register
from rejeu.training import finite
from rejeu.training.run import clock_of

CRITICS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "min": lambda values: values.min(axis=0),
    "mean": lambda values: values.mean(axis=0),
    "all": lambda values: values,
}
"""How :func:`q_values` reduces the values of several critics, ``(n_critics, ...)``."""


class Held(NamedTuple):
    """The state of a policy that holds its actions (``action_repeat``)."""

    action: Action
    """In the algorithm's range, ``(batch, ...)``."""
    steps_left: np.ndarray
    """For how many more steps, ``int (batch,)``."""
    memory: PyTree
    """The state of a recurrent policy, else None."""


def act(
    agent: AnyAgent, obs: Observation, deterministic: bool, memory: PyTree, ended: np.ndarray
) -> tuple[np.ndarray, PyTree]:
    """Returns actions in the algorithm's range, and the next state of a policy that is recurrent or holds actions, else None.

    The arguments are those of :func:`decide`.
    """
    repeat = agent.config.action_repeat
    if repeat == 1:
        return decide(agent, obs, deterministic, memory, ended)
    held = Held(None, np.zeros(len(ended), int), None) if memory is None else memory
    if not isinstance(held, Held) or len(held.steps_left) != len(ended):
        raise ValueError(
            f"a policy with action_repeat={repeat} was given a state that is not of {len(ended)} episodes; give what its last "
            "call returned for as many observations, or None where episodes begin"
        )
    due = ended | (held.steps_left == 0)
    if due.any():
        chosen = decide(agent, obs, deterministic, held.memory, ended)
        where_due = lambda new, old: np.where(due.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)  # noqa: E731
        action, following = chosen if memory is None else jax.tree.map(where_due, chosen, (held.action, held.memory))
        held = Held(action, np.where(due, repeat, held.steps_left), following)
    return held.action, held._replace(steps_left=held.steps_left - 1)


def decide(
    agent: AnyAgent, obs: Observation, deterministic: bool, memory: PyTree, ended: np.ndarray
) -> tuple[np.ndarray, PyTree]:
    """Returns actions in the algorithm's range, and the next state of a recurrent policy, else None.

    Args:
        agent: the agent; its pending updates are waited for.
        obs: a batch of observations from :func:`as_batch`.
        deterministic: return the mode of the policy; False samples from it, without the noise of training.
        memory: the state of a recurrent policy from the last call; None at the start of episodes.
        ended: whether an episode starts with these observations, ``bool (batch,)``.

    Raises:
        ValueError: if the shapes of ``memory`` do not match.
    """
    finite.settle(agent)
    run, learner, n = agent.run, agent.learner, len(ended)
    has_memory = learner.algorithm.recall is not None
    if deterministic and not has_memory:
        return np.asarray(learner.exploit(run.state, obs)), None
    memory = memory_of(agent, memory, n)
    if deterministic:
        action, memory = learner.recall(run.state, memory, obs, ended)
        return np.asarray(action), memory
    clock = clock_of(run, 1.0)._replace(step=np.uint32(2**32 - 1 - agent.n_predictions % 2**31))
    agent.n_predictions += 1
    action, memory = learner.sample(run.state, memory, obs, ended, run.key, clock)
    return np.asarray(action), memory if has_memory else None


def q_values(
    agent: AnyAgent, observation: Observation, action: Action = None, critics: Literal["min", "mean", "all"] = "min"
) -> np.ndarray:
    """Returns the critics' values of actions, that is, the expected discounted return, as ``float32``.

    With ``normalize``, observations are scaled as in training; if rewards are scaled, so are the values. Those of SAC, TQC
    and CrossQ include the entropy of future actions. The online networks are used, not the targets. PQN has one network.

    Args:
        agent: the agent, of which this is a method.
        observation: one of the environment's space, or a batch of them with a leading axis.
        action: one for each observation, in the environment's own range. None: all Discrete actions.
        critics: with several, the ``"min"`` of their values, as in TD targets, their ``"mean"``, or ``"all"``. The value of
            a critic of TQC or QR-DQN is the mean of its quantiles.

    Returns:
        ``(batch,)``, or ``(batch, n_actions)`` without ``action``. There is no batch axis if the observation has none. With
        ``"all"`` the first axis is that of the critics.

    Raises:
        ValueError: if observations or actions are not in their spaces, or actions are missing.

    >>> import gymnasium as gym, rejeu
    >>> agent = rejeu.DDPG("MlpPolicy", gym.make("Pendulum-v1"), seed=0)
    >>> obs = np.zeros((50, 3), np.float32)
    >>> agent.q_values(obs, np.ones((50, 1))).shape, agent.q_values(obs[0], [1.0]).shape
    ((50,), ())
    >>> agent = rejeu.PQN("MlpPolicy", gym.make("CartPole-v1"), seed=0)
    >>> agent.q_values(np.zeros((50, 4), np.float32)).shape
    (50, 2)
    """
    choice("critics", critics, CRITICS)
    if agent.learner.algorithm.action_values is None:
        raise ValueError(
            f"{agent.name}.q_values has no critics, or their values depend on a memory of observations before, or the actions "
            "are a Dict or Tuple"
        )
    observation = split(observation, None)[0] if agent.takes_masks else observation
    obs, single = spaces.as_batch(observation, agent.observation_space, agent.obs_leaves)
    n = len(jax.tree.leaves(obs)[0])
    space = agent.action_space
    is_discrete = isinstance(space, gym.spaces.Discrete)
    if action is None and not is_discrete:
        raise ValueError(f"q_values needs actions of {space}; only for Discrete actions it returns the values of all")
    actions = None if action is None else _actions(space, action, single, n)
    with devices.chosen(agent.identity.device):
        finite.settle(agent)
        values = np.asarray(agent.learner.action_values(agent.run.state, obs, None if is_discrete else actions))
    if is_discrete and actions is not None:
        values = values[:, np.arange(n), actions]
    if single:
        values = values[:, 0]
    return CRITICS[critics](values)


def _actions(space: gym.Space, action: Action, single: bool, n: int) -> np.ndarray:
    """Returns a batch of Box or Discrete actions in the algorithm's range.

    Raises:
        ValueError: if their number is not that of the observations, or they are not in the space.
    """
    array = np.asarray(action)
    expected = space.shape if single else (n, *(space.shape or ()))
    if array.shape != expected:
        raise ValueError(f"the actions have the shape {array.shape}, expected {expected}: one for each observation")
    array = array[None] if single else array
    if isinstance(space, gym.spaces.Discrete):
        spaces.check_env_actions(space, array, "q_values")
    elif not np.isfinite(array).all():
        raise ValueError("q_values has actions that are not finite")
    return spaces.unscale_action(space, array)


def memory_of(agent: AnyAgent, memory: PyTree, n: int) -> Any:
    """Returns the state of the agent's policy for ``n`` episodes: what was given, else that at their start.

    Raises:
        ValueError: if the shapes of ``memory`` are others.
    """
    if memory is None or agent.learner.algorithm.recall is None:
        return agent.learner.initial_memory(n)
    shapes = jax.tree.map(np.shape, memory)
    expected = jax.tree.map(lambda x: (n, *x.shape[1:]), agent.learner.memory_shapes)
    if shapes != expected:
        raise ValueError(
            f"{agent.name}.predict was given a state of the shapes {shapes}, expected {expected}; give what its last call "
            "returned for as many observations, or None where episodes begin"
        )
    return memory


USUAL_EPISODES = 100
"""Number of episodes if neither a number nor a time is given."""
MOST_ENVS = 16
"""Upper limit on the environments that are made for an evaluation."""


def trained_on(agent: AnyAgent) -> str | Callable[[], gym.Env]:
    """Returns the environment that a loaded agent was trained on, as an id or a function that makes it.

    Raises:
        ValueError: if its file does not name it, or it is not registered.
    """
    if agent.identity.trained_on is None:
        raise ValueError("this agent has no environment; give one: evaluate(env=...)")
    env_id, env_kwargs = agent.identity.trained_on
    if not register(env_id) and not envpool_knows(env_id):
        raise ValueError(
            f"this agent was trained on {env_id}, which is not registered here; import the module that registers it, or give "
            "an environment: evaluate(env=...)"
        )
    return maker(env_id, **env_kwargs) if env_kwargs else env_id


@contextmanager
def evaluation_env(
    agent: AnyAgent, env: Any, episodes: int | None, seed: int | None
) -> Iterator[tuple[VectorEnv, int | None]]:
    """Context in which episodes may be played; returns the environments, and the seed that they must still be given.

    The arguments are those of :meth:`Agent.evaluate`. Environments that are made here are closed at the end.

    Raises:
        ValueError: if there are no environments, or their spaces or a missing ``VecNormalize`` do not match.
    """
    run = agent.run
    n_envs = MOST_ENVS if episodes is None else min(episodes, MOST_ENVS)
    has_none = env is None and (run.env is None or agent.identity.made_from_id)
    made_here = isinstance(env, str) or callable(env) or has_none
    if env is not None:
        vector = agent.make_envs(env, n_envs if isinstance(env, str) else 1, seed=seed)
    elif run.env is None:
        vector = agent.make_envs(trained_on(agent), n_envs, seed=seed)
    elif agent.identity.made_from_id:
        vector = agent.make_envs(run.env.env_id, n_envs, run.env.backend, seed)
    else:
        vector = run.env
    try:
        agent.check_spaces(vector, "the environment to evaluate in")
        check_scaled(agent, vector)
        again = None if made_here else seed  # new environments have this seed already
        with lent(agent, vector, seeded=again is not None):
            yield vector, again
    finally:
        if made_here:
            vector.close()


@contextmanager
def lent(agent: AnyAgent, vector: VectorEnv, seeded: bool = False) -> Iterator[None]:
    """Context in which episodes may be played in ``vector``, which may share environments with the agent's own.

    If it does, the running episodes of training are abandoned, and training continues in new ones. If the environments
    were ``seeded`` for the evaluation, they get a new seed for training.
    """
    run = agent.run
    shared = run.env is not None and not run.env.identities().isdisjoint(vector.identities())
    if shared:
        run.obs = run.action = None  # even if the evaluation fails
    yield
    if shared:
        if seeded:
            run.seed = int(np.random.SeedSequence([agent.identity.seed, run.step]).generate_state(1)[0])
        agent.abandon_episodes()


def policy(agent: AnyAgent, deterministic: bool) -> Callable[[Any, np.ndarray], np.ndarray]:
    """Returns the policy as a function for :func:`rejeu.logs.evaluation.evaluate`, which keeps a recurrent state."""
    memory: Any = None

    def choose(obs: Observation, ended: np.ndarray) -> np.ndarray:
        nonlocal memory
        action, memory = act(agent, obs, deterministic, memory, ended)
        return action

    return choose


def check_scaled(agent: AnyAgent, vector: VectorEnv) -> None:
    """Raises ``ValueError`` if the agent trains in a ``VecNormalize`` and ``vector`` has none."""
    if agent.get_vec_normalize_env() is not None and vector.vec_normalize is None:
        raise ValueError(
            "this agent learns in a VecNormalize, so it must be evaluated in one that has the same statistics; wrap the "
            "environment alike and use sync_envs_normalization, or let the agent scale: normalize=True"
        )
