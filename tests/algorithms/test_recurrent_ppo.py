"""Recurrent PPO: its cells and losses against float64 NumPy, whose memory is used when, and that it remembers."""

import functools
import itertools
import operator

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import recurrent_ppo
from rejeu.algorithms.actor_critic.network import action_kind
from rejeu.algorithms.recurrent_ppo import Cell, Config, RecurrentActorCritic, RecurrentConfig
from rejeu.core.algorithm import Clock, Rollout
from rejeu.core.spaces import leaves
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import Probe
from tests.environments import Counter
from tests.helpers import assert_same_parameters, same_parameters
from tests.tiers import exhaustive, only, only_tuples

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.0))
OBS_SPACE = gym.spaces.Box(-5.0, 5.0, (3,), np.float32)
SIZE = 4
unrolled_samples = jax.jit(recurrent_ppo.unrolled_samples, static_argnums=2)


# Independent cells in float64, in the words of PyTorch's documentation.


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def gates(cell, n):
    """W_i and W_h by gate, each ``(n_inputs, size)``, and the two biases."""
    parts = [np.split(np.float64(a), n, axis=-1) for a in (cell.inputs, cell.recurrent)]
    return (*parts, *(np.split(np.float64(b), n) for b in (cell.bias, cell.recurrent_bias)))


def numpy_step(cell, memory, x):
    """The memory after one input ``(n_inputs,)``; of an LSTM (h, c), of a GRU (h,)."""
    if cell.kind == "lstm":
        (wii, wif, wig, wio), (whi, whf, whg, who), (bii, bif, big, bio), (bhi, bhf, bhg, bho) = gates(cell, 4)
        h, c = memory
        i = sigmoid(x @ wii + bii + h @ whi + bhi)
        f = sigmoid(x @ wif + bif + h @ whf + bhf)
        g = np.tanh(x @ wig + big + h @ whg + bhg)
        o = sigmoid(x @ wio + bio + h @ who + bho)
        c = f * c + i * g
        return o * np.tanh(c), c
    (wir, wiz, win), (whr, whz, whn), (bir, biz, bin_), (bhr, bhz, bhn) = gates(cell, 3)
    (h,) = memory
    r = sigmoid(x @ wir + bir + h @ whr + bhr)
    z = sigmoid(x @ wiz + biz + h @ whz + bhz)
    n = np.tanh(x @ win + bin_ + r * (h @ whn + bhn))
    return ((1.0 - z) * n + z * h,)


def numpy_empty(cell):
    return tuple(np.zeros(cell.size) for _ in range(2 if cell.kind == "lstm" else 1))


def dense(layer, x):
    return x @ np.float64(layer.weight) + np.float64(layer.bias)


def numpy_head(torso, head, x):
    for layer in torso.layers:
        x = np.tanh(dense(layer, x))
    return dense(head, x)


def numpy_logits(network, memory):
    return numpy_head(network.readers.torso, network.readers.head, memory[0][0])


def numpy_value(network, memory):
    return numpy_head(network.readers.value_torso, network.readers.value_head, memory[-1][0])[0]


def remembered(network, observations, memory=None):
    """The memories of all cells after each observation of one episode."""
    memory = [numpy_empty(cell) for cell in network.cells] if memory is None else memory
    result = []
    for obs in np.float64(observations):
        memory = [numpy_step(cell, m, obs) for cell, m in zip(network.cells, memory, strict=True)]
        result.append(memory)
    return result


@functools.cache
def made(kind="lstm", shared=False, **settings):
    """Recurrent PPO with two actions, and its state with weights large enough to matter."""
    shape = {"cell": kind, "lstm_hidden_size": SIZE, "shared_lstm": shared, "net_arch": (5,), "ortho_init": False}
    config = Config(**{"policy_kwargs": shape, "n_steps": 6, "batch_size": 12, "n_epochs": 1, **settings})
    algorithm = recurrent_ppo.make(config, OBS_SPACE, gym.spaces.Discrete(3))
    state = algorithm.init(jax.random.PRNGKey(3))
    return config, algorithm, eqx.tree_at(lambda s: s.network, state, jax.tree.map(lambda x: 2.0 * x, state.network))


