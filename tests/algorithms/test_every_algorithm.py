"""What holds for every algorithm on every kind of action: counting, repeating, learning in parts, saving, targets, dtypes."""

import os
import signal

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests import every_agent, on_policy_agents
from tests.algorithms.probes.environments import Probe
from tests.environments import Sampled
from tests.every_agent import LEARNING, env_of
from tests.helpers import assert_same_parameters, same_parameters
from tests.sharing import forget_learners, shared_learners
from tests.tiers import only

OFF, ON = every_agent.KINDS, on_policy_agents.KINDS
ALL = OFF | ON
SAMPLE = ("SAC", "CrossQ", "DQN", "PPO, MultiDiscrete", "A2C, Box")
"""A path of their own through networks and loops have these, which run by default."""


def kinds(names, among=ALL):
    """Runs a test for kinds of these names by default, and in the exhaustive tier for all others."""
    return pytest.mark.parametrize("kind", only([ALL[name] for name in names], among.values()), ids=list(among))


every_kind, every_off_policy = kinds(SAMPLE), every_agent.every_kind
every_on_policy = kinds(["PPO, MultiDiscrete"], {name: ON[name] for name in on_policy_agents.SAMPLE})
OBS = np.linspace(-1.0, 1.0, 7, dtype=np.float32)[:, None]


class Wanderer(Probe):
    """Sees a new random number at every step and earns it; episodes of 5 steps."""

    length = 5
    ends = "truncated"

    def observe(self):
        return self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32)

    def earn(self, action):
        return float(self.np_random.uniform(-1.0, 1.0)) + action


def is_off_policy(kind):
    return kind in OFF.values()


def start(kind, n_envs=1, **settings):
    """An agent that has not learnt; the rate is constant, since it knows how far a run is, and not a run in parts."""
    own = {"learning_starts": 16} if is_off_policy(kind) else {"learning_rate": 1e-2}
    return kind.small(kind.envs(Wanderer, n_envs), **{**own, **settings})


def networks(agent):
    """What is learnt by gradient or follows it, by part: ``{"actor": {...}, ...}``."""
    found = {}
    for name, array in agent.get_parameters().items():
        part, _, rest = name.partition(".")
        if "optimizer" not in part and array.dtype == np.float32 and (rest or part == "log_alpha"):
            found.setdefault(part, {})[rest] = array
    return found


def assert_all_moved(before, agent, every_array=False):
    """Fails unless something of each part, or all of it, has changed and is finite."""
    after = networks(agent)
    for part, arrays in before.items():
        changed = [(array != after[part][name]).any() for name, array in arrays.items()]
        assert all(changed) if every_array else any(changed), part
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())


@every_off_policy
def test_the_steps_asked_for_are_taken_and_as_many_updates_as_they_owe(kind):
    """45 steps, of which 29 are learned from, once every 8."""
    agent = start(kind, 1 + 2 * (kind.delay - 1) + 7 * kind.discrete, train_freq=8).learn(45)
    assert agent.num_timesteps == agent.replay_buffer.size() == 45
    assert agent.n_updates == int(getattr(agent.state, "n_updates", 3)) == 3  # IQL draws nothing by it
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())


