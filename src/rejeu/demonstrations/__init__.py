"""Demonstrations: episodes that a person or an expert played, and how an agent learns from them.

They are read from and written to Minari datasets, such as ``rejeu play --record`` writes. An agent can imitate them
(:func:`clone`), ask the expert what to do where it came itself (:func:`dagger`), learn from them without an environment
(:func:`learn_offline`), and have a share of them in every batch while it trains (``demonstrations`` and
``demonstration_share`` of the off-policy algorithms).

Sources: Ross et al. 2011, "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning" (arXiv
1011.0686), for DAgger; Ball et al. 2023, "Efficient Online Reinforcement Learning with Offline Data" (arXiv 2302.02948), for
the share in every batch.
"""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnasium.envs.registration import EnvSpec

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.checkpoints.agent_state import AnyAgent
from rejeu.core import interrupt, spaces
from rejeu.core.algorithm import Algorithm, Clock, Metrics, PyTree, averaged_fields, names
from rejeu.core.errors import requires
from rejeu.core.types import Action, Observation
from rejeu.core.validation import as_path, number, whole
from rejeu.demonstrations import dataset
from rejeu.envs.masks import for_agent, split
from rejeu.envs.registry import make_env
from rejeu.logs.formatting import counted
from rejeu.networks.batch_renorm import in_training, is_normalized, with_statistics
from rejeu.networks.projected import projected
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.uniform import ReplayBuffer
from rejeu.training import finite
from rejeu.training.learner import Learner
from rejeu.training.off_policy import STEPS_OFFLINE, learn_from


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of ``T`` steps."""

    observations: Observation
    """As the environment gives them, each array with a leading axis of ``T + 1``."""
    actions: Action
    """In the range of the action space, ``(T, ...)``."""
    rewards: np.ndarray
    """``(T,)``."""
    terminated: bool
    """Whether it ended in a terminal state; else it was truncated."""
    is_labeled: bool = False
    """Whether the actions are an expert's answers, and others were taken: rewards and next observations follow from those."""
    name: str = "an episode"
    """In the dataset, for messages."""

    def __len__(self) -> int:
        return len(self.rewards)


@dataclass(frozen=True, eq=False, repr=False)
class Demonstrations:
    """Episodes of an environment with these spaces."""

    episodes: tuple[Episode, ...]
    observation_space: gym.Space
    action_space: gym.Space
    spec: EnvSpec | None = None
    """Of the environment, if a dataset says it; nothing that it names is imported."""

    @property
    def n_steps(self) -> int:
        """Number of steps of all episodes."""
        return sum(map(len, self.episodes))

    @property
    def mean_return(self) -> float:
        """Mean sum of rewards of an episode, NaN without episodes."""
        return float(np.mean([episode.rewards.sum() for episode in self.episodes])) if self.episodes else np.nan

    def __str__(self) -> str:
        n = counted(len(self.episodes), "episode")
        return f"{n}, {counted(self.n_steps, 'step')}, mean return {self.mean_return:,.2f}"

    def __repr__(self) -> str:
        return f"<Demonstrations: {self}>"

    def __add__(self, other: Demonstrations) -> Demonstrations:
        return dataclasses.replace(self, episodes=self.episodes + other.episodes)


def read(path: str | Path) -> Demonstrations:
    """Returns the episodes of a Minari dataset.

    Args:
        path: the folder of a dataset (it holds ``data``), or a folder that holds one dataset, such as
            ``rejeu play --record`` writes.

    Raises:
        FileNotFoundError: if there is no dataset.
        ValueError: if there are several, or the dataset has no step or is damaged.
        MissingExtra: if Minari is not installed.
    """
    with requires("reading demonstrations", "minari[hdf5]", "play"):
        import h5py  # noqa: F401
    path = as_path(path)
    files = (file for pattern in (dataset.METADATA, "*.hdf5") for file in path.rglob(pattern))
    folders = sorted({file.parent for file in files if file.parent.name == "data"})
    if not folders:
        raise FileNotFoundError(
            f"{path} holds no Minari dataset; give another folder (rejeu resume: --set demonstrations=FOLDER) or None, or "
            f"record one: rejeu play ENV --record {path}"
        )
    if len(folders) > 1:
        names = ", ".join(str(folder.parent.relative_to(path)) for folder in folders[:5])
        raise ValueError(f"{path} holds {len(folders)} datasets ({names}); give the folder of one of them")
    rows, observation_space, action_space, spec = dataset.read(folders[0])
    for name, _, _, *series in rows:
        check_end(path, name, *series)
    episodes = tuple(
        Episode(obs, actions, np.asarray(rewards, np.float32), bool(terminations[-1]), name=name)
        for name, obs, actions, rewards, terminations, _ in rows
        if len(rewards) and len(terminations)
    )
    if not episodes:
        raise ValueError(f"{path} holds no step; play at least one episode")
    return Demonstrations(episodes, observation_space, action_space, spec)