KINDS = pytest.mark.parametrize("kind", ["lstm", "gru"])
LSTM = pytest.mark.parametrize("kind", only(["lstm"], ["lstm", "gru"]))
"""For tests that compile much."""


@KINDS
@pytest.mark.usefixtures("strict_dtypes")
def test_a_cell_follows_its_equations(kind):
    cell = Cell(jax.random.PRNGKey(0), 3, SIZE, kind)
    inputs = np.random.default_rng(1).normal(size=(7, 2, 3)).astype(np.float32)
    memory = cell.empty(2)
    expected = [numpy_empty(cell) for _ in range(2)]
    for x in inputs:
        memory = cell.step(memory, cell.project(x))
        expected = [numpy_step(cell, m, np.float64(row)) for m, row in zip(expected, x, strict=True)]
        for i, part in enumerate(memory):
            np.testing.assert_allclose(part, [m[i] for m in expected], atol=1e-6)
    for array in jax.tree.leaves(Cell(jax.random.PRNGKey(0), 30, 16, kind)):  # PyTorch's bounds
        assert 0.2 < np.abs(array).max() <= 1.0 / np.sqrt(16)
        assert abs(float(np.mean(array))) < 0.05


def drawn_rollout(seed=0, n_steps=6, n_envs=3, network=None):
    """Steps in which episodes end by terminal state, by time limit and not at all, begun in the midst of episodes."""
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(n_steps, n_envs, 3)).astype(np.float32)
    true_next = np.concatenate([obs[1:], rng.normal(size=(1, n_envs, 3)).astype(np.float32)])
    terminated, truncated = np.zeros((2, n_steps, n_envs), bool)
    terminated[2, 0] = truncated[1, -1] = truncated[4, -1] = True
    over = terminated | truncated
    true_next[over] = rng.normal(size=(int(over.sum()), 3)).astype(np.float32)
    discount = np.where(terminated, 0.0, 0.9).astype(np.float32)
    n_cells = len(network.cells)
    n_parts = 2 if network.cells[0].kind == "lstm" else 1
    carry = tuple(
        tuple(rng.normal(size=(n_envs, SIZE)).astype(np.float32) for _ in range(n_parts)) for _ in range(n_cells)
    )
    started = np.array([False, False, True])[:n_envs]
    return Rollout(
        obs,
        rng.integers(0, 3, (n_steps, n_envs)).astype(np.int32),
        rng.normal(size=(n_steps, n_envs)).astype(np.float32),
        true_next,
        discount,
        over,
        np.ones((n_steps, n_envs), bool),
        np.zeros((n_steps, n_envs), np.float32),
        started,
        carry,
    )


def by_hand(network, rollout, gae_lambda):
    """Log-probabilities, values, advantages ``(steps, n_envs)`` by walking through each environment."""
    n_steps, n_envs = rollout.reward.shape
    log_prob, value, next_value, advantage = np.zeros((4, n_steps, n_envs))
    for e in range(n_envs):
        memory = [tuple(np.float64(part[e]) for part in parts) for parts in rollout.carry]
        fresh = bool(rollout.started[e])
        for t in range(n_steps):
            memory = remembered(network, [rollout.obs[t, e]], None if fresh else memory)[0]
            logits = numpy_logits(network, memory)
            log_prob[t, e] = logits[rollout.action[t, e]] - np.log(np.exp(logits).sum())
            value[t, e] = numpy_value(network, memory)
            next_value[t, e] = numpy_value(network, remembered(network, [rollout.next_obs[t, e]], memory)[0])
            fresh = bool(rollout.ended[t, e])
        following = 0.0
        for t in reversed(range(n_steps)):
            discount = float(rollout.discount[t, e])
            following = 0.0 if rollout.ended[t, e] else following
            delta = rollout.reward[t, e] + discount * next_value[t, e] - value[t, e]
            following = advantage[t, e] = delta + discount * gae_lambda * following
    return log_prob, value, advantage


