"""What holds for every algorithm on every kind of action: counting, repeating, saving, targets, dtypes, batches of one."""

from __future__ import annotations

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import Probe
from tests.every_agent import KINDS, LEARNING, env_of, small
from tests.helpers import assert_same_parameters, same_parameters
from tests.sharing import shared_learners
from tests.tiers import crossed, only

every_algorithm = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
OBS = np.linspace(-1.0, 1.0, 7, dtype=np.float32)[:, None]


class Wanderer(Probe):
    """Sees a new random number at every step and earns it; episodes of 5 steps."""

    length = 5
    ends = "truncated"

    def see(self):
        return self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32)

    def earn(self, action):
        return float(self.np_random.uniform(-1.0, 1.0)) + action


def wanderers(kind, n_envs):
    return InProcess([env_of(kind, Wanderer()) for _ in range(n_envs)])


def networks(agent):
    """The names of what is learnt by gradient or follows it, with their arrays: ``{"actor": {...}, ...}``."""
    found = {}
    for name, array in agent.get_parameters().items():
        part, _, rest = name.partition(".")
        if "optimizer" not in part and array.dtype == np.float32 and (rest or part == "log_alpha"):
            found.setdefault(part, {})[rest] = array
    return found


def changed(before, after):
    return {
        part: any((array != after[part][name]).any() for name, array in arrays.items())
        for part, arrays in before.items()
    }


@pytest.mark.parametrize(("name", "n_envs"), crossed(list(KINDS), [1, 3, 8]))
def test_the_steps_asked_for_are_taken_and_as_many_updates_as_they_owe(name, n_envs):
    """45 steps, of which 29 are learned from, once every 8."""
    kind = KINDS[name]
    agent = small(kind, wanderers(kind, n_envs), learning_starts=16, train_freq=8).learn(45)
    assert agent.num_timesteps == agent.replay_buffer.size() == 45
    assert agent.n_updates == int(getattr(agent.state, "n_updates", 3)) == 3  # IQL draws nothing by it
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())


@every_algorithm
def test_two_runs_with_one_seed_are_the_same_to_the_last_bit_and_another_seed_differs(kind):
    def run(seed):
        env = wanderers(kind, 1)
        return small(kind, env, learning_starts=16, seed=seed).learn(40)

    one, again, other = run(3), run(3), run(4)
    assert one.n_updates == 24
    assert_same_parameters(one, again)
    for name, array in one.replay_buffer.arrays().items():
        np.testing.assert_array_equal(array, again.replay_buffer.arrays()[name], err_msg=name)
    np.testing.assert_array_equal(one.history["return"], again.history["return"])
    np.testing.assert_array_equal(one.predict(OBS)[0], again.predict(OBS)[0])
    assert not same_parameters(one, other)
    assert (one.replay_buffer.arrays()["action"] != other.replay_buffer.arrays()["action"]).any()


@every_algorithm
def test_a_loaded_agent_predicts_the_same_bits_and_goes_on_learning_all_its_parts(kind, tmp_path):
    """Stable-Baselines3 1.1.0 mended a temperature that was no longer learnt after loading."""
    agent = small(kind, wanderers(kind, 1), learning_starts=16).learn(20)
    with shared_learners():
        loaded = rejeu.load(agent.save(tmp_path / "model"), env=wanderers(kind, 1), learning_starts=32)
    assert type(loaded) is kind.agent
    assert_same_parameters(agent, loaded)
    assert loaded.config.action_noise == agent.config.action_noise
    np.testing.assert_array_equal(loaded.predict(OBS, deterministic=True)[0], agent.predict(OBS, deterministic=True)[0])

    before = networks(loaded)
    loaded.learn(32)
    assert loaded.n_updates == agent.n_updates == 4
    assert not any(changed(before, networks(loaded)).values())
    loaded.learn(kind.delay)
    assert loaded.n_updates == 4 + kind.delay
    assert ("log_alpha" in before) == kind.has_temperature
    assert changed(before, networks(loaded)) == dict.fromkeys(before, True)