def check_end(path: Path, name: str, rewards: np.ndarray, terminations: np.ndarray, truncations: np.ndarray) -> None:
    """Raises ``ValueError`` if an episode of a dataset goes on after a step that ended it."""
    for ending, flags in (("terminations", terminations), ("truncations", truncations)):
        if np.any(flags[:-1]):
            raise ValueError(
                f"{name} of {path} has {ending} at step {np.argmax(flags)} of {len(rewards)}; an episode ends where one is "
                "true: record each episode by itself"
            )


def record(
    agent: AnyAgent, env: str | gym.Env, episodes: int, path: str | Path | None = None, seed: int | None = None
) -> Demonstrations:
    """Plays whole episodes with an agent, and returns them.

    Args:
        agent: anything with ``predict(obs, deterministic=True)``; a state that it returns is given back after ``obs``.
        env: an id, or an environment.
        episodes: number of episodes.
        path: new or empty folder for a Minari dataset of them; None writes none.
        seed: of the first episode; each further one adds 1. None draws one.

    Raises:
        FileExistsError: if the folder is not empty.
        TypeError: for several environments, or a function that makes one.
        MissingExtra: if Minari is needed and not installed.
    """
    from rejeu.demonstrations.recording import Recording

    with one_of(env) as game, ExitStack() as stack:
        recording = None if path is None else stack.enter_context(closing(Recording(path, game, None, "expert")))
        seeds = [None if seed is None else seed + i for i in range(whole("episodes", episodes, least=1))]
        played = [play(game, agent, lambda obs, action: action, start, recording)[0][0] for start in seeds]
    return Demonstrations(tuple(played), game.observation_space, game.action_space)


@contextmanager
def one_of(env: Any) -> Iterator[gym.Env]:
    """Yields the environment of an id, which is closed at the end, or the environment that was given.

    Raises:
        TypeError: for anything else.
    """
    if not isinstance(env, str | gym.Env):
        raise TypeError(f"env must be an id or one Gymnasium environment, got {type(env).__name__}")
    with closing(make_env(env)) if isinstance(env, str) else nullcontext(env) as game:
        yield game


def play(
    env: gym.Env,
    agent: AnyAgent,
    label: Callable[[Any, Any], Any],
    seed: int | None = None,
    recording: Any = None,
    takes_over: bool = False,
) -> tuple[list[Episode], int]:
    """Plays an episode with an agent, and returns what was labeled and the number of all steps.

    ``label(obs, action)`` are the actions of the result, and with ``takes_over`` also those that are taken. Steps for which it
    is None are left out; each stretch between them is an episode. Where actions of the result were not taken, it says so.
    """
    masked = for_agent(agent, env)
    plain = (lambda obs: obs) if masked is env else (lambda obs: split(obs, None)[0])
    agent_obs, _ = masked.reset(seed=seed)
    obs = plain(agent_obs)
    parts: list[list[tuple[Any, ...]]] = [[]]
    if recording is not None:
        recording.begin(obs, seed)
    memory: tuple[Any, ...] = ()
    n_steps, done = 0, False
    while not done:
        if (signal := interrupt.requested()) is not None:
            raise interrupt.Stopped(signal)
        action, state = agent.predict(agent_obs, *memory, deterministic=True)
        memory = () if state is None else (state,)
        labeled = label(obs, action)
        action = labeled if takes_over and labeled is not None else action
        is_labeled = labeled is not action
        before, labeled = jax.tree.map(np.copy, (obs, labeled))  # which may be written to again
        agent_obs, reward, terminated, truncated, _ = masked.step(action)
        obs = plain(agent_obs)
        if labeled is not None:
            parts[-1].append((before, labeled, float(reward), jax.tree.map(np.copy, obs), bool(terminated), is_labeled))
        elif parts[-1]:
            parts.append([])
        if recording is not None:
            recording.step(obs, action, float(reward), terminated, truncated)
        n_steps, done = n_steps + 1, terminated or truncated
    return [episode_of(steps) for steps in parts if steps], n_steps