@pytest.mark.parametrize(
    ("kind", "shared"),
    only_tuples(
        [("lstm", False), ("gru", True)], [(kind, shared) for kind in ("lstm", "gru") for shared in (False, True)]
    ),
)
def test_what_is_learnt_from_is_what_the_memory_of_each_episode_says(kind, shared):
    """Memory is carried over the rollout's border and forgotten where episodes end; a successor is read with the memory
    that the step left, at a time limit the true one."""
    config, _, state = made(kind, shared)
    rollout = drawn_rollout(network=state.network)
    data, started = unrolled_samples(state.network, rollout, config.gae_lambda)
    log_prob, value, advantage = by_hand(state.network, rollout, config.gae_lambda)
    np.testing.assert_allclose(data.log_prob, log_prob, atol=2e-5)
    np.testing.assert_allclose(data.value, value, atol=2e-5)
    np.testing.assert_allclose(data.advantage, advantage, atol=5e-5)
    np.testing.assert_allclose(data.target, advantage + value, atol=5e-5)
    assert np.array_equal(started[0], rollout.started)
    assert np.array_equal(started[1:], rollout.ended[:-1])


class Spy(Counter):
    """A counter whose episodes last 4, 3 and 9 steps, by turns."""

    def __init__(self):
        super().__init__((4, 3, 9))
        self.action_space = gym.spaces.Discrete(3)


pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [4], "lstm_hidden_size": SIZE}, "n_steps": 6, "n_epochs": 2, "seed": 0}


def small(env=None, **settings):
    settings = {**SMALL, **settings}
    return rejeu.RecurrentPPO("MlpPolicy", Spy() if env is None else env, **settings)


def test_acting_step_by_step_gives_the_memories_that_learning_unrolls():
    """Seen in the memory handed to each rollout: unrolled by hand from the very first step, across updates of size 0."""
    agent = small(InProcess([Spy(), Spy()]), learning_rate=0.0)
    carries, observations, begun = [], [], []

    def note(agent, progress):
        run = agent.run
        observations.append(np.array(run.obs))
        begun.append(run.ended.copy())
        carries.append(jax.tree.map(np.array, run.carry))

    agent.learn(40, note)
    network = jax.tree.map(np.float64, agent.state.network)
    memory = [None, None]
    for t in range(19):
        for e in range(2):
            memory[e] = remembered(network, [observations[t][e]], None if begun[t][e] else memory[e])[0]
        if t == 0:
            continue  # the first observation is not among those noted
        if all(any(b[e] for b in begun[: t + 1]) for e in range(2)):
            for cell in range(2):
                for part in range(2):
                    expected = [memory[e][cell][part] for e in range(2)]
                    np.testing.assert_allclose(carries[t + 1][cell][part], expected, atol=1e-5)
    assert sum(b.any() for b in begun) >= 3


def test_a_rollout_begins_with_the_memory_of_the_turn_before_it_and_where_that_ended_episodes():
    agent = small(InProcess([Spy(), Spy()]), learning_rate=0.0, n_steps=4)
    carries, starts = [], []

    def note(agent, progress):
        carries.append(jax.tree.map(np.array, agent.run.carry))
        starts.append(progress.result.terminated | progress.result.truncated)
        if progress.rollout_ended:
            next_rollout = agent.run.replay
            jax.tree.map(np.testing.assert_array_equal, next_rollout.carry, carries[-1])
            np.testing.assert_array_equal(next_rollout.started, starts[-1])

    agent.learn(64, note)
    begins = np.stack(starts[3::4])
    assert begins.any()
    assert not begins.all()
    assert np.any(carries[-1][0][0])


# Gradients and minibatches.


