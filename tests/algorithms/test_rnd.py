"""Random network distillation, as a setting of every algorithm."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import rnd
from rejeu.algorithms.config import RndConfig
from rejeu.callbacks import Checkpoint
from rejeu.core.algorithm import Algorithm, Clock, Rollout, Transition
from rejeu.core.spaces import leaves
from tests.every_agent import KINDS
from tests.helpers import assert_same_parameters, same_parameters
from tests.tiers import exhaustive, only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0))
ON = {"policy_kwargs": {"net_arch": [4]}, "n_steps": 16, "seed": 0}
OFF = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 20, "batch_size": 8, "buffer_size": 100, "seed": 0}
ENV = {True: "CartPole-v1", False: "Pendulum-v1"}


def seeing() -> Algorithm:
    """An algorithm whose state is the last rewards that it was given."""

    def update(state, batch, clock):
        return batch.reward, {}

    nothing = lambda *arguments: None  # noqa: E731
    return Algorithm(lambda key: jnp.zeros(6), lambda state: state, nothing, nothing, update)


def transitions(rng, n=6):
    obs, next_obs = rng.normal(3.0, 2.0, (2, n, 3)).astype(np.float32)
    return Transition(
        obs, np.zeros(n, np.int32), rng.normal(size=n).astype(np.float32), next_obs, np.ones(n, np.float32)
    )


def bonus(state, seen, everything, all_errors):
    """The bonus in NumPy: errors of standardized observations, over the deviation of all errors so far."""
    x = np.clip((seen - everything.mean(axis=0)) / np.sqrt(everything.var(axis=0) + 1e-8), -5, 5).astype(np.float32)
    error = np.square(np.asarray(state.predictor(x)) - np.asarray(state.target(x))).mean(axis=1)
    scale = np.sqrt(np.concatenate([*all_errors, error]).var() + 1e-8)
    return np.minimum(error / scale, 10.0), error


def test_the_bonus_is_the_error_over_its_running_deviation():
    rng = np.random.default_rng(0)
    config = RndConfig(coefficient=0.5, learning_rate=0.01)
    algorithm = rnd.with_rnd(seeing(), leaves(rejeu.make_vector("Pendulum-v1").observation_space), config)
    state, all_errors, everything = algorithm.init(jax.random.PRNGKey(0)), [], np.zeros((0, 3))
    update = jax.jit(algorithm.update)
    for _ in range(3):
        batch = transitions(rng)
        everything = np.concatenate([everything, batch.next_obs])
        expected, error = bonus(state, batch.next_obs, everything, all_errors)
        all_errors.append(error)
        before, (state, metrics) = state, update(state, batch, CLOCK)
        np.testing.assert_allclose(state.learner, batch.reward + 0.5 * expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(metrics["rnd_loss"], error.mean(), rtol=1e-5)
        for old, new in zip(jax.tree.leaves(before.target), jax.tree.leaves(state.target), strict=True):
            np.testing.assert_array_equal(old, new)


def test_of_a_rollout_only_the_steps_that_exist_count():
    rng, n = np.random.default_rng(1), 6
    flat = transitions(rng)
    grid = lambda x: np.asarray(x).reshape(3, 2, *np.shape(x)[1:])  # noqa: E731
    valid = np.array([[True, True], [True, True], [True, False]])
    next_obs = grid(flat.next_obs)
    next_obs[2, 1] = 1e6
    no = np.zeros((3, 2), bool)
    rest = (grid(np.zeros(n)), no[0], ())
    rollout = Rollout(
        grid(flat.obs), grid(flat.action), grid(flat.reward), next_obs, grid(flat.discount), no, valid, *rest
    )
    algorithm = rnd.with_rnd(
        seeing(), leaves(rejeu.make_vector("Pendulum-v1").observation_space), RndConfig(batch_size=2)
    )
    state = algorithm.init(jax.random.PRNGKey(0))
    seen = flat.next_obs[:5]
    expected, _ = bonus(state, seen, seen, [])
    after, _ = jax.jit(algorithm.update)(state, rollout, CLOCK)
    np.testing.assert_allclose(after.learner.reshape(-1)[:5], flat.reward[:5] + expected, rtol=1e-4, atol=1e-5)
    assert after.learner[2, 1] == flat.reward[5]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.predictor))
    assert float(after.moments.returns.n_seen) == 5


def test_the_error_shrinks_where_the_agent_has_been_and_not_elsewhere():
    rng = np.random.default_rng(2)
    algorithm = rnd.with_rnd(
        seeing(), leaves(rejeu.make_vector("Pendulum-v1").observation_space), RndConfig(learning_rate=1e-3)
    )
    state, update = algorithm.init(jax.random.PRNGKey(0)), jax.jit(algorithm.update)
    known, unknown = np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, 4.0]]], np.float32)  # the last number never varies
    before = [rnd.errors(state.predictor, state.target, x).mean() for x in (known, unknown)]
    for _ in range(300):
        near = rng.normal(0.0, 0.3, (6, 3)).astype(np.float32) * np.array([[1, 1, 0]], np.float32)
        state, _ = update(state, transitions(rng)._replace(next_obs=near), CLOCK)
    after = [rnd.errors(state.predictor, state.target, x).mean() for x in (known, unknown)]
    assert after[0] < 0.05 * before[0]
    assert after[1] > 0.2 * before[1]


@pytest.mark.parametrize("name", only((), KINDS))
def test_every_off_policy_algorithm_takes_it(name, tmp_path):
    kind = KINDS[name]
    make = lambda **more: rejeu.AGENTS[kind.name]("MlpPolicy", ENV[kind.discrete], **OFF, **more)  # noqa: E731
    check(make, tmp_path)


@pytest.mark.parametrize("name", only(("PPO",), ["PPO", "A2C", "TRPO", "PQN", "ARS", "RecurrentPPO", "MaskablePPO"]))
def test_every_on_policy_algorithm_takes_it(name, tmp_path):
    if name == "MaskablePPO":
        from tests.worker_environments import Rules

        check(lambda **more: rejeu.MaskablePPO("MlpPolicy", Rules(), **ON, **more), tmp_path)
        return
    settings = {"n_steps": 16, "n_delta": 1, "seed": 0} if name == "ARS" else ON
    check(lambda **more: rejeu.AGENTS[name]("MlpPolicy", "CartPole-v1", **settings, **more), tmp_path)


@exhaustive
def test_it_goes_with_memory_and_masks(tmp_path):
    from tests.worker_environments import Rules

    memory = {"net_arch": [4], "lstm_hidden_size": 4, "sequence_length": 4, "burn_in": 2}
    settings = {**OFF, "policy_kwargs": memory, "action_masks": True, "rnd": 0.5}
    env = Rules()
    agent = rejeu.DQN("MlpPolicy", env, **settings).learn(80)
    assert env.taken == 80
    assert float(agent.run.metrics["rnd_bonus"]) > 0
    assert_same_parameters(agent, rejeu.load(agent.save(tmp_path / "model")))


def check(make, tmp_path):
    agent = make(rnd=0.5, normalize={"norm_reward": False}).learn(70)
    assert {"rnd_bonus", "rnd_loss"} <= {*agent.run.metrics}
    assert_same_parameters(agent, make(rnd={"coefficient": 0.5}, normalize={"norm_reward": False}).learn(70))
    loaded = rejeu.load(agent.save(tmp_path / "model"))
    assert loaded.config.rnd == RndConfig(coefficient=0.5)
    assert_same_parameters(agent, loaded)
    obs = np.tile(agent.observation_space.sample(), (5, 1)).astype(np.float32)
    one, other = (a.predict(obs, deterministic=True)[0] for a in (agent, loaded))
    np.testing.assert_array_equal(one, other)
    if not agent.learner.algorithm.recall:
        numpy_policy = rejeu.load_policy(tmp_path / "model")
        np.testing.assert_allclose(numpy_policy.predict(obs)[0], one, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", only(["PPO"], ["DQN", "PPO"]))
def test_a_run_that_is_cut_off_goes_on_as_if_it_had_not_been(name, tmp_path):
    settings = OFF if name == "DQN" else ON
    make = lambda: rejeu.AGENTS[name]("MlpPolicy", gym.make("CartPole-v1"), rnd=0.5, **settings)  # noqa: E731
    whole = make().learn(120)
    make().learn(120, [lambda agent, turn: turn.step < 61, Checkpoint(tmp_path, every=1000)])
    again = rejeu.AGENTS[name].resume(tmp_path, gym.make("CartPole-v1"))
    assert again.resumed.exact
    assert_same_parameters(whole, again.learn())
    assert {"predictor", "target", "moments"} <= {key.split(".")[0] for key in again.get_parameters()}


@exhaustive
@pytest.mark.parametrize("name", only(["PPO"], ["DQN", "PPO"]))
def test_it_trains_on_the_device(name):
    settings = OFF if name == "DQN" else ON
    make = lambda: rejeu.AGENTS[name]("MlpPolicy", rejeu.make_vector("jax/CartPole-v1", 2, seed=0), rnd=1.0, **settings)  # noqa: E731
    agents = []
    for on_device in (True, False):
        agent = make()
        agent.on_device = on_device
        agents.append(agent.learn(96))
    if name == "PPO":  # which draws no batches
        for one, other in zip(*(a.get_parameters().values() for a in agents), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)
    assert np.isfinite(float(agents[0].run.metrics["rnd_bonus"]))


def test_no_weight_means_none_and_other_values_are_refused():
    make = lambda value: rejeu.DQN("MlpPolicy", "CartPole-v1", rnd=value, **OFF)  # noqa: E731
    assert make(0).config.rnd is None
    assert same_parameters(make(0), make(None))
    with pytest.raises(ValueError, match="coefficient=-1"):
        make(-1)
    with pytest.raises((TypeError, ValueError), match="rnd"):
        make("much")