def episode_of(steps: Sequence[tuple[Any, ...]]) -> Episode:
    """Returns successive steps ``(obs, action, reward, next_obs, terminated, is_labeled)`` as an episode."""
    obs, actions, rewards, following, terminated, is_labeled = zip(*steps, strict=True)
    stack = lambda parts: jax.tree.map(lambda *leaves: np.stack(leaves), *parts)  # noqa: E731
    obs = stack((*obs, following[-1]))
    return Episode(obs, stack(actions), np.asarray(rewards, np.float32), terminated[-1], any(is_labeled))


def clone(
    agent: AnyAgent,
    demonstrations: Demonstrations,
    updates: int = 2000,
    *,
    batch_size: int = 128,
    learning_rate: float = 1e-3,
    seed: int = 0,
    counted: int = 0,
) -> float:
    """Trains the policy of an agent to act as demonstrated (behavior cloning), and returns the loss of the last updates.

    The loss of continuous actions is the squared error of the deterministic action in [-1, 1], of other actions minus their
    log-probability. For DQN, QR-DQN, IQN and PQN, whose policy follows from values, it is
    ``max_a (Q(s, a) + m(a)) - Q(s, a*)`` for the demonstrated ``a*``, where the margin ``m`` is 0.8 except at ``a*`` (Hester
    et al. 2018, arXiv 1704.03732, equation 2).
    Critics learn nothing. Adam begins anew; the optimizers of the agent are not touched. Batch normalization and projection
    are as in training.

    Args:
        agent: any agent without a memory.
        demonstrations: with its spaces.
        updates: number of gradient steps.
        batch_size: steps in each batch, drawn with replacement.
        learning_rate: step size of Adam.
        seed: of the batches.
        counted: of how many episodes, the first ones, the agent's running statistics know already.

    Raises:
        ValueError: if the spaces differ, the agent has a memory, or numbers are not finite.
    """
    check(agent, demonstrations)
    algorithm = agent.learner.algorithm
    updates, batch_size = whole("updates", updates, least=1), whole("batch_size", batch_size, least=1)
    optimizer = optax.adam(number("learning_rate", learning_rate, above=0))
    pairs = [arrays_of(agent, episode) for episode in demonstrations.episodes]
    obs, action = jax.tree.map(lambda *parts: np.concatenate(parts), *pairs)
    state = seen(agent, demonstrations.episodes[whole("counted", counted, least=0) :])
    weights, static = eqx.partition(state, eqx.is_inexact_array)

    def loss(weights: PyTree, batch: tuple[PyTree, Any]) -> tuple[Any, PyTree]:
        actor = algorithm.actor(eqx.combine(weights, static))
        losses, updated = in_training(actor, lambda actor: imitation_loss(algorithm, actor, *batch))
        return jnp.mean(losses), eqx.filter(updated, eqx.is_inexact_array)

    def settled(weights: PyTree, updated: PyTree) -> PyTree:
        actor = algorithm.actor(weights)
        if not is_normalized(actor):
            return weights
        return eqx.tree_at(algorithm.actor, weights, projected(with_statistics(actor, updated)))

    @jax.jit
    def steps(weights: PyTree, moments: PyTree, batches: tuple[PyTree, Any]) -> tuple[PyTree, PyTree, Any]:
        def step(carry: tuple[PyTree, PyTree], batch: tuple[PyTree, Any]) -> tuple[tuple[PyTree, PyTree], Any]:
            (value, updated), gradients = jax.value_and_grad(loss, has_aux=True)(carry[0], batch)
            direction, moments = optimizer.update(gradients, carry[1])
            return (settled(optax.apply_updates(carry[0], direction), updated), moments), value

        carry, losses = jax.lax.scan(step, (weights, moments), batches)
        return *carry, jnp.mean(losses)

    rng, moments, value = np.random.default_rng(seed), optimizer.init(weights), 0.0
    for n in chunks(updates):
        index = rng.integers(len(action), size=(n, batch_size))
        weights, moments, value = steps(weights, moments, jax.tree.map(lambda leaf: leaf[index], (obs, action)))  # noqa: B023
        if interrupt.requested() is not None:
            break
    if not np.isfinite(value):
        raise ValueError(
            f"the loss is {value}, and the agent was not changed; try a learning_rate below {learning_rate}"
        )
    agent.run.state = agent.learner.pack(with_targets(eqx.combine(weights, static)))
    return float(value)