def numpy_loss(network, rollout, config, log_prob_old, value_old, advantage):
    """PPO's loss of a whole rollout as one minibatch, in float64."""
    n_steps, n_envs = rollout.reward.shape
    a = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    target = advantage + value_old
    policy = value_part = entropy = 0.0
    for e in range(n_envs):
        memory = [tuple(np.float64(part[e]) for part in parts) for parts in rollout.carry]
        fresh = bool(rollout.started[e])
        for t in range(n_steps):
            memory = remembered(network, [rollout.obs[t, e]], None if fresh else memory)[0]
            logits = numpy_logits(network, memory)
            log_p = logits - np.log(np.exp(logits).sum())
            ratio = np.exp(log_p[rollout.action[t, e]] - log_prob_old[t, e])
            policy -= min(ratio * a[t, e], np.clip(ratio, 0.8, 1.2) * a[t, e])
            value_part += (numpy_value(network, memory) - target[t, e]) ** 2
            entropy -= (np.exp(log_p) * log_p).sum()
            fresh = bool(rollout.ended[t, e])
    n = n_steps * n_envs
    return (policy + 0.5 * value_part - 0.1 * entropy) / n


@LSTM
def test_the_gradient_reaches_through_time(kind):
    """Along random directions in all weights, float64 differences of an independent loss agree with the gradient."""
    config, _, state = made(kind, ent_coef=0.1)
    rollout = drawn_rollout(seed=1, network=state.network)
    data, started = unrolled_samples(state.network, rollout, config.gae_lambda)
    rng = np.random.default_rng(5)
    moved = jax.tree.map(lambda x: x + rng.normal(0, 0.05, x.shape).astype(np.float32), state.network)
    loss_of = jax.jit(lambda n: recurrent_ppo.loss(n, (data, started, rollout.carry), config, CLOCK)[0])
    given, slope = jax.value_and_grad(loss_of)(moved)
    old = [np.float64(x) for x in (data.log_prob, data.value, data.advantage)]
    wide = jax.tree.map(np.float64, moved)
    assert float(given) == pytest.approx(numpy_loss(wide, rollout, config, *old), abs=1e-5)
    parts = [lambda n: n.cells[0], lambda n: n.cells[1], lambda n: n.readers]
    for part in parts:
        direction = jax.tree.map(lambda x: rng.normal(size=x.shape), part(wide))
        along = lambda h: numpy_loss(  # noqa: E731
            eqx.tree_at(part, wide, jax.tree.map(lambda x, d: x + h * d, part(wide), direction)),  # noqa: B023
            rollout,
            config,
            *old,
        )
        expected = (along(1e-5) - along(-1e-5)) / 2e-5
        products = jax.tree.map(lambda g, d: np.sum(np.float64(g) * d), part(slope), direction)
        assert sum(jax.tree.leaves(products)) == pytest.approx(expected, rel=2e-3, abs=2e-5)


def test_the_value_does_not_train_a_memory_that_both_share():
    """As in sb3-contrib. With advantages of 0 only the value's loss has a gradient."""
    config, _, state = made(shared=True, ent_coef=0.0)
    rollout = drawn_rollout(network=state.network)
    data, started = unrolled_samples(state.network, rollout, config.gae_lambda)
    data = data._replace(advantage=np.zeros_like(data.advantage))
    loss = lambda n: recurrent_ppo.loss(n, (data, started, rollout.carry), config, CLOCK)[0]  # noqa: E731
    slope = jax.jit(jax.grad(loss))(state.network)
    assert not any(x.any() for x in jax.tree.leaves(slope.cells))
    assert all(x.any() for x in jax.tree.leaves(slope.readers.value_torso))


