"""Networks with memory that learn from replay: which memory is used when, sequences, targets against float64 NumPy, acting."""

import dataclasses

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import dqn, td3
from rejeu.algorithms.config import RndConfig
from rejeu.algorithms.rnd import with_rnd
from rejeu.algorithms.sac import continuous as sac, discrete as discrete_sac
from rejeu.core.algorithm import Masked, Sequences, Transition
from rejeu.core.spaces import Leaf, leaves
from rejeu.envs.make import InProcess
from rejeu.replay.ring import Ring
from rejeu.replay.uniform import ReplayBuffer
from tests.algorithms.test_recurrent_ppo import Recall, dense, numpy_empty, numpy_step
from tests.environments import Timed
from tests.tiers import exhaustive, only, only_tuples

SIZE = 4
OBS_SPACE = gym.spaces.Box(-5.0, 5.0, (3,), np.float32)
BOX = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
MEMORY = {"lstm_hidden_size": SIZE, "sequence_length": 4, "burn_in": 3, "net_arch": [5]}
RUN = {"learning_starts": 10_000, "batch_size": 64, "seed": 0}


class Drawn(Timed):
    """Shows random numbers, which identify each step; episodes have 1 to 9 steps, and every other one is truncated."""

    observation_space = OBS_SPACE

    def __init__(self, action_space=BOX):
        self.action_space, self.episode = action_space, 0

    def begin(self, seed):
        self.length, self.episode = int(self.np_random.integers(1, 10)), self.episode + 1
        self.ends = "truncated" if self.episode % 2 else "terminated"

    def observe(self):
        return self.np_random.normal(size=3).astype(np.float32)

    def reward(self, action):
        return float(self.np_random.normal())


class Recorded(InProcess):
    """Environments that keep every observation, reward and end of each environment, in order."""

    def __init__(self, envs, seed):
        super().__init__(envs, seed)
        self.rows = [[] for _ in envs]

    def reset(self, seed=None):
        obs = super().reset(seed)
        for env in range(self.n_envs):
            self.rows[env].append({"obs": obs[env].copy(), "begins": True})
        return obs

    def step(self, action, active=None):
        step = super().step(action, active)
        for env in range(self.n_envs):
            self.rows[env][-1].update(reward=float(step.reward[env]), terminated=bool(step.terminated[env]))
            self.rows[env].append({"obs": step.obs[env].copy(), "begins": False})
        return step

    def reset_done(self, done):
        obs = super().reset_done(done)
        for env in np.flatnonzero(done):
            self.rows[env].append({"obs": obs[env].copy(), "begins": True})
        return obs


def filled(algorithm=rejeu.SAC, steps=240, action_space=BOX, memory=None, **settings):
    """An agent whose replay buffer holds steps of three environments, all of the same weights."""
    env = Recorded([Drawn(action_space) for _ in range(3)], 1)
    agent = algorithm("MlpPolicy", env, policy_kwargs={**MEMORY, **(memory or {})}, **{**RUN, **settings})
    state = jax.tree.map(lambda x: 3.0 * x if x.dtype == jnp.float32 else x, agent.state)  # weights that matter
    agent.run.state = agent.learner.pack(state)
    return agent.learn(steps), env


def places(env):
    """Environment and time of each row that was recorded, by its observation."""
    return {tuple(row["obs"].tolist()): (e, t) for e, rows in enumerate(env.rows) for t, row in enumerate(rows)}


def remembered(network, rows):
    """What a network remembers with each row of an environment from the first on, in float64."""
    memory, found = None, []
    for row in rows:
        memory = numpy_empty(network.cell) if row["begins"] else memory
        memory = numpy_step(network.cell, memory, np.float64(row["obs"]))
        found.append(memory[0])
    return found


def reads(sequences):
    """The observations that are read, ``(batch, 3)``."""
    return np.take_along_axis(sequences.obs, sequences.reads[..., None], axis=1).reshape(-1, 3)


@pytest.mark.parametrize("cell", ["lstm", "gru"])
@pytest.mark.parametrize("buffer_size", only([60], [10_000, 60]))
def test_a_sequence_remembers_what_acting_did(cell, buffer_size):
    """Also where the ring has wrapped around, episodes end within, and the rows before the sequence are gone."""
    agent, env = filled(memory={"cell": cell}, buffer_size=buffer_size)
    batch, place = agent.replay_buffer.sample(np.random.default_rng(0), (400,)), places(env)
    for network in (agent.state.actor, agent.state.critics):
        expected = [remembered(network, rows) for rows in env.rows]
        for sequences in (batch.obs, batch.next_obs):
            found = network.remembered(sequences)
            wanted = [expected[e][t] for e, t in (place[tuple(obs.tolist())] for obs in reads(sequences))]
            np.testing.assert_allclose(found, wanted, atol=2e-6)