def imitation_loss(algorithm: Algorithm, actor: PyTree, obs: PyTree, action: Action) -> Any:
    """Returns the loss of an actor for demonstrated actions, ``(batch,)``; see :func:`clone`."""
    if algorithm.imitation is not None:
        return algorithm.imitation(actor, obs, action)
    return jnp.sum(jnp.square(algorithm.exploit(actor, obs) - action), axis=-1)


def dagger(
    agent: AnyAgent,
    expert: Callable[[Any], Any],
    env: str | gym.Env,
    demonstrations: Demonstrations | None = None,
    *,
    takes_over: bool = False,
    rounds: int = 10,
    steps: int = 500,
    updates: int = 1000,
    learning_rate: float = 1e-3,
    seed: int = 0,
    after_round: Callable[[int, Demonstrations], object] | None = None,
) -> Demonstrations:
    """Trains an agent to act as an expert in the states that it reaches itself (DAgger); returns all labeled episodes.

    In each round the agent acts, the expert says what it would have done, and the agent is cloned from all rounds. So it
    learns to come back from its own mistakes, which demonstrations do not show.

    The result is for :func:`clone`. Unless the expert takes over, rewards and next observations in it follow from the agent's
    actions, and :func:`learn_offline` and replay buffers refuse it.

    Args:
        agent: any agent without a memory.
        expert: returns the action for one observation, such as ``lambda obs: other.predict(obs)[0]``.
        env: an id, or an environment.
        demonstrations: what the agent is cloned from before the first round; without, the expert labels what an agent does
            that knows nothing.
        takes_over: whether the expert acts where it answers. Where it answers None, the agent acts, and nothing is learned
            from the step (HG-DAgger, Kelly et al. 2019, arXiv 1810.02890).
        rounds: how often.
        steps: least number of steps in each round; the last episode is completed.
        updates: gradient steps in each round.
        learning_rate: step size of Adam.
        seed: of the environment and the batches.
        after_round: called with the number of each round, 0 for the cloning before the first, and all labeled episodes.

    Raises:
        ValueError: if the spaces differ, or the agent has a memory.
    """
    steps = whole("steps", steps, least=1)
    say = after_round or (lambda i, demonstrations: None)
    with one_of(env) as game:
        if demonstrations is not None:
            clone(agent, demonstrations, updates, learning_rate=learning_rate, seed=seed)
            say(0, demonstrations)
        for i in range(whole("rounds", rounds, least=1)):
            played: list[Episode] = []
            n_steps = n_episodes = 0
            while n_steps < steps:
                start = seed + 1000 * (i + 1) + n_episodes
                labeled, length = play(game, agent, lambda obs, action: expert(obs), start, takes_over=takes_over)
                played, n_steps, n_episodes = played + labeled, n_steps + length, n_episodes + 1
            new = Demonstrations(tuple(played), game.observation_space, game.action_space)
            counted = 0 if demonstrations is None else len(demonstrations.episodes)
            demonstrations = new if demonstrations is None else demonstrations + new
            if not played:
                continue  # nobody took over
            clone(agent, demonstrations, updates, learning_rate=learning_rate, seed=seed + i + 1, counted=counted)
            say(i + 1, demonstrations)
    assert demonstrations is not None
    return demonstrations


def learn_offline(
    agent: Any, demonstrations: Demonstrations, updates: int, *, keep_policy: bool = False
) -> dict[str, float]:
    """Takes gradient steps of an algorithm on recorded episodes alone, and returns the metrics of the last of them.

    Algorithms made for it are :class:`rejeu.TD3BC` and :class:`rejeu.IQL`; others overestimate actions that were never taken.
    Hindsight replay and n-step returns work as in training. Ctrl-C ends it, and keeps what was learned.

    Args:
        agent: learns with its own settings; schedules follow the updates, and target networks that move after a number of
            environment steps count each update as one.
        demonstrations: with its spaces.
        updates: number of gradient steps.
        keep_policy: learn the values of the present policy, such as that of :func:`clone`, and leave it as it is, with its
            target and its optimizer. The temperature of SAC and its relatives learns as well.

    Raises:
        ValueError: if the spaces differ, the agent has no replay buffer, or the policy is to be kept and the agent has no
            critics apart from it.
        NonFiniteError: if an update leaves NaN or infinity.
    """
    check(agent, demonstrations)
    learner = keeping_policy(agent) if keep_policy else agent.learner
    if not isinstance(agent.config, OffPolicyConfig):
        raise ValueError(f"{agent.name} has no replay buffer to learn from; use IQL, TD3BC or ReBRAC, or clone it")
    run, updates = agent.run, whole("updates", updates, least=1)
    if run.env is None:
        raise ValueError("this agent has no environment, and so no replay buffer; give one to load(path, env=...)")
    if not run.n_updates and (doubt := agent.config.doubts(run.env.n_envs)):
        warnings.warn(doubt, UserWarning, stacklevel=2)
    replay, done = agent.replay_of(demonstrations, run.env), 0
    if not keep_policy:
        observe(agent, demonstrations)
    for n in chunks(updates):
        learn_from(run, learner, agent.config, replay, [(done + i) / updates for i in range(n)], done)
        done += n
        finite.settle(agent)
        if interrupt.requested() is not None:
            break
    return {name: float(value) for name, value in (run.metrics or {}).items()}