def batches_of(monkeypatch, n_envs, **settings):
    """The environments of every minibatch of an update, as rows of epochs, told apart by their observations."""
    _config, algorithm, state = made(**settings)
    rollout = drawn_rollout(n_envs=n_envs, network=state.network) if n_envs <= 3 else None
    if rollout is None:
        rng = np.random.default_rng(0)
        few = drawn_rollout(n_envs=3, network=state.network)
        tile = lambda x: np.concatenate([x] * 2, axis=1)[:, :n_envs]  # noqa: E731
        rollout = jax.tree.map(tile, few._replace(started=None, carry=None))
        carry = jax.tree.map(lambda x: np.concatenate([x] * 2)[:n_envs], few.carry)
        rollout = rollout._replace(started=np.ones(n_envs, bool), carry=carry)
        rollout = rollout._replace(obs=rng.normal(size=rollout.obs.shape).astype(np.float32))
    rollout.obs[:, :, 0] = np.arange(n_envs)
    seen = []

    def epochs(loss, network, optimizer_state, minibatch, n_minibatches, *rest):
        for i in range(int(n_minibatches)):
            data, started, memory = minibatch(jnp.int32(i))
            which = np.asarray(data.obs)[0, :, 0].astype(int)
            valid = np.asarray(data.valid)
            assert (valid == valid[:1]).all()
            assert (np.asarray(data.obs)[:, :, 0] == which).all()
            assert data.obs.shape[0] == rollout.reward.shape[0]
            for kept, own in zip(jax.tree.leaves(memory), jax.tree.leaves(rollout.carry), strict=True):
                assert np.array_equal(kept, own[which])
            expected = np.concatenate([rollout.started[None], rollout.ended[:-1]])[:, which]
            assert np.array_equal(started, expected)
            seen.append(which[valid[0]].tolist())
        zero = recurrent_ppo.Losses(*[jnp.float32(0)] * 5)
        return network, optimizer_state, n_minibatches, zero

    monkeypatch.setattr(recurrent_ppo, "epochs", epochs)
    algorithm.update(state, rollout, CLOCK)
    return seen


@pytest.mark.parametrize(
    ("n_envs", "batch_size", "sizes"),
    only_tuples([(5, 12, [2, 2, 1])], [(5, 12, [2, 2, 1]), (3, 6, [1, 1, 1]), (3, 100, [3])]),
)
def test_minibatches_are_whole_environments_each_used_once_an_epoch(monkeypatch, n_envs, batch_size, sizes):
    seen = batches_of(monkeypatch, n_envs, n_epochs=3, batch_size=batch_size)
    assert [len(batch) for batch in seen] == sizes * 3
    per_epoch = len(sizes)
    epochs = [functools.reduce(operator.iadd, seen[i : i + per_epoch], []) for i in range(0, len(seen), per_epoch)]
    assert all(sorted(epoch) == list(range(n_envs)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1 or n_envs == 1 or len(sizes) == 1


# What only memory can do.


class Recall(Probe):
    """Shows 1 or -1 at first and 0 after it; the third action earns 1 if it is what was shown, else -1."""

    length = 3
    action_space = gym.spaces.Discrete(2)

    def observe(self):
        return np.float32([self.sign if self.time == 0 else 0.0])

    def reward(self, action):
        if self.time < self.length - 1:
            return 0.0
        return 1.0 if (int(action) == 1) == (self.sign > 0) else -1.0


RECALL = {"n_steps": 24, "batch_size": 96, "n_epochs": 6, "gamma": 0.9, "learning_rate": 1e-2, "seed": 0}


def recalling(algorithm, **policy):
    env = InProcess([Recall() for _ in range(8)], seed=0)
    agent = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [16], **policy}, **RECALL).learn(5000)
    return agent, agent.evaluate(60, env=InProcess([Recall() for _ in range(4)], seed=1))


@exhaustive
@LSTM
def test_a_policy_that_remembers_solves_what_only_memory_can(kind, tmp_path):
    agent, evaluation = recalling(rejeu.RecurrentPPO, cell=kind, lstm_hidden_size=8)
    assert evaluation.mean_return >= 0.95
    loaded = rejeu.load(agent.save(tmp_path / "model"))
    played = loaded.evaluate(20, env=InProcess([Recall() for _ in range(3)], seed=2), deterministic=False)
    assert played.mean_return >= 0.8


