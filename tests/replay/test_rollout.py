"""What a rollout buffer keeps, and what an agent puts into it."""

from types import SimpleNamespace

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms.actor_critic.config import ActorCriticConfig
from rejeu.algorithms.actor_critic.network import ActorCritic, action_kind
from rejeu.algorithms.actor_critic.steps import samples
from rejeu.core import spaces
from rejeu.core.algorithm import Rollout
from rejeu.envs.make import InProcess
from rejeu.replay.rollout import RolloutBuffer
from rejeu.training.learner import Readings
from tests.algorithms.test_gae import by_definition, random_steps
from tests.environments import Counter

pytestmark = pytest.mark.usefixtures("learners_are_shared")

GAMMA = 0.9

# Samples: a rollout with its values and log-probabilities.

OBS_LEAVES = spaces.leaves(gym.spaces.Box(-5.0, 5.0, (2,), np.float32))
SHAPE = ActorCriticConfig(net_arch=[4])


@pytest.fixture(scope="module")
def network():
    kind = action_kind(gym.spaces.Discrete(3))
    return ActorCritic(jax.random.PRNGKey(0), OBS_LEAVES, kind, SHAPE)


def value_by_hand(network, obs):
    (layer,) = network.value_torso.layers
    hidden = np.tanh(np.float64(obs) @ np.float64(layer.weight) + np.float64(layer.bias))
    return (hidden @ np.float64(network.value_head.weight) + np.float64(network.value_head.bias))[..., 0]


def random_rollout(n_steps, n_envs, valid, seed=0):
    rng = np.random.default_rng(seed)
    reward, _, _, discount, ended = random_steps((n_steps, n_envs), seed)
    obs, next_obs = rng.normal(size=(2, n_steps, n_envs, 2)).astype(np.float32)
    action = rng.integers(3, size=(n_steps, n_envs), dtype=np.int32)
    nothing = np.zeros((n_steps, n_envs), np.float32)
    return Rollout(obs, action, reward, next_obs, discount, ended, valid, nothing, np.ones(n_envs, bool), ())


def test_samples_hold_values_advantages_and_targets_of_every_step(network):
    rollout = random_rollout(5, 3, np.ones((5, 3), bool))
    data = samples(network, rollout, 0.8)
    value, next_value = value_by_hand(network, rollout.obs), value_by_hand(network, rollout.next_obs)
    expected = by_definition(rollout.reward, value, next_value, rollout.discount, rollout.ended, 0.8)
    np.testing.assert_allclose(data.advantage, expected.ravel(), atol=1e-5)
    np.testing.assert_allclose(data.value, value.ravel(), atol=1e-5)
    np.testing.assert_allclose(data.target, (expected + value).ravel(), atol=1e-5)
    np.testing.assert_array_equal(data.obs, rollout.obs.reshape(15, 2))
    np.testing.assert_array_equal(data.action, rollout.action.ravel())


def test_padding_leaks_into_no_sample(network):
    """The environments stop after 5, 3 and no steps; what stands behind must not be told apart from zeros."""
    valid = np.arange(5)[:, None] < [5, 3, 0]
    rollout = random_rollout(5, 3, valid)
    spoilt = [np.where(valid.reshape(5, 3, *[1] * (a.ndim - 2)), a, 1e4).astype(a.dtype) for a in rollout[:5]]
    clean = samples(network, rollout, 0.8)
    given = samples(network, rollout._replace(**dict(zip(Rollout._fields, spoilt, strict=False))), 0.8)
    keep = valid.ravel()
    for name in ("value", "advantage", "target"):
        np.testing.assert_array_equal(getattr(given, name)[keep], getattr(clean, name)[keep], err_msg=name)
    value, next_value = value_by_hand(network, rollout.obs), value_by_hand(network, rollout.next_obs)
    for env, n in enumerate([5, 3]):
        alone = [np.asarray(a)[:n, [env]] for a in (rollout.reward, value, next_value, rollout.discount, rollout.ended)]
        expected = by_definition(*alone, 0.8)[:, 0]
        np.testing.assert_allclose(given.advantage.reshape(5, 3)[:n, env], expected, atol=1e-5)


# The buffer.


def buffer_of(space, n_steps=4, n_envs=3, action_shape=(2,), action_dtype=np.float32):
    leaves, structure = spaces.leaves(space), spaces.structure(space)
    return RolloutBuffer(n_steps, n_envs, leaves, structure, action_shape, action_dtype, GAMMA)


NESTED = gym.spaces.Dict(
    {
        "z": gym.spaces.Tuple([gym.spaces.Discrete(3, start=5), gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)]),
        "a": gym.spaces.Box(-1.0, 1.0, (2,), np.float64),
        "m": gym.spaces.Dict({"bits": gym.spaces.MultiBinary(4), "many": gym.spaces.MultiDiscrete([2, 3])}),
    }
)
OBSERVATIONS = {
    "Box": gym.spaces.Box(-5.0, 5.0, (3,), np.float32),
    "image": gym.spaces.Box(0, 255, (8, 8, 3), np.uint8),
    "nested": NESTED,
}