@pytest.mark.parametrize("n_steps", only([3], [1, 3]))
@pytest.mark.parametrize("buffer_size", only([60], [10_000, 60]))
def test_the_transitions_of_sequences_are_steps_with_their_successors(buffer_size, n_steps):
    agent, env = filled(buffer_size=buffer_size, n_steps=n_steps)
    batch, place = agent.replay_buffer.sample(np.random.default_rng(0), (2, 200)), places(env)
    assert batch.reward.shape == (2, 200)
    assert batch.obs.memory.shape == (2, 50, 4 * SIZE)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    gamma, seen = agent.config.gamma, set()
    for i, (obs, after) in enumerate(zip(reads(flat.obs), reads(flat.next_obs), strict=True)):
        (e, t), (other, u) = place[tuple(obs.tolist())], place[tuple(after.tolist())]
        rows, seen = env.rows[e], seen | {(e, t)}
        n = 1
        while n < n_steps and "reward" in rows[t + n] and not rows[t + n - 1].get("terminated"):
            n += 1
        assert (other, u) == (e, t + n)
        reward = sum(gamma**k * rows[t + k]["reward"] for k in range(n))
        discount = 0.0 if rows[t + n - 1]["terminated"] else gamma**n
        np.testing.assert_allclose([flat.reward[i], flat.discount[i]], [reward, discount], rtol=1e-5)
    stored = sum("reward" in row for rows in env.rows for row in rows)
    assert len(seen) > 0.6 * min(stored, buffer_size * 0.8)  # steps at the start and end of episodes are drawn as well


def test_nothing_passes_from_one_episode_to_the_next():
    agent, _ = filled()
    batch, network = agent.replay_buffer.sample(np.random.default_rng(0), (400,)), agent.state.actor
    begins, sequences = batch.obs.begins, batch.obs
    before = np.cumsum(begins[:, ::-1], axis=1)[:, ::-1] > 0
    before = np.where(begins, np.roll(before, -1, axis=1) & (np.cumsum(begins[:, ::-1], 1)[:, ::-1] > 1), before)
    last = before.sum(axis=1)  # the row with which the last episode of a sequence begins
    changed = sequences._replace(
        obs=np.where(before[..., None], np.float32(9.0), sequences.obs),
        memory=np.where(before.any(axis=1)[:, None], np.float32(9.0), sequences.memory),
    )
    same = (
        np.asarray(network.remembered(sequences) == network.remembered(changed))
        .all(axis=1)
        .reshape(sequences.reads.shape)
    )
    in_last = sequences.reads >= last[:, None]
    assert before.any()
    assert same[in_last].all()
    assert not same[~in_last].all()