def keeping_policy(agent: AnyAgent) -> Learner:
    """Returns the functions of an agent with updates that leave its policy as it is; raises as :func:`learn_offline`."""
    algorithm = agent.learner.algorithm
    if not any("critic" in name for name in names(agent.learner.shapes)):
        raise ValueError(
            f"{agent.name} has no critics that could learn while its policy is kept; use SAC, TD3 or a relative of them"
        )

    def update(state: PyTree, batch: PyTree, clock: Clock) -> tuple[PyTree, Metrics]:
        new, metrics = algorithm.update(state, batch, clock)
        of_actor = ["actor" in name.removesuffix("actor_loss") for name in names(new)]  # also its target and moments
        is_kept = jax.tree.unflatten(jax.tree.structure(new), of_actor)
        new = jax.tree.map(lambda is_kept, old, new: old if is_kept else new, is_kept, state, new)
        return eqx.tree_at(algorithm.actor, new, algorithm.actor(state)), metrics

    return Learner(algorithm._replace(update=update), None, agent.learner.skips)


def chunks(updates: int) -> Iterable[int]:
    """Yields how many updates each call takes.

    >>> list(chunks(250))
    [100, 100, 50]
    """
    for first in range(0, updates, STEPS_OFFLINE):
        yield min(STEPS_OFFLINE, updates - first)


def check(agent: AnyAgent, demonstrations: Demonstrations) -> None:
    """Raises ``ValueError`` unless an agent can learn from demonstrations: these spaces, the bounds of observations aside."""
    if not isinstance(demonstrations, Demonstrations):
        raise TypeError(f"demonstrations={demonstrations!r} must be what read(FOLDER) or record(...) returns")
    agent.check_spaces(demonstrations, "the set of demonstrations")
    if isinstance(space := agent.action_space, gym.spaces.Dict | gym.spaces.Tuple):
        raise ValueError(f"demonstrations of the action space {space} cannot be learned from; flatten it in a wrapper")
    if agent.learner.algorithm.recall is not None:
        raise ValueError(
            f"{agent.name} has a memory, and demonstrations are single steps; use an algorithm without one"
        )
    if not demonstrations.n_steps:
        raise ValueError("the demonstrations hold no step; play at least one episode")
    for episode in demonstrations.episodes:
        if not all(
            np.isfinite(a).all() for a in jax.tree.leaves((episode.observations, episode.actions, episode.rewards))
        ):
            raise ValueError(f"{episode.name} has numbers that are NaN or infinite; record the demonstrations again")
        n, n_obs = len(episode), {len(leaf) for leaf in jax.tree.leaves(episode.observations)}
        if len(episode.actions) != n or n_obs != {n + 1}:
            raise ValueError(
                f"{episode.name} has {n} rewards, {len(episode.actions)} actions and {', '.join(map(str, sorted(n_obs)))} "
                "observations; it must have as many actions as rewards, and one observation more"
            )
        if not isinstance(space, gym.spaces.Box):  # actions beyond the bounds of a Box are what an expert wanted
            spaces.check_env_actions(space, np.asarray(episode.actions), episode.name)


def arrays_of(agent: AnyAgent, episode: Episode) -> tuple[PyTree, np.ndarray]:
    """Returns the observations of an episode that were acted on, and the actions in the algorithm's range."""
    obs = batch_of(agent, episode.observations, slice(0, len(episode)))
    return agent.with_masks(obs, None), spaces.unscale_action(agent.action_space, np.asarray(episode.actions))