def batch_of(space, n_envs):
    drawn = [spaces.plain(space, space.sample()) for _ in range(n_envs)]
    return spaces.cast(space, spaces.leaves(space), jax.tree.map(lambda *parts: np.stack(parts), *drawn))


def fill(buffer, space, n, seed=0):
    """Puts ``n`` steps in and returns what they were, one namespace a step."""
    space.seed(seed)
    rng, steps = np.random.default_rng(seed), []
    for _ in range(n):
        how = rng.integers(3, size=buffer.n_envs)
        step = SimpleNamespace(
            obs=batch_of(space, buffer.n_envs),
            action=rng.normal(size=buffer.action.shape[1:]).astype(buffer.action.dtype),
            reward=rng.normal(size=buffer.n_envs).astype(np.float32),
            terminated=how == 1,
            truncated=how == 2,
            next_obs=batch_of(space, buffer.n_envs),
        )
        buffer.observe(step.obs)
        buffer.add(step.action, step.reward, step.terminated, step.truncated, step.next_obs)
        steps.append(step)
    return steps


def assert_holds(rollout, steps):
    for t, step in enumerate(steps):
        for name in ("obs", "next_obs"):
            kept, put = getattr(rollout, name), getattr(step, name)
            assert jax.tree.structure(kept) == jax.tree.structure(put)
            for one, other in zip(jax.tree.leaves(kept), jax.tree.leaves(put), strict=True):
                assert one.dtype == other.dtype
                np.testing.assert_array_equal(one[t], other, err_msg=f"{name} of step {t}")
        np.testing.assert_array_equal(rollout.action[t], step.action)
        np.testing.assert_array_equal(rollout.reward[t], step.reward)
        np.testing.assert_array_equal(
            rollout.discount[t], np.float32([0.0 if end else GAMMA for end in step.terminated])
        )
        np.testing.assert_array_equal(
            rollout.ended[t], [a or b for a, b in zip(step.terminated, step.truncated, strict=True)]
        )


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_what_goes_into_the_buffer_comes_out(kind, n_envs):
    space = OBSERVATIONS[kind]
    buffer = buffer_of(space, n_envs=n_envs)
    buffer.begin((), np.ones(n_envs, bool))
    steps = fill(buffer, space, 4)
    assert buffer.full
    assert (buffer.length, buffer.size()) == (4, 4 * n_envs)
    rollout = buffer.rollout()
    assert_holds(rollout, steps)
    assert rollout.valid.all()
    assert rollout.started.all()
    assert rollout.reward.dtype == rollout.discount.dtype == np.float32


def test_a_new_rollout_has_nothing_of_the_one_before_in_it():
    space = OBSERVATIONS["Box"]
    buffer = buffer_of(space)
    buffer.begin((), np.ones(3, bool))
    fill(buffer, space, 4)
    started = np.array([True, False, True])
    buffer.begin((), started)
    started[:] = False
    assert (buffer.length, buffer.size(), buffer.full) == (0, 0, False)
    steps = fill(buffer, space, 2, seed=1)
    rollout = buffer.rollout()
    assert_holds(rollout, steps)
    np.testing.assert_array_equal(rollout.valid, np.arange(4)[:, None] < np.full(3, 2))
    np.testing.assert_array_equal(rollout.started, [True, False, True])


def test_only_the_steps_of_active_environments_count():
    space = OBSERVATIONS["Box"]
    buffer = buffer_of(space)
    buffer.begin((), np.ones(3, bool))
    fill(buffer, space, 1)
    none = np.zeros(3, bool)
    buffer.observe(batch_of(space, 3))
    buffer.add(np.zeros((3, 2)), np.zeros(3), none, none, batch_of(space, 3), valid=np.array([True, True, False]))
    assert (buffer.length, buffer.size()) == (2, 5)
    np.testing.assert_array_equal(buffer.rollout().valid[:2], [[True] * 3, [True, True, False]])