# Use.


@pytest.fixture(scope="module")
def agent():
    return small().learn(12)


def walk(agent, observations, **kwargs):
    """Actions for one observation after the other, what is remembered handed on."""
    memory, actions = None, []
    for obs in observations:
        action, memory = agent.predict(obs, memory, deterministic=True, **kwargs)
        actions.append(action)
    return np.array(actions), memory


def numpy_actions(agent, observations):
    network = jax.tree.map(np.float64, agent.state.network)
    return [int(np.argmax(numpy_logits(network, m))) for m in remembered(network, observations)]


@pytest.fixture(scope="module")
def bold():
    """An agent of large weights, whose actions change with what it remembers."""
    agent = small()
    larger = {
        key: 4.0 * value if value.dtype == np.float32 and ".bias" not in key else value
        for key, value in agent.get_parameters().items()
    }
    agent.set_parameters(larger)
    return agent


def test_predict_hands_memory_on(bold):
    observations = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    actions, memory = walk(bold, observations)
    assert actions.tolist() == numpy_actions(bold, observations)
    alone = [int(bold.predict(obs, deterministic=True)[0]) for obs in observations]
    assert actions.tolist() != alone  # else nothing was tested
    drawn = None
    for obs in observations:  # what is remembered does not depend on the actions; it may be kept as NumPy arrays
        _, drawn = bold.predict(obs, jax.tree.map(np.array, drawn), deterministic=False)
    for one, other in zip(jax.tree.leaves(memory), jax.tree.leaves(drawn), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    expected = remembered(bold.state.network, observations)[-1]
    for given, own in zip(jax.tree.leaves(memory), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(np.asarray(given)[0], own, atol=1e-4)


def test_predict_remembers_each_of_a_batch_and_forgets_where_an_episode_starts(bold):
    observations = np.random.default_rng(1).normal(size=(12, 3, 3)).astype(np.float32)
    starts = np.zeros((12, 3), bool)
    starts[5, 1] = starts[8, 2] = starts[8, 1] = True
    memory, actions = None, []
    for obs, start in zip(observations, starts, strict=True):
        action, memory = bold.predict(obs, memory, start, deterministic=True)
        actions.append(action)
    actions = np.array(actions)
    assert actions.shape == (12, 3)
    for e, cuts in enumerate(([0, 12], [0, 5, 8, 12], [0, 8, 12])):
        expected = [a for i, j in itertools.pairwise(cuts) for a in numpy_actions(bold, observations[i:j, e])]
        assert actions[:, e].tolist() == expected


def test_evaluation_carries_memory_and_begins_anew_with_each_episode(bold):
    """The actions that environments received are those of a walk through each of their episodes."""
    envs = [Spy(), Spy()]
    bold.evaluate(6, env=InProcess(envs, seed=0))
    again = [Spy(), Spy()]
    for i, (env, twin) in enumerate(zip(envs, again, strict=True)):
        received = iter(np.array(env.actions).tolist())
        n = len(env.actions)
        obs, _ = twin.reset(seed=i)
        while n:
            observations, over = [], False
            while not over and n:
                observations.append(obs)
                obs, _, _, over, _ = twin.step(0)
                n -= 1
            assert [next(received) for _ in observations] == numpy_actions(bold, observations)
            if over:
                obs, _ = twin.reset()


@exhaustive
def test_a_shared_memory_is_one():
    one, two = small(policy_kwargs={**SMALL["policy_kwargs"], "shared_lstm": True}), small()
    assert len(one.state.network.cells) == 1
    assert len(two.state.network.cells) == 2
    obs = np.zeros((5, 3), np.float32)
    assert len(jax.tree.leaves(one.predict(obs)[1])) == 2
    assert len(jax.tree.leaves(two.predict(obs)[1])) == 4
    assert one.learn(12).n_updates > 0


@pytest.mark.parametrize(
    "state",
    [
        tuple((np.zeros((1, SIZE + 1)), np.zeros((1, SIZE + 1))) for _ in range(2)),
        tuple((np.zeros((3, SIZE)), np.zeros((3, SIZE))) for _ in range(2)),
        (np.zeros((1, SIZE)), np.zeros((1, SIZE))),
        "nothing",
    ],
)
def test_a_memory_of_another_size_is_refused_in_one_line(bold, state):
    """One of three episodes would otherwise be taken for one of one, by broadcasting."""
    for deterministic in (True, False):
        with pytest.raises(ValueError, match=r"^[^\n]*given a state of the shapes [^\n]*; give what its last[^\n]*$"):
            bold.predict(np.zeros(3, np.float32), state, deterministic=deterministic)


IMAGES = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)


@exhaustive
def test_policy_and_value_may_read_images_through_convolutions_of_their_own():
    """What one encoder sees moves its own cell's memory, and nothing of the other's."""
    shape = RecurrentConfig(lstm_hidden_size=SIZE, net_arch=(5,), share_features_extractor=False)
    kind = action_kind(gym.spaces.Discrete(2))
    network = RecurrentActorCritic(jax.random.PRNGKey(0), leaves(IMAGES), kind, shape)
    blind = jax.tree.map(jnp.zeros_like, network.value_encoder)
    other = eqx.tree_at(lambda n: n.value_encoder, network, blind)
    pixels = np.random.default_rng(0).integers(256, size=(6, 2, 8, 8, 3), dtype=np.uint8)
    started = np.zeros((6, 2), bool)
    for read in (
        lambda n: n.remember(n.empty(2), pixels[0], np.zeros(2, bool)),
        lambda n: n.unroll(n.empty(2), pixels, started),
    ):
        (policy, value), (policy_too, value_too) = read(network), read(other)
        np.testing.assert_array_equal(policy[0], policy_too[0])
        assert np.abs(value[0] - value_too[0]).max() > 1e-3
    shared = RecurrentActorCritic(jax.random.PRNGKey(0), leaves(IMAGES), kind, RecurrentConfig(lstm_hidden_size=SIZE))
    assert shared.value_encoder is None
    weights = [n.encoder.images[0].linear.weight for n in (network, shared)]
    np.testing.assert_array_equal(*weights)
    assert not np.array_equal(network.value_encoder.images[0].linear.weight, weights[0])


@exhaustive
def test_learning_is_determined_by_the_seed(agent):
    assert_same_parameters(agent, small().learn(12))
    assert not same_parameters(agent, small(seed=1).learn(12))


@exhaustive
@LSTM
def test_a_file_keeps_all_of_it(kind, tmp_path):
    agent = small(policy_kwargs={**SMALL["policy_kwargs"], "cell": kind, "shared_lstm": True}).learn(6)
    loaded = rejeu.load(agent.save(tmp_path / "model"))
    assert loaded.config == agent.config
    assert_same_parameters(agent, loaded)
    observations = np.random.default_rng(3).normal(size=(5, 3)).astype(np.float32)
    for one, other in zip(
        jax.tree.leaves(walk(agent, observations)), jax.tree.leaves(walk(loaded, observations)), strict=True
    ):
        assert np.array_equal(one, other)


def test_the_network_reads_through_the_encoder():
    """A Discrete observation is one-hot encoded before the cell."""
    shape = RecurrentConfig(lstm_hidden_size=SIZE, net_arch=(5,))
    kind = action_kind(gym.spaces.Discrete(2))
    network = RecurrentActorCritic(jax.random.PRNGKey(0), leaves(gym.spaces.Discrete(7)), kind, shape)
    assert network.cells[0].inputs.shape == (7, 4 * SIZE)
    memory = network.remember(network.empty(2), np.int32([0, 6]), np.zeros(2, bool))
    expected = remembered(network, [np.eye(7)[6]])[0][0][0]
    np.testing.assert_allclose(memory[0][0][1], expected, atol=1e-6)