def test_burn_in_brings_no_gradient_and_the_rest_does():
    agent, _ = filled()
    sequences = agent.replay_buffer.sample(np.random.default_rng(0), (64,)).obs
    sequences = sequences._replace(begins=np.zeros_like(sequences.begins), n_absent=np.zeros_like(sequences.n_absent))
    network = agent.state.actor
    memory = sequences.memory
    for row in range(3):
        memory = np.concatenate([network.after(memory, sequences.obs[:, row]), memory[:, 2 * SIZE :]], axis=1)
    later = sequences._replace(
        obs=sequences.obs[:, 3:], begins=sequences.begins[:, 3:], memory=memory, reads=sequences.reads - 3
    )
    slope = jax.grad(lambda network, sequences: jnp.sum(network.remembered(sequences)))
    with_burn_in, without = slope(network, sequences), slope(dataclasses.replace(network, burn_in=0), later)
    for one, other in zip(jax.tree.leaves(with_burn_in.cell), jax.tree.leaves(without.cell), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
    assert np.any(without.cell.recurrent)


def one_step(batch, n_numbers):
    """The same transitions as sequences of one step without a memory from before."""

    def sequences(obs):
        n = len(obs)
        zeros = np.zeros((n, n_numbers), np.float32)
        return Sequences(obs[:, None], np.zeros((n, 1), bool), np.zeros(n, np.int32), zeros, np.zeros((n, 1), np.int32))

    return batch._replace(obs=sequences(batch.obs), next_obs=sequences(batch.next_obs))


def transitions(action_space):
    rng, n = np.random.default_rng(0), 6
    obs, next_obs = rng.normal(size=(2, n, 3)).astype(np.float32)
    is_box = isinstance(action_space, gym.spaces.Box)
    action = rng.uniform(-1, 1, (n, 2)).astype(np.float32) if is_box else np.int32([0, 1, 2, 0, 1, 2])
    return Transition(obs, action, rng.normal(size=n).astype(np.float32), next_obs, np.float32([0.0, 1, 1, 0.9, 1, 1]))


@pytest.mark.parametrize(
    ("module", "action_space"),
    only_tuples(
        [(td3, BOX)], [(sac, BOX), (td3, BOX), (discrete_sac, gym.spaces.Discrete(3)), (dqn, gym.spaces.Discrete(3))]
    ),
)
def test_sequences_of_one_step_are_transitions_whose_observations_begin_episodes(module, action_space):
    config = {sac: sac.Config, td3: td3.Config, discrete_sac: sac.Config, dqn: dqn.Config}[module]
    config = config(policy_kwargs={**MEMORY, "sequence_length": 1, "burn_in": 0})
    algorithm = with_rnd(module.make(config, OBS_SPACE, action_space), leaves(OBS_SPACE), RndConfig())
    state, batch = algorithm.init(jax.random.PRNGKey(0)), transitions(action_space)
    n_numbers = algorithm.explorer.init(algorithm.actor(state), 1).shape[1]
    clock = rejeu.core.algorithm.Clock(np.uint32(4), np.uint32(0), np.float32(0.0))
    update = jax.jit(algorithm.update)
    plain, metrics = update(state, batch, clock)
    unrolled, same_metrics = update(state, one_step(batch, n_numbers), clock)
    for one, other in zip(jax.tree.leaves((plain, metrics)), jax.tree.leaves((unrolled, same_metrics)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_the_targets_of_double_dqn_with_memory_are_those_of_numpy():
    """Of an update after the weights have changed: burn-in with the new ones, from the memory that the old ones left."""
    agent, env = filled(rejeu.DQN, action_space=gym.spaces.Discrete(3), double_q=True, n_steps=2)
    batch, place = agent.replay_buffer.sample(np.random.default_rng(0), (64,)), places(env)
    online, target = (jax.tree.map(lambda x, f=f: f * x, agent.state.network) for f in (0.5, 0.8))
    found = dqn.td_target(online, target, batch, True)
    old = [stored(agent.state.network, rows) for rows in env.rows]
    following = reads(batch.next_obs)
    for i, obs in enumerate(reads(batch.obs)):
        (e, _), sequence = place[tuple(obs.tolist())], i // 4
        first = np.argmax(np.arange(99) >= batch.obs.n_absent[sequence])
        begin = place[tuple(batch.obs.obs[sequence, first].tolist())][1]
        end = place[tuple(following[i].tolist())][1]
        values = []
        for network in (online, target):
            memory = old[e][begin]
            for row in env.rows[e][begin : end + 1]:
                memory = numpy_empty(network.cell) if row["begins"] else memory
                memory = numpy_step(network.cell, memory, np.float64(row["obs"]))
            values.append(numpy_relu(network.reader, memory[0]))
        y = batch.reward[i] + batch.discount[i] * values[1][np.argmax(values[0])]
        np.testing.assert_allclose(found[i], y, rtol=1e-4, atol=1e-5)


def stored(network, rows):
    """The memory before each row of an environment, of the network that acted."""
    memory, found = numpy_empty(network.cell), []
    for row in rows:
        memory = numpy_empty(network.cell) if row["begins"] else memory
        found.append(memory)
        memory = numpy_step(network.cell, memory, np.float64(row["obs"]))
    return found


def numpy_relu(reader, x):
    for layer in reader.torso.layers:
        x = np.maximum(dense(layer, x), 0.0)
    return dense(reader.head, x)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_memory_of_a_sequence_is_that_before_its_first_row_that_is_there(n_envs):
    """A row shows its time, and its memory 100 more, at the start of an episode 0. Rows that are gone look like the oldest."""
    leaf = Leaf("", "continuous", (1,), "float32")
    ring = Ring(12 * n_envs, n_envs, (leaf,), jax.tree.structure(0), (), np.int32, memory_size=1)
    buffer = ReplayBuffer(ring, 0.9, sequence=(4, 3))
    for time in range(40):
        row, begins = np.full((n_envs, 1), time, np.float32), np.full(n_envs, time in (0, 33))
        if begins.all():
            buffer.begin(row)
        else:
            buffer.add(np.zeros(n_envs, np.int32), np.zeros(n_envs, np.float32), begins, row)
        ring.remember(row + 100, begins)
    obs, (oldest, final, newest) = buffer.sample(np.random.default_rng(0), (400,)).obs, (28, 32, 39)
    for row, (memory,), n_absent, reads in zip(obs.obs[..., 0], obs.memory, obs.n_absent, obs.reads, strict=True):
        times = row[n_absent] - n_absent + np.arange(len(row))
        assert memory == (0 if row[n_absent] == final + 1 else row[n_absent] + 100)
        np.testing.assert_array_equal(row, np.clip(times, oldest, newest))
        assert n_absent == np.sum(times < oldest)
        assert not {final, newest} & {*row[reads].tolist()}  # from which no step was taken
    assert {*obs.n_absent.tolist()} == {0, 1, 2, 3}


def test_masks_go_with_the_rows_that_are_read():
    kinds = (Leaf("obs", "continuous", (1,), "float32"), Leaf("mask", "continuous", (3,), "bool"))
    ring = Ring(100, 2, kinds, jax.tree.structure(Masked(0, 0)), (), np.int32, memory_size=2)
    buffer = ReplayBuffer(ring, 0.9, sequence=(4, 2))
    seen = lambda t: Masked(np.float32([[t], [t]]), np.arange(3)[None].repeat(2, 0) == t % 3)  # noqa: E731
    buffer.begin(seen(0))
    for t in range(1, 40):
        buffer.add(np.zeros(2, np.int32), np.zeros(2, np.float32), np.zeros(2, bool), seen(t))
    batch = buffer.sample(np.random.default_rng(0), (40,))
    for obs in (batch.obs, batch.next_obs):
        times = np.take_along_axis(obs.obs.obs[..., 0], obs.obs.reads, axis=1).ravel()
        np.testing.assert_array_equal(obs.mask, np.arange(3)[None] == times[:, None] % 3)


@exhaustive
def test_dqn_with_memory_solves_what_only_memory_can(tmp_path):
    shape = {"net_arch": [16], "lstm_hidden_size": 8, "sequence_length": 4, "burn_in": 4}
    settings = {"learning_rate": 1e-2, "gamma": 0.9, "learning_starts": 100, "target_update_interval": 50, "seed": 0}
    envs = lambda seed: InProcess([Recall() for _ in range(4)], seed=seed)  # noqa: E731
    agent = rejeu.DQN("MlpPolicy", envs(0), policy_kwargs=shape, batch_size=64, **settings).learn(4000)
    assert agent.evaluate(40, env=envs(1)).mean_return >= 0.95
    assert rejeu.load(agent.save(tmp_path / "model")).evaluate(20, env=envs(2)).mean_return >= 0.95


def test_predict_remembers_and_leaves_out_the_noise_of_training():
    agent, _ = filled(rejeu.TD3, action_noise=0.5)
    obs = np.random.default_rng(0).normal(size=(5, 2, 3)).astype(np.float32)
    state, expected = None, []
    for t in range(5):
        action, state = agent.predict(obs[t], state, episode_start=np.array([t == 3, False]), deterministic=t % 2 == 0)
        expected.append(action)
    rows = [{"obs": obs[t, 0], "begins": t in (0, 3)} for t in range(5)]
    for t, memory in enumerate(remembered(agent.state.actor, rows)):
        np.testing.assert_allclose(expected[t][0], np.tanh(numpy_relu(agent.state.actor.reader, memory)), atol=1e-5)
    with pytest.raises(ValueError, match="was given a state of the shapes"):
        agent.predict(obs[0], state[:1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda make, env: make("MlpPolicy", env, policy_kwargs=MEMORY, priorities={}), "priorities"),
        (lambda make, env: make("MlpPolicy", env, policy_kwargs=MEMORY, use_sde=True), "policies with memory"),
        (lambda make, env: make("MlpPolicy", env, policy_kwargs=MEMORY, batch_size=30), "try 28"),
        (lambda make, env: make("MlpPolicy", env, policy_kwargs=MEMORY, replay_buffer_class="HerReplayBuffer"), "Her"),
        (lambda make, env: rejeu.CrossQ("MlpPolicy", env, policy_kwargs=MEMORY), "CrossQ has no networks with memory"),
        (lambda make, env: filled()[0].q_values(np.zeros(3, np.float32), np.zeros(2)), "memory"),
    ],
)
def test_what_does_not_go_with_memory_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make(rejeu.SAC, InProcess([Drawn()], 1))


def test_environments_on_the_device_train_with_the_loop_of_the_host():
    env = rejeu.make_vector("jax/Pendulum-v1", 2, seed=0)
    agent = rejeu.SAC("MlpPolicy", env, policy_kwargs=MEMORY, **RUN)
    agent.on_device = True
    with pytest.raises(ValueError, match="networks with memory learn from replay on the host only"):
        agent.learn(10)