def batch_of(agent: AnyAgent, observations: Observation, rows: slice) -> PyTree:
    """Returns some observations of an episode as a batch."""
    return spaces.as_batch(
        jax.tree.map(lambda leaf: np.asarray(leaf)[rows], observations), agent.observation_space, agent.obs_leaves
    )[0]


def observe(agent: Any, demonstrations: Demonstrations) -> None:
    """Adds demonstrations to the running statistics of an agent, if it has some."""
    if agent.learner.observe is not None:
        agent.run.state = agent.learner.pack(seen(agent, demonstrations.episodes))


def seen(agent: Any, episodes: Sequence[Episode]) -> PyTree:
    """Returns the state of an agent after its statistics, if it has some, have seen episodes."""
    state = agent.learner.state(agent.run.state)
    if agent.learner.observe is None or not episodes:
        return state
    obs = jax.tree.map(lambda *parts: np.concatenate(parts), *(arrays_of(agent, episode)[0] for episode in episodes))
    returns = np.concatenate([running_return(episode.rewards, agent.config.gamma) for episode in episodes])
    return agent.learner.algorithm.observe(state, obs, returns)


def running_return(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """Returns ``sum_k gamma^k r_{t-k}`` of the rewards of an episode, ``float32 (T,)``.

    >>> running_return(np.ones(3), 0.5).tolist()
    [1.0, 1.5, 1.75]
    """
    sums = itertools.accumulate(rewards.tolist(), lambda before, reward: gamma * before + reward)
    return np.fromiter(sums, np.float32, len(rewards))


def with_targets(state: PyTree) -> PyTree:
    """Returns a state whose target networks are copies of the networks that they follow."""
    is_state = lambda node: isinstance(node, eqx.Module) and bool(averaged_fields(type(node)))  # noqa: E731

    def copied(node: PyTree) -> Any:
        if not is_state(node):
            return node
        fields = {name for name in averaged_fields(type(node)) if getattr(node, name) is not None}
        return dataclasses.replace(node, **{name: getattr(node, name.removeprefix("target_")) for name in fields})

    return jax.tree.map(copied, state, is_leaf=is_state)


def fill(replay: Any, agent: AnyAgent, demonstrations: Demonstrations) -> None:
    """Adds the episodes to an empty replay buffer of one environment."""
    for episode in demonstrations.episodes:
        obs, action = arrays_of(agent, episode)
        last = agent.with_masks(batch_of(agent, episode.observations, slice(len(episode), None)), None)
        following = jax.tree.map(lambda a, b: np.concatenate([a[1:], b]), obs, last)
        replay.begin(jax.tree.map(lambda leaf: leaf[:1], obs))
        for i, reward in enumerate(episode.rewards):
            ends = np.array([episode.terminated and i == len(episode) - 1])
            after = jax.tree.map(lambda leaf: leaf[i : i + 1], following)  # noqa: B023
            replay.add(action[i : i + 1], np.array([reward]), ends, after)


class WithDemonstrations:
    """A replay buffer a share of whose batches is drawn from demonstrations; everything else is that of ``own``.

    Source: Ball et al. 2023 (arXiv 2302.02948), "symmetric sampling" with a share of one half.
    """

    def __init__(
        self, buffer: ReplayBuffer | HerReplayBuffer, demonstrations: ReplayBuffer | HerReplayBuffer, share: float
    ) -> None:
        self.own, self.demonstrations, self.share = buffer, demonstrations, share

    def __getattr__(self, name: str) -> Any:
        return getattr(self.own, name)

    def __repr__(self) -> str:
        n = self.demonstrations.size()
        return f"<{self.own!r} with {self.share:.0%} of each batch from {n:,} steps of demonstrations>"

    def set_gamma(self, gamma: float) -> None:
        """Sets the discount factor of both."""
        self.own.set_gamma(gamma)
        self.demonstrations.set_gamma(gamma)

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0) -> tuple[Any, Any]:
        """Returns a batch; the demonstrations are its last rows."""
        n = round(self.share * shape[-1])
        parts = [
            buffer.draw(rng, (*shape[:-1], size), progress)[0]
            for buffer, size in ((self.own, shape[-1] - n), (self.demonstrations, n))
            if size
        ]
        axis = len(shape) - 1
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=axis), *parts), None

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0) -> Any:
        """Returns the batch of :meth:`draw`."""
        return self.draw(rng, shape, progress)[0]