@every_algorithm
def test_targets_start_as_copies_and_move_by_themselves(kind):
    """Their first moves are each the share tau of how far the networks are from where both began, and no more."""
    agent = small(kind, wanderers(kind, 1), learning_starts=16)
    before = networks(agent)
    followed = {part: part.removeprefix("target_") for part in before if part.startswith("target_")}
    assert bool(followed) == kind.has_targets
    for target, online in followed.items():
        for name, array in before[target].items():
            np.testing.assert_array_equal(array, before[online][name], err_msg=f"{target}.{name}")

    after = networks(agent.learn(16 + 2 * kind.delay))
    moved = {
        part: max(np.abs(after[part][name] - array).max() for name, array in arrays.items())
        for part, arrays in before.items()
    }
    for target, online in followed.items():
        assert moved[online] > 1e-3
        assert 0 < moved[target] < (2 + kind.delay) * LEARNING["tau"] * moved[online]


@pytest.mark.parametrize("kind", [KINDS[name] for name in ("DQN", "QRDQN", "IQN")], ids=("DQN", "QRDQN", "IQN"))
def test_a_step_of_several_environments_moves_the_target_once(kind):
    """As in Stable-Baselines3, whose interval of 1 is one step of the vector environment, which is 4 steps here."""
    one, four = (
        small(kind, wanderers(kind, 4), learning_starts=16, train_freq=8, target_update_interval=n).learn(64)
        for n in (1, 4)
    )
    assert one.n_updates == 6
    assert_same_parameters(one, four)


@every_algorithm
def test_critics_start_different_and_targets_share_no_memory_with_the_networks(kind):
    """Equal targets in the same memory would be overwritten when the state is donated to an update."""
    env, algorithm = env_of(kind), kind.agent.algorithm
    config = algorithm.Config(policy_kwargs={"net_arch": [4]})
    state = algorithm.make(config, env.observation_space, env.action_space).init(jax.random.PRNGKey(1))
    pointers = lambda tree: {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(tree)}  # noqa: E731
    targets = [name for name in vars(state) if name.startswith("target_")]
    assert bool(targets) == kind.has_targets
    for name in targets:
        online, target = getattr(state, name.removeprefix("target_")), getattr(state, name)
        jax.tree.map(np.testing.assert_array_equal, online, target)
        assert not pointers(online) & pointers(target)
    if hasattr(state, "critics"):
        first, second = np.asarray(state.critics.head.weight)
        assert (first != second).any()


class Precise(Wanderer):
    """Has bounds that float32 cannot write, and refuses actions of another dtype or beyond them."""

    action_space = gym.spaces.Box(-0.1, 0.3, (1,), np.float64)

    def step(self, action):
        assert action.dtype == np.float64
        assert self.action_space.contains(action), action
        return super().step(action)


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if not kind.discrete])
def test_float64_actions_reach_the_environment_as_such_within_their_bounds(name):
    """Stable-Baselines3 2.1.0 mended float64 Box actions."""
    agent = small(KINDS[name], Precise(), learning_starts=16).learn(24)
    assert agent.n_updates == 8
    assert agent.replay_buffer.arrays()["action"].dtype == np.float32
    assert_precise(agent)


def test_an_agent_of_float64_actions_goes_on_after_loading(tmp_path):
    kind = KINDS["SAC"]
    path = small(kind, Precise()).save(tmp_path / "model")
    with shared_learners():
        loaded = rejeu.load(path, env=Precise(), learning_starts=4)
        assert_precise(rejeu.load(path))
    assert_precise(loaded.learn(6))


def assert_precise(agent):
    action, _ = agent.predict(1e6 * OBS)
    assert action.dtype == np.float64
    assert all(Precise.action_space.contains(one) for one in action)


@pytest.mark.parametrize("kind", only([KINDS["SAC"], KINDS["CrossQ"], KINDS["DQN"]], KINDS.values()), ids=KINDS)
def test_batches_of_one_transition_are_learnt_from(kind):
    agent = small(kind, wanderers(kind, 1), learning_starts=16, batch_size=1)
    before = networks(agent)
    agent.learn(16 + 2 * kind.delay)
    assert agent.n_updates == 2 * kind.delay
    assert changed(before, networks(agent)) == dict.fromkeys(before, True)
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())
    assert all(np.isfinite(value) for key, value in agent.statistics().items() if key.startswith("train/"))
