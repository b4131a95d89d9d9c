"""Learning from recorded episodes without an environment."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core.algorithm import Clock, Transition, names
from rejeu.demonstrations import Demonstrations, keeping_policy, learn_offline, read, record
from rejeu.training.learner import Learner, Readings
from tests.every_agent import KINDS, Kind
from tests.sharing import shared_learners
from tests.test_demonstrations import SMALL, Anywhere, Target, by_hand, shown
from tests.tiers import exhaustive

pytestmark = pytest.mark.usefixtures("learners_are_shared")


@exhaustive
@pytest.mark.parametrize("name", ["IQL", "TD3BC", "ReBRAC"])
def test_offline_learning_improves_on_what_was_shown(name: str) -> None:
    """Random actions are recorded; cloning them would keep their mean, but their rewards say which were better."""
    env = Target()
    mixed = record(Anywhere(env), env, 400, seed=0)
    agent = getattr(rejeu, name)("MlpPolicy", env, learning_rate=3e-3, gamma=0.0, batch_size=256, **SMALL)
    learn_offline(agent, mixed, 1500)
    assert agent.evaluate(20, env=Target(), seed=0).mean_return > 0.4 * mixed.mean_return


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_next_actions_are_those_of_the_next_observation_in_the_same_episode(n_steps: int) -> None:
    env = Target()
    agent = rejeu.ReBRAC("MlpPolicy", env, n_critics=1, n_steps=n_steps, **SMALL)
    episodes = []
    for first, terminated in ((0.0, True), (10.0, False)):
        one = by_hand(3, terminated, first)
        actions = np.stack([one.observations[:-1, 0] / 10, np.zeros(3)], axis=1).astype(np.float32) * 4 + 2
        episodes.append(dataclasses.replace(one, actions=actions))
    replay = agent.replay_of(Demonstrations(tuple(episodes), env.observation_space, env.action_space), agent.run.env)
    batch = replay.sample(np.random.default_rng(0), (2, 50))
    x = batch.obs[..., 0]
    np.testing.assert_allclose(batch.action[..., 0], x / 10, atol=1e-6)
    after = batch.next_obs[..., 0]
    np.testing.assert_array_equal(after, np.minimum(x + n_steps, x // 10 * 10 + 3))
    expected = np.where(after % 10 == 3, np.nan, after / 10)
    np.testing.assert_allclose(batch.next_action[..., 0], expected, atol=1e-6)


@pytest.mark.parametrize(("name", "field"), [("TD3BC", "alpha"), ("ReBRAC", "actor_bc")])
def test_a_setting_that_depends_on_the_data_is_named_where_it_was_left_to_its_default(name: str, field: str) -> None:
    config = rejeu.AGENTS[name].algorithm.Config
    assert field in config().doubts(1)
    assert config(**{field: 0.1}).doubts(1) == ""


def test_the_target_network_of_q_learning_follows_the_updates() -> None:
    env, known = shown("Discrete", 2)
    networks = {}
    for updates in (100, 200):
        agent = rejeu.DQN("MlpPolicy", env, target_update_interval=100, batch_size=8, **SMALL)
        learn_offline(agent, known, updates)
        state = agent.learner.state(agent.run.state)
        networks[updates] = state.network, state.target_network
    assert eqx.tree_equal(networks[200][1], networks[100][0])
    assert not eqx.tree_equal(*networks[200])


def clocks_of(agent: rejeu.DQN) -> list[tuple[Any, Any]]:
    """Replaces the update by one that does nothing; returns a list of the batches and the clock of each call."""
    calls: list[tuple[Any, Any]] = []

    def update(state: Any, batches: Any, clock: Any) -> tuple[Any, Readings, None]:
        calls.append((batches, clock))
        return state, Readings((), np.zeros(1)), None

    agent.learner.update = update
    return calls


def test_every_gradient_step_without_an_environment_has_its_own_clock(tmp_path: Path) -> None:
    """Updates are made a hundred in one call; each counts, so that it is the same as one call for each."""
    pytest.importorskip("minari")
    env, known = Target("Discrete"), record(Anywhere(discrete := Target("Discrete")), discrete, 2, tmp_path, seed=0)
    rate = rejeu.Linear(1e-2, 1e-3)
    settings = {**SMALL, "target_update_interval": 7, "learning_rate": rate, "batch_size": 8, "tau": 0.3}
    agent, twin, run = (
        rejeu.DQN("MlpPolicy", env, **settings, **more)
        for more in ({}, {}, {"demonstrations": tmp_path, "offline": True})
    )
    calls, of_run = clocks_of(twin), clocks_of(run)
    learn_offline(twin, known, 130)
    run.learn(130)
    for found in (calls, of_run):
        for name, expected in (("step", np.arange(130)), ("progress", np.arange(130, dtype=np.float32) / 130)):
            parts = [np.atleast_1d(getattr(clock, name)) for _, clock in found]
            np.testing.assert_allclose(np.concatenate(parts), expected, rtol=1e-6)
    state, update = agent.learner.state(agent.run.state), jax.jit(agent.learner.algorithm.update)
    learn_offline(agent, known, 130)
    for i in range(130):
        batches = calls[i // 100][0]
        one = jax.tree.map(lambda leaf: leaf[i % 100], batches)  # noqa: B023
        state, _ = update(state, one, Clock(np.uint32(i), np.uint32(0), np.float32(i / 130)))
    for found, expected in zip(*map(jax.tree.leaves, (agent.learner.state(agent.run.state), state)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["TD3BC", "SAC"])
def test_the_statistics_of_normalization_are_those_of_the_data(name: str) -> None:
    """Each step counts once, its reward by the discounted sum up to it."""
    env = Target()
    known = record(Anywhere(env), env, 3, seed=0)
    with shared_learners():
        agent = getattr(rejeu, name)("MlpPolicy", env, normalize=True, gamma=0.5, **SMALL)
    clocks_of(agent)
    learn_offline(agent, known, 1)
    statistics = agent.learner.state(agent.run.state).statistics
    obs = np.concatenate([episode.observations[:-1] for episode in known.episodes])
    sums = [sum(0.5**k * one.rewards[i - k] for k in range(i + 1)) for one in known.episodes for i in range(len(one))]
    assert statistics.obs[0].n_seen == statistics.returns.n_seen == 15
    np.testing.assert_allclose(statistics.obs[0].mean, obs.mean(0), atol=1e-5)
    np.testing.assert_allclose(statistics.returns.mean, np.mean(sums), rtol=1e-5)


LEARNS = {
    *("critic", "critics", "target_critic", "target_critics", "critic_optimizer", "critics_optimizer"),
    *("value", "value_optimizer", "log_alpha", "alpha_optimizer", "n_updates", "actor_loss", "entropy"),
}
"""Fields of states that change while the policy is kept."""


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_a_kept_policy_keeps_its_target_and_its_optimizer(kind: Kind) -> None:
    """What is kept leaves the update as it came in, which the traced program says without running."""
    env = Target("Discrete" if kind.discrete else "Box")
    config = kind.agent.algorithm.Config(policy_kwargs={"net_arch": [4]})
    learner = Learner(kind.agent.algorithm.make(config, env.observation_space, env.action_space), None)
    agent = SimpleNamespace(learner=learner, name=kind.name)
    state = names(learner.shapes)
    if not any("critic" in name for name in state):
        with pytest.raises(ValueError, match="has no critics"):
            keeping_policy(agent)
        return
    action = jnp.zeros(4, jnp.int32) if kind.discrete else jnp.zeros((4, 2))
    batch = Transition(jnp.ones((4, 2)), action, jnp.ones(4), jnp.ones((4, 2)), jnp.ones(4))
    if getattr(config, "needs_next_action", False):
        batch = batch._replace(next_action=action)
    clock = Clock(np.uint32(0), np.uint32(0), np.float32(0))
    traced = jax.make_jaxpr(keeping_policy(agent).algorithm.update)(learner.shapes, batch, clock).jaxpr
    left = zip(state, traced.invars[: len(state)], traced.outvars[: len(state)], strict=True)
    changed = {name.split(".")[0] for name, before, after in left if before is not after}
    assert changed <= LEARNS
    assert changed & {"critic", "critics"}


class Untouched(Target):
    """Must not be stepped."""

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        raise AssertionError("an offline run steps no environment")


def test_an_offline_run_steps_no_environment_and_resumes_equal(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    record(Anywhere(env := Target()), env, 20, tmp_path / "shown", seed=0)
    settings: dict[str, Any] = {**SMALL, "demonstrations": tmp_path / "shown", "offline": True, "batch_size": 32}
    rows: list[int] = []
    table = SimpleNamespace(write=lambda step, row: rows.append(step), write_config=lambda c: None, in_background=False)
    with shared_learners():
        whole = rejeu.TD3BC("MlpPolicy", Untouched(), **settings).learn(2150, sinks=[table])
        stop = lambda agent, turn: turn.step < 300  # noqa: E731
        cut = rejeu.TD3BC("MlpPolicy", Untouched(), **settings)
        cut.learn(2150, [Checkpoint(tmp_path / "run", every=10_000), stop])
        resumed = rejeu.TD3BC.resume(tmp_path / "run", Untouched()).learn()
    assert cut.num_timesteps == 300
    assert whole.n_updates == whole.num_timesteps == resumed.num_timesteps == 2150
    assert rows == [1000, 2000]
    assert eqx.tree_equal(whole.learner.state(whole.run.state), resumed.learner.state(resumed.run.state))
    seen = np.concatenate([episode.observations[:-1] for episode in read(tmp_path / "shown").episodes])
    statistics = whole.learner.state(whole.run.state).statistics.obs[0]
    np.testing.assert_allclose(statistics.mean, seen.mean(0), atol=1e-5)