def test_an_environment_may_write_to_what_it_returned_without_changing_what_is_kept():
    buffer = buffer_of(OBSERVATIONS["Box"], n_envs=1)
    buffer.begin((), np.ones(1, bool))
    own, none = np.zeros((1, 3), np.float32), np.zeros(1, bool)
    reward, action = np.zeros(1, np.float32), np.zeros((1, 2), np.float32)
    for t in range(4):
        own[:] = t
        buffer.observe(own)
        own[:], reward[:], action[:] = t + 0.5, t, t
        buffer.add(action, reward, none, none, own)
    own[:] = reward[:] = action[:] = -1.0
    rollout = buffer.rollout()
    np.testing.assert_array_equal(rollout.obs[:, 0, 0], [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(rollout.next_obs[:, 0, 0], [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_array_equal(rollout.reward[:, 0], [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(rollout.action[:, 0, 0], [0.0, 1.0, 2.0, 3.0])


def steps_of(buffer, n):
    """The leaves of the first n steps of a rollout."""
    rollout = buffer.rollout()
    return [leaf[:n] for leaf in jax.tree.leaves(rollout._replace(started=()))]


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_arrays_put_back_give_the_same_rollout(kind):
    space = OBSERVATIONS[kind]
    buffer, other = buffer_of(space), buffer_of(space)
    for one, seed, n in ((buffer, 0, 3), (other, 1, 4)):
        one.begin((), np.ones(3, bool))
        fill(one, space, n, seed)
    arrays = {name: array.copy() for name, array in buffer.arrays().items()}
    assert {len(array) for array in arrays.values()} == {3}
    other.restore(arrays)
    assert (other.length, other.size(), other.full) == (3, 9, False)
    for one, two in zip(steps_of(buffer, 3), steps_of(other, 3), strict=True):
        np.testing.assert_array_equal(one, two)
    assert not other.rollout().valid[3].any()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda a: a.pop("reward"), r"differ in the arrays \['reward'\]"),
        (lambda a: a.update(extra=a["reward"]), r"differ in the arrays \['extra'\]"),
        (
            lambda a: a.update(action=a["action"][:, :, :1]),
            r"action in the file is float32\[3, 3, 1\], expected float32",
        ),
        (
            lambda a: a.update(reward=np.float64(a["reward"])),
            r"reward in the file is float64\[3, 3\], expected float32",
        ),
        (lambda a: a.update(ended=a["ended"][:2]), r"ended in the file is bool\[2, 3\], expected bool"),
        (lambda a: a.update({k: np.concatenate([v, v]) for k, v in a.items()}), r"\[6, .*at most \[4, "),
    ],
)
def test_arrays_that_do_not_fit_are_refused_and_change_nothing(spoil, message):
    space = OBSERVATIONS["Box"]
    buffer, other = buffer_of(space), buffer_of(space)
    for one, seed in ((buffer, 0), (other, 1)):
        one.begin((), np.ones(3, bool))
        fill(one, space, 3, seed)
    arrays = {name: array.copy() for name, array in other.arrays().items()}
    before = {name: array.copy() for name, array in buffer.arrays().items()}
    spoil(arrays)
    with pytest.raises(ValueError, match=message) as caught:
        buffer.restore(arrays)
    assert "\n" not in str(caught.value)
    assert buffer.length == 3
    for name, array in buffer.arrays().items():
        np.testing.assert_array_equal(array, before[name])


# What an agent's environments put into it.


def recorded(n_envs, total, lengths, ends, n_steps=4):
    """The rollouts that learning ``total`` steps hands to the update, copied, and the agent."""
    env = InProcess([Counter(lengths, ends) for _ in range(n_envs)], seed=0)
    agent = rejeu.A2C("MlpPolicy", env, n_steps=n_steps, gamma=GAMMA, seed=0, policy_kwargs={"net_arch": [4]})
    rollouts = []

    def update(state, rollout, clock):
        rollouts.append(jax.tree.map(np.copy, rollout))
        return state, Readings((), np.zeros(1)), None

    agent.learner.update = update
    return rollouts, agent.learn(total)


@pytest.mark.parametrize("ends", ["truncated", "terminated"])
def test_a_step_has_its_true_successor_whatever_ended_it(ends):
    """Episodes of 3 and 2 steps; ``Counter`` sees (episode, time, ...) and earns 100 episode + time."""
    (rollout,), _ = recorded(1, 6, (3, 2), ends, n_steps=6)
    np.testing.assert_array_equal(rollout.obs[:, 0, :2], [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [2, 0]])
    np.testing.assert_array_equal(rollout.next_obs[:, 0, :2], [[0, 1], [0, 2], [0, 3], [1, 1], [1, 2], [2, 1]])
    np.testing.assert_array_equal(rollout.reward[:, 0], [0, 1, 2, 100, 101, 200])
    np.testing.assert_array_equal(rollout.ended[:, 0], [False, False, True, False, True, False])
    last = np.float32(GAMMA if ends == "truncated" else 0.0)
    np.testing.assert_array_equal(rollout.discount[:, 0], np.float32([GAMMA, GAMMA, last, GAMMA, last, GAMMA]))


@pytest.mark.parametrize(("n_envs", "total", "n_rollouts"), [(1, 10, 3), (3, 24, 2), (8, 45, 2), (8, 3, 1)])
def test_the_number_of_steps_is_rounded_up_to_whole_rollouts(n_envs, total, n_rollouts):
    rollouts, agent = recorded(n_envs, total, (5,), "truncated")
    assert len(rollouts) == agent.n_updates == n_rollouts
    assert agent.num_timesteps == n_rollouts * 4 * n_envs
    assert all(rollout.valid.all() for rollout in rollouts)


def test_a_rollout_that_the_memory_cannot_hold_is_refused_with_the_numbers():
    """Linux would grant the memory, and end the process when it is used."""
    with pytest.raises(MemoryError, match=r"n_steps=20000000000000 takes [\d.]+ GiB .* try n_steps=\d+"):
        rejeu.PPO("MlpPolicy", "CartPole-v1", n_steps=2 * 10**13)