@pytest.mark.parametrize(("n_envs", "total"), [(1, 45), (3, 50), (3, 67)])
@every_on_policy
def test_of_rollouts_so_many_updates_are_owed(kind, n_envs, total):
    """16 steps a gradient step, each learned from 4 times, but A2C's; the number of steps is rounded up to whole rollouts."""
    agent = start(kind, n_envs).learn(total)
    size = agent.config.n_steps * n_envs
    n_rollouts = -(-total // size)
    assert agent.num_timesteps == n_rollouts * size
    of_rollout = 1 if kind.name == "A2C" else 4 * -(-size // 16)
    assert agent.n_updates == int(agent.state.n_updates) == n_rollouts * of_rollout
    assert sum(agent.history["length"]) <= agent.num_timesteps


CRITIC = {"value_loss", "entropy_loss", "explained_variance"}
METRICS = {
    "PPO": {"loss", "policy_gradient_loss", "approx_kl", "clip_fraction", "clip_range"} | CRITIC,
    "A2C": {"policy_loss"} | CRITIC,
    "TRPO": {"policy_objective", "kl_divergence_loss", "is_line_search_success", "value_loss", "explained_variance"},
    "PQN": {"loss", "q_value"},
}


@on_policy_agents.every_kind
def test_everything_moves_and_stays_finite(kind):
    """What a policy gradient of a narrow policy and a value's gradient reach, biases and standard deviation too."""
    agent = start(kind)
    before = networks(agent)
    agent.learn(96)
    assert_all_moved(before, agent, every_array=True)
    assert ("log_std" in before["network"]) == (kind.wrapper is None)
    row = agent.statistics()
    assert all(np.isfinite(value) for value in row.values()), row
    keys = METRICS[kind.name] | {"n_updates", "learning_rate"} | ({"std"} if kind.wrapper is None else set())
    assert {f"train/{key}" for key in keys} <= set(row)
    assert row["rollout/ep_len_mean"] == 5.0


@every_kind
def test_two_runs_with_one_seed_are_the_same_to_the_last_bit_and_another_seed_differs(kind):
    def run(seed):
        return start(kind, seed=seed).learn(60)

    one, again, other = run(3), run(3), run(4)
    assert_same_parameters(one, again)
    for name, array in one.run.replay.arrays().items():
        np.testing.assert_array_equal(array, again.run.replay.arrays()[name], err_msg=name)
    np.testing.assert_array_equal(one.history["return"], again.history["return"])
    np.testing.assert_array_equal(one.predict(OBS)[0], again.predict(OBS)[0])
    assert not same_parameters(one, other)
    assert (one.history["return"] != other.history["return"]).any()


@kinds(["SAC"])
def test_functions_compiled_apart_give_the_same_bits(kind):
    """Agents of these tests share compiled functions; those of users do not."""
    shared = start(kind).learn(40)
    forget_learners()
    assert_same_parameters(shared, start(kind).learn(40))


@pytest.mark.parametrize("n_envs", [1, 3])
@kinds(["SAC", "PPO, MultiDiscrete"])
def test_learning_in_parts_is_learning_at_once(kind, n_envs):
    """On-policy, in whole rollouts."""
    size = (9 if is_off_policy(kind) else kind.settings["n_steps"]) * n_envs
    whole, parts = start(kind, n_envs).learn(5 * size), start(kind, n_envs)
    for n in (1, 3, 1):
        parts.learn(n * size, reset_num_timesteps=False)
    assert parts.num_timesteps == whole.num_timesteps == 5 * size
    assert_same_parameters(whole, parts)
    np.testing.assert_array_equal(whole.history["return"], parts.history["return"])


@every_on_policy
def test_what_was_collected_when_a_run_ended_is_learnt_from_later(kind):
    """Whether a callback's False ends it within a rollout or Ctrl-C."""
    size = kind.settings["n_steps"]
    whole = start(kind).learn(3 * size)

    def press(agent, progress):
        if progress.step == size + 5:
            os.kill(os.getpid(), signal.SIGINT)

    stopped = start(kind).learn(3 * size, callback=lambda agent, progress: progress.step < size + 2)
    interrupted = start(kind).learn(3 * size, callback=press)
    assert [agent.num_timesteps for agent in (stopped, interrupted)] == [size + 2, size + 5]
    assert [agent.interrupted for agent in (stopped, interrupted)] == [False, True]
    for agent in (stopped, interrupted):
        agent.learn(3 * size - agent.num_timesteps, reset_num_timesteps=False)
        assert_same_parameters(whole, agent)
        np.testing.assert_array_equal(whole.history["return"], agent.history["return"])


@every_on_policy
@pytest.mark.parametrize("change", ["set_parameters", "restore_best", "set_env"])
def test_a_rollout_that_another_policy_or_environment_collected_is_not_learned_from(kind, change):
    """The log-probabilities of its actions are computed later, by the policy that learns from it."""
    size = kind.settings["n_steps"]
    until = lambda step: lambda agent, turn: turn.step < step  # noqa: E731
    agent = start(kind).learn(size)
    agent.remember_best(1.0)
    agent.learn(size, until(2 * size - 1), reset_num_timesteps=False)
    assert agent.run.replay.size() == size - 1
    if change == "set_parameters":
        agent.set_parameters(agent.get_parameters())
    elif change == "restore_best":
        agent.restore_best()
    else:
        agent.set_env(kind.envs(Wanderer))
    n_updates = agent.n_updates
    agent.learn(size, until(3 * size - 2), reset_num_timesteps=False)
    assert (agent.n_updates, agent.run.replay.size()) == (n_updates, size - 1)
    agent.learn(1, reset_num_timesteps=False)
    assert agent.n_updates > n_updates


@kinds(["SAC", "PPO, MultiDiscrete"])
def test_what_happens_beside_training_does_not_change_it(kind, tmp_path):
    def look(agent, progress):
        agent.save(tmp_path / "model")
        agent.statistics()
        agent.predict(OBS)
        agent.get_parameters()
        agent.evaluate(1, env=kind.envs(Wanderer))

    assert_same_parameters(start(kind).learn(20), start(kind).learn(20, callback=look))


@every_kind
def test_a_loaded_agent_predicts_the_same_bits_and_goes_on_learning_all_its_parts(kind, tmp_path):
    """Stable-Baselines3 1.1.0 mended a temperature that was no longer learnt after loading."""
    agent = start(kind).learn(32)
    path = agent.save(tmp_path / "model")
    with shared_learners():
        loaded = rejeu.load(path, env=kind.envs(Wanderer))
    assert type(loaded) is kind.agent
    assert loaded.config == agent.config
    assert_same_parameters(agent, loaded)
    for deterministic in (True, False):
        actions = [one.predict(OBS, deterministic=deterministic)[0] for one in (loaded, agent)]
        np.testing.assert_array_equal(*actions)
    assert (loaded.n_updates, loaded.num_timesteps) == (agent.n_updates, 32)
    before = networks(loaded)
    loaded.learn(32)
    assert loaded.n_updates > agent.n_updates
    assert_all_moved(before, loaded)
    if is_off_policy(kind):
        assert ("log_alpha" in before) == kind.has_temperature


@kinds(["SAC", "PPO, MultiDiscrete"])
def test_another_number_of_environments_may_follow(kind):
    agent = start(kind).learn(21)
    agent.set_env(kind.envs(Wanderer, 3))
    agent.learn(50)
    assert agent.num_timesteps >= 50
    assert agent.n_updates == int(agent.state.n_updates)
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())


@kinds(["CrossQ", "PPO, MultiDiscrete"])
def test_batches_of_one_transition_are_learnt_from(kind):
    """Stable-Baselines3 1.1.0 and 1.6.1 mended them."""
    settings = {"n_steps": 1, **({} if kind.name == "A2C" else {"batch_size": 1})}
    agent = start(kind, **settings)
    before = networks(agent)
    agent.learn(16 + 6)
    n_updates = 6 if is_off_policy(kind) else 22 if kind.name == "A2C" else 4 * 22
    assert kind.name == "TRPO" or agent.n_updates == n_updates
    assert_all_moved(before, agent)
    row = agent.statistics()
    row.pop("train/explained_variance", None)
    assert all(np.isfinite(value) for key, value in row.items() if key.startswith("train/"))


@every_off_policy
def test_targets_start_as_copies_and_move_by_themselves(kind):
    """Their first moves are each the share tau of how far the networks are from where both began, and no more."""
    agent = start(kind)
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


def test_a_step_of_several_environments_moves_the_target_once():
    """As in Stable-Baselines3, whose interval of 1 is one step of the vector environment, which is 4 steps here."""
    one, four = (start(OFF["DQN"], 4, train_freq=8, target_update_interval=n).learn(64) for n in (1, 4))
    assert one.n_updates == 6
    assert_same_parameters(one, four)


@every_off_policy
def test_critics_start_different_and_targets_share_no_memory_with_the_networks(kind):
    """Equal targets in the same memory would be overwritten when the state is donated to an update."""
    env, algorithm = env_of(kind), kind.agent.algorithm
    config = algorithm.Config(policy_kwargs={"net_arch": [4]})
    state = algorithm.make(config, env.observation_space, env.action_space).init(jax.random.PRNGKey(1))
    pointers = lambda tree: {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(tree)}  # noqa: E731
    for name in [name for name in vars(state) if name.startswith("target_")]:
        assert not pointers(getattr(state, name.removeprefix("target_"))) & pointers(getattr(state, name))
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


BOXES = {
    name: kind for name, kind in ALL.items() if name.endswith("Box") or (kind in OFF.values() and not kind.discrete)
}


@kinds(["SAC", "PPO, Box"], BOXES)
def test_float64_actions_reach_the_environment_as_such_within_their_bounds(kind, tmp_path):
    """Stable-Baselines3 2.1.0 mended float64 Box actions."""
    agent = kind.small(Precise(), **({"learning_starts": 16} if is_off_policy(kind) else {})).learn(24)
    assert agent.n_updates > 0
    with shared_learners():
        loaded = rejeu.load(agent.save(tmp_path / "model"), env=Precise())
    for one in (agent, loaded, loaded.learn(6)):
        action, _ = one.predict(1e6 * OBS)
        assert action.dtype == np.float64
        assert all(Precise.action_space.contains(a) for a in action)


NESTED = gym.spaces.Dict(
    {
        "camera": gym.spaces.Box(0, 255, (4, 4, 3), np.uint8),
        "place": gym.spaces.Tuple([gym.spaces.Discrete(3, start=5), gym.spaces.Box(-1.0, 1.0, (2,), np.float64)]),
        "bits": gym.spaces.MultiBinary(4),
    }
)


@pytest.mark.parametrize("agent", only([rejeu.PPO], [rejeu.PPO, rejeu.A2C, rejeu.PQN]))
def test_observations_of_any_structure_are_learnt_from_and_saved(agent, tmp_path):
    envs = InProcess([Sampled(NESTED, gym.spaces.Discrete(2)) for _ in range(2)], seed=0)
    one = agent("MultiInputPolicy", envs, n_steps=4, policy_kwargs={"net_arch": [4]}, seed=0)
    before = networks(one)["network"]
    after = networks(one.learn(19))["network"]
    assert (before["torso.layers.0.weight"] != after["torso.layers.0.weight"]).any()
    obs = NESTED.sample()
    two = rejeu.load(one.save(tmp_path / "model"))
    assert one.predict(obs, deterministic=True)[0] == two.predict(obs, deterministic=True)[0]


class Broken(Probe):
    """Its fifth reward is no number."""

    length = 9

    def earn(self, action):
        return float("nan") if self.time == 4 else 1.0


@every_on_policy
def test_a_reward_that_is_no_number_ends_training_before_anything_is_learnt_from_it(kind):
    agent = kind.small(kind.envs(Broken), n_steps=50)
    before = agent.get_parameters()
    with pytest.raises(rejeu.core.errors.BadEnvironmentError, match=r"returned the reward nan .* after 4 steps"):
        agent.learn(20)
    for name, array in agent.get_parameters().items():
        np.testing.assert_array_equal(array, before[name])
