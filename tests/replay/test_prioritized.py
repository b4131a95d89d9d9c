"""Prioritised replay: the sum-tree, the probabilities and weights, what can be drawn, and how it composes."""

import itertools
import timeit

import jax
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings, strategies as st
from scipy.stats import chisquare

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core import checkpoint
from rejeu.core.errors import CheckpointError, NonFiniteError
from rejeu.core.schedules import Linear
from rejeu.core.spaces import leaves, structure
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.make import InProcess
from rejeu.replay.hindsight import HerReplayBuffer, HindsightConfig
from rejeu.replay.prioritized import Priorities, PriorityConfig, SumTree
from rejeu.replay.ring import Ring
from rejeu.replay.uniform import ReplayBuffer
from tests.environments import Sampled

pytestmark = pytest.mark.usefixtures("learners_are_shared")

NUMBER = spaces.Box(-np.inf, np.inf, (1,), np.float64)
GOALS = spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), NUMBER))


def ring_of(space: spaces.Space, capacity: int, n_envs: int, counters: tuple[str, ...] = ()) -> Ring:
    return Ring(capacity, n_envs, leaves(space), structure(space), (1,), np.float32, counters=counters)


class Story:
    """Plays numbered episodes into a buffer: every observation is 1000 env + time, every reward the observation."""

    def __init__(self, buffer: ReplayBuffer | HerReplayBuffer, goals: bool = False) -> None:
        self.buffer = buffer
        self.goals = goals
        self.n_envs = buffer.ring.n_envs
        self.time = np.zeros(self.n_envs, np.int64)
        self.steps: list[list[tuple[int, bool]]] = [[] for _ in range(self.n_envs)]
        """By environment: the time before each step, and whether it terminated."""
        buffer.begin(self.observe())

    def observe(self):
        now = (1000.0 * np.arange(self.n_envs) + self.time)[:, None].astype(np.float32)
        return {"achieved_goal": now, "desired_goal": now + 0.5, "observation": now} if self.goals else now

    def step(self, ended: set[int] = frozenset(), terminated: bool = False) -> None:
        ends = np.isin(np.arange(self.n_envs), list(ended))
        reward = (1000.0 * np.arange(self.n_envs) + self.time).astype(np.float32)
        for env in range(self.n_envs):
            self.steps[env].append((int(self.time[env]), bool(ends[env] and terminated)))
        self.time += 1
        self.buffer.add(np.zeros((self.n_envs, 1), np.float32), reward, ends & terminated, self.observe())
        if ends.any():
            self.time += ends  # the next episode begins one later, so that every observation is of one row only
            self.buffer.begin(self.observe(), np.flatnonzero(ends))

    def kept(self) -> set[float]:
        """Returns the observations of the steps that the ring keeps, recounted from the list of rows."""
        rows = self.buffer.ring.rows
        return {
            1000.0 * env + time
            for env in range(self.n_envs)
            for time, _ in self.steps[env]
            if time > self.time[env] - rows  # the row of time t is overwritten when time t + rows is written
        }


def uniform(capacity: int, n_envs: int = 1, n_steps: int = 1, **config) -> ReplayBuffer:
    ring = ring_of(NUMBER, capacity, n_envs)
    return ReplayBuffer(ring, 0.9, n_steps, Priorities(ring, PriorityConfig(**config)))


def hindsight(capacity: int, n_envs: int = 1, n_steps: int = 1, k: int = 0, **config) -> HerReplayBuffer:
    ring = ring_of(GOALS, capacity, n_envs, ("until_end",))
    goals = GoalFunctions(lambda achieved, desired: (achieved == desired)[..., 0].astype(np.float32))
    return HerReplayBuffer(
        ring, 0.9, HindsightConfig(n_sampled_goal=k), goals, n_steps, Priorities(ring, PriorityConfig(**config))
    )


def draw_all(buffer, rng, n: int = 512) -> np.ndarray:
    """Returns the observations of a draw of ``n``, and gives it TD errors of 1."""
    batch, drawn = buffer.draw(rng, (n,))
    buffer.update_priorities([(drawn, np.ones(n))])
    return jax.tree.leaves(batch.obs)[0][:, 0]


@given(
    st.integers(1, 40), st.lists(st.tuples(st.integers(0, 39), st.floats(0, 100)), min_size=1, max_size=60), st.data()
)
@settings(max_examples=60, deadline=None)
def test_sum_tree_agrees_with_an_array(n, changes, data):
    tree, array = SumTree(n), np.zeros(n)
    while changes:
        size = data.draw(st.integers(1, len(changes)))
        index = np.array([i % n for i, _ in changes[:size]])
        value = np.array([v for _, v in changes[:size]])
        tree.set(index, value)
        for i, v in zip(index, value, strict=True):
            array[i] = v
        changes = changes[size:]
    np.testing.assert_array_equal(tree[np.arange(n)], array)
    assert tree.total == pytest.approx(array.sum(), rel=1e-12)
    if array.sum() > 0:
        mass = np.linspace(0, tree.total, 57, endpoint=False)
        found = tree.find(mass)
        assert (array[found] > 0).all()
        running = np.concatenate([[0.0], np.cumsum(array)])
        slack = 1e-9 * (1 + tree.total)
        assert (running[found] <= mass + slack).all()
        assert (mass <= running[found + 1] + slack).all()


def test_finding_a_mass_at_or_beyond_the_total_gives_a_positive_position():
    tree = SumTree(6)
    tree.set(np.array([1, 3]), np.array([0.1, 0.2]))
    np.testing.assert_array_equal(tree.find(np.array([0.0, 0.1, tree.total, 2 * tree.total])), [1, 3, 3, 3])


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0])
def test_steps_are_drawn_in_proportion_to_their_priorities(alpha):
    """P(i) = (|delta_i| + epsilon)^alpha / sum (arXiv 1511.05952, equation 1)."""
    buffer = uniform(64, alpha=alpha, epsilon=0.01)
    story = Story(buffer)
    for _ in range(10):
        story.step()
    td_error = np.arange(10) ** 2 / 20.0
    give_td_errors(buffer, td_error)
    rng = np.random.default_rng(0)
    counts = np.bincount(np.concatenate([draw_once(buffer, rng) for _ in range(6_000)]).astype(int), minlength=10)
    priority = (td_error + 0.01) ** alpha
    assert chisquare(counts, 6_000 * priority / priority.sum()).pvalue > 1e-3


def give_td_errors(buffer, by_time: np.ndarray) -> None:
    """Makes the TD error of the step at each time of environment 0 known, through draws as a learner would."""
    rng = np.random.default_rng(1)
    unseen = set(range(len(by_time)))
    while unseen:
        batch, drawn = buffer.draw(rng, (256,))
        times = jax.tree.leaves(batch.obs)[0][:, 0].astype(int)
        buffer.update_priorities([(drawn, by_time[times])])
        unseen -= set(times.tolist())


def draw_once(buffer, rng) -> np.ndarray:
    """Returns one step drawn; batches of one are independent, larger ones are stratified."""
    return buffer.sample(rng, (1,)).obs[:, 0]


def test_every_equal_part_of_the_priorities_gives_one_step_of_a_batch():
    buffer = uniform(64, alpha=1.0)
    story = Story(buffer)
    for _ in range(8):
        story.step()
    counts = np.bincount(draw_all(buffer, np.random.default_rng(0), 80).astype(int))
    np.testing.assert_array_equal(counts, np.full(8, 10))


@pytest.mark.parametrize(("progress", "beta"), [(0.0, 0.4), (0.5, 0.7), (1.0, 1.0)])
def test_weights_are_those_of_the_paper_and_anneal(progress, beta):
    """w_i = (N P(i))^-beta / max_j w_j (section 3.4), with beta rising linearly from 0.4 to 1."""
    buffer = uniform(64, alpha=0.6, beta=Linear(0.4, 1.0), epsilon=0.01)
    story = Story(buffer)
    for _ in range(10):
        story.step()
    td_error = np.linspace(0.0, 3.0, 10)
    give_td_errors(buffer, td_error)
    batch = buffer.sample(np.random.default_rng(0), (3, 40), progress)
    priority = (td_error + 0.01) ** 0.6
    weight = (10 * priority / priority.sum()) ** -beta
    expected = weight[batch.obs[..., 0].astype(int)]
    expected /= expected.max(axis=1, keepdims=True)
    np.testing.assert_allclose(batch.weight, expected, rtol=1e-5)
    assert batch.weight.dtype == np.float32


def test_new_steps_get_the_largest_priority_so_far():
    buffer = uniform(64, alpha=1.0, epsilon=1e-6)
    story = Story(buffer)
    story.step()
    assert buffer.priorities.tree[0] == 1.0
    _, drawn = buffer.draw(np.random.default_rng(0), (1,))
    buffer.update_priorities([(drawn, np.array([7.0]))])
    story.step()
    _, drawn = buffer.draw(np.random.default_rng(0), (2,))
    buffer.update_priorities([(drawn, np.array([0.5, 0.5]))])
    story.step()
    np.testing.assert_allclose(buffer.priorities.tree[np.arange(4)], [0.5 + 1e-6, 0.5 + 1e-6, 7 + 1e-6, 0])


def test_td_errors_of_steps_overwritten_meanwhile_are_passed_over():
    buffer = uniform(4, alpha=1.0)
    story = Story(buffer)
    for _ in range(3):
        story.step()
    _, drawn = buffer.draw(np.random.default_rng(0), (3,))
    story.step()
    story.step()
    before = buffer.priorities.tree[np.arange(4)].copy()
    buffer.update_priorities([(drawn, np.array([9.0, 9.0, 9.0]))])
    kept = 2  # of the times 0, 1, 2 only 2 is left, in row 2
    expected = before.copy()
    expected[kept] = 9 + 1e-6
    np.testing.assert_allclose(buffer.priorities.tree[np.arange(4)], expected)


endings = st.lists(
    st.tuples(st.sets(st.integers(0, 2), max_size=2), st.booleans(), st.booleans()), min_size=1, max_size=40
)


@given(st.integers(2, 7), st.integers(1, 3), endings, st.sampled_from([uniform, hindsight]))
@settings(max_examples=60, deadline=None)
def test_exactly_the_steps_that_are_kept_can_be_drawn(rows, n_envs, course, kind):
    """Tiny rings that wrap, with episodes that end anywhere: neither final observations, heads nor the forgotten."""
    buffer = kind(rows * n_envs, n_envs, alpha=0.5)
    story = Story(buffer, goals=kind is hindsight)
    rng = np.random.default_rng(0)
    for ended, terminated, learns in course:
        story.step({env for env in ended if env < n_envs}, terminated)
        if learns and buffer.size():
            n = 16
            _, drawn = buffer.draw(rng, (n,))
            buffer.update_priorities([(drawn, rng.random(n))])
        can_be_drawn = np.flatnonzero(buffer.priorities.tree[np.arange(buffer.ring.rows * n_envs)] > 0)
        drawn = {float(buffer.ring.obs[0][i, 0]) for i in can_be_drawn}
        assert drawn == story.kept()
        assert len(can_be_drawn) == buffer.size()


@pytest.mark.parametrize("kind", [uniform, hindsight])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_rows_drawn_are_the_steps_that_their_rewards_and_successors_say(kind, n_envs):
    buffer = kind(20 * n_envs, n_envs, alpha=0.5)
    story = Story(buffer, goals=kind is hindsight)
    for t in range(50):
        story.step({t % n_envs} if t % 4 == 0 else set(), terminated=t % 8 == 0)
    batch = buffer.sample(np.random.default_rng(0), (5, 100))
    obs, next_obs = (jax.tree.leaves(tree)[0][..., 0] for tree in (batch.obs, batch.next_obs))
    np.testing.assert_array_equal(batch.reward, obs)
    np.testing.assert_array_equal(next_obs, obs + 1)
    ends = {1000 * env + time for env in range(n_envs) for time, terminated in story.steps[env] if terminated}
    np.testing.assert_array_equal(batch.discount == 0, np.isin(obs, list(ends)))
    assert set(obs.ravel()) == story.kept()
    assert batch.weight.shape == (5, 100)
    np.testing.assert_array_equal(batch.weight.max(axis=1), np.ones(5))


@pytest.mark.parametrize("kind", [uniform, hindsight])
def test_n_step_returns_compose_with_priorities(kind):
    """Rewards equal times: an unbroken 3-step return from t is t + 0.9 (t + 1) + 0.81 (t + 2)."""
    buffer = kind(40, 2, n_steps=3, alpha=0.5)
    story = Story(buffer, goals=kind is hindsight)
    for t in range(12):
        story.step({0} if t == 5 else set(), terminated=True)
    batch = buffer.sample(np.random.default_rng(0), (400,))
    obs = jax.tree.leaves(batch.obs)[0][:, 0]
    next_obs = jax.tree.leaves(batch.next_obs)[0][:, 0]
    for i in range(400):
        now = obs[i]
        end = 12 if now < 1000 else 1011  # environment 0 ended after time 5, began again at 7 and stands at 13
        end = 5 if now <= 5 else end
        n = int(min(3, end - now + 1))
        assert batch.reward[i] == pytest.approx(sum(0.9**j * (now + j) for j in range(n)), rel=1e-5)
        assert next_obs[i] == now + n
        assert batch.discount[i] == pytest.approx(0.0 if now <= 5 and now + n == 6 else 0.9**n)


def test_hindsight_relabels_the_same_share_of_a_prioritised_batch():
    buffer = hindsight(64, 2, k=4, alpha=0.5)
    story = Story(buffer, goals=True)
    for t in range(20):
        story.step({0, 1} if t % 10 == 9 else set())
    batch = buffer.sample(np.random.default_rng(0), (3, 50))
    relabelled = batch.obs["desired_goal"][..., 0] % 1 == 0  # the environment's own goals end in .5
    np.testing.assert_array_equal(relabelled.sum(axis=1), [40, 40, 40])
    reached = batch.next_obs["achieved_goal"] == batch.next_obs["desired_goal"]
    np.testing.assert_array_equal(batch.reward[relabelled], reached[..., 0][relabelled])
    future = batch.next_obs["desired_goal"][..., 0] - batch.obs["achieved_goal"][..., 0]
    assert (future[relabelled] >= 1).all()
    assert (future[relabelled] <= 10).all()


def test_relabelled_transitions_carry_high_and_low_priorities_alike():
    """Which part of a batch is relabelled must not depend on where in the ring, or how likely, a step is."""
    buffer = hindsight(64, k=1, alpha=1.0)
    story = Story(buffer, goals=True)
    for _ in range(40):
        story.step()
    give_td_errors(buffer, np.where(np.arange(40) < 20, 1.0, 9.0))
    batch = buffer.sample(np.random.default_rng(0), (4_000,))
    late = batch.obs["observation"][:, 0] >= 20
    assert late[:2000].mean() == pytest.approx(0.9, abs=0.03)
    assert late[2000:].mean() == pytest.approx(0.9, abs=0.03)


def test_a_restored_buffer_can_draw_all_its_steps_and_ignores_td_errors_of_earlier_draws():
    buffer, other = uniform(16, 2), uniform(16, 2)
    story, stale = Story(buffer), Story(other)
    for t in range(15):
        story.step({0} if t % 3 == 0 else set())
    for _ in range(3):
        stale.step()
    rng = np.random.default_rng(0)
    _, stale_draw = other.draw(rng, (4,))
    other.restore(buffer.arrays())
    first, drawn = other.draw(rng, (512,))
    assert set(first.obs[:, 0].tolist()) == story.kept()
    other.update_priorities([(stale_draw, np.full(4, 100.0))])
    assert other.priorities.tree.total == pytest.approx(other.size())
    other.update_priorities([(drawn, np.full(512, 3.0))])
    assert other.priorities.tree.total == pytest.approx(other.size() * (3 + 1e-6) ** 0.6)


def test_drawing_and_setting_take_time_in_the_logarithm_of_the_size():
    def seconds(n: int) -> float:
        tree, rng = SumTree(n), np.random.default_rng(0)
        tree.set(np.arange(n), rng.random(n) + 0.1)
        mass, index = rng.random(256) * tree.total, rng.integers(n, size=256)

        def turn() -> None:
            tree.find(mass)
            tree.set(index, 1.0)

        return min(timeit.repeat(turn, number=20, repeat=7))

    assert seconds(1_000_000) < 4 * seconds(10_000)


@pytest.mark.parametrize(
    ("setting", "message"),
    [({"alpha": 1.5}, "alpha=1.5"), ({"alpha": -0.1}, "alpha=-0.1"), ({"epsilon": 0.0}, "epsilon=0.0")],
)
def test_settings_out_of_range_are_refused_by_name(setting, message):
    with pytest.raises(ValueError, match=message):
        PriorityConfig(**setting)


def small_dqn(**settings) -> rejeu.DQN:
    """A DQN whose updates report as TD error of each step the first number of its observation, drawn from [0, 1)."""
    env = InProcess([Sampled(spaces.Box(0.0, 1.0, (3,)), spaces.Discrete(3))], seed=0)
    settings = {"train_freq": 1, "gradient_steps": 1, **settings, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    agent = rejeu.DQN("MlpPolicy", env, learning_starts=8, batch_size=4, buffer_size=300, priorities={}, **settings)
    update = agent.learner.update
    agent.learner.update = lambda state, batch, clock: (*update(state, batch, clock)[:2], batch.obs[..., 0])
    return agent


def fail_once(agent: rejeu.DQN, which: int, instead) -> None:
    """Lets the ``which``-th draw from now on, counted from 0, be ``instead(batch, drawn)``."""
    draw, numbers = agent.replay_buffer.draw, itertools.count()

    def drawing(*arguments):
        answer = draw(*arguments)
        return instead(*answer) if next(numbers) == which else answer

    agent.replay_buffer.draw = drawing


def not_a_number(batch, drawn):
    return batch._replace(reward=batch.reward * np.float32(np.nan)), drawn


def compute_reward_fails(batch, drawn):
    raise RuntimeError("compute_reward")


def assert_priorities_are_of_their_steps(agent: rejeu.DQN, least: int) -> None:
    """Fails unless all steps have the priority of their own TD error or, being new, the largest, which is 1."""
    ring, tree = agent.replay_buffer.ring, agent.replay_buffer.priorities.tree
    index = np.flatnonzero(tree[np.arange(ring.rows)] > 0)
    own = (ring.obs[0][index, 0].astype(np.float64) + 1e-6) ** 0.6
    known = tree[index] != 1.0
    np.testing.assert_allclose(tree[index][known], own[known], rtol=1e-6)
    assert known.sum() >= least


def assert_resumes(agent: rejeu.DQN, folder) -> None:
    """Fails unless a checkpoint of the run, taken now, can be resumed with everything that is outstanding."""
    assert agent.run.td_errors
    Checkpoint(folder).save(agent)
    env = InProcess([Sampled(spaces.Box(0.0, 1.0, (3,)), spaces.Discrete(3))], seed=0)
    with pytest.warns(UserWarning, match="at the start of new episodes"):
        again = rejeu.DQN.resume(folder, env)
    for (draw, td_error), (other, same) in zip(agent.run.td_errors, again.run.td_errors, strict=True):
        np.testing.assert_array_equal(draw.position, other.position)
        np.testing.assert_array_equal(draw.time, other.time)
        np.testing.assert_array_equal(td_error, same)


def test_after_an_update_that_was_not_finite_td_errors_still_belong_to_their_steps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = small_dqn()
    good = agent.get_parameters()
    fail_once(agent, 10, not_a_number)
    with pytest.raises(NonFiniteError):
        agent.learn(60)
    agent.set_parameters(good)
    agent.learn(60)
    assert_priorities_are_of_their_steps(agent, least=20)
    assert_resumes(agent, tmp_path / "run")


def test_after_a_draw_that_raised_td_errors_still_belong_to_their_steps(tmp_path):
    agent = small_dqn(train_freq=(1, "episode"), gradient_steps=-1)
    fail_once(agent, 8, compute_reward_fails)  # the fourth of the five of a turn
    with pytest.raises(RuntimeError, match="compute_reward"):
        agent.learn(60)
    agent.learn(60)
    assert_priorities_are_of_their_steps(agent, least=20)
    assert_resumes(agent, tmp_path / "run")


def test_a_loaded_replay_buffer_forgets_the_td_errors_of_the_one_before(tmp_path):
    agent = small_dqn().learn(60)
    agent.save_replay_buffer(tmp_path / "replay")
    agent.load_replay_buffer(tmp_path / "replay")
    Checkpoint(tmp_path / "run").save(agent)
    with pytest.warns(UserWarning, match="none was under way"):
        assert rejeu.DQN.resume(tmp_path / "run", agent.env).run.td_errors == []
    agent.learn(60)
    assert_priorities_are_of_their_steps(agent, least=20)


def test_checkpoints_in_which_draws_have_no_td_errors_are_refused(tmp_path):
    agent = small_dqn().learn(40)
    path = Checkpoint(tmp_path).save(agent)
    header, arrays = checkpoint.read(path, "run")
    drawn = header["run"]["dict"]["buffer"]["dict"]["priorities"]["dict"]["drawn"]
    drawn.insert(0, [{"array": "run.lost"}, {"array": "run.lost"}])
    kept = {key: value for key, value in header.items() if key not in checkpoint.RESERVED}
    checkpoint.write(path, "run", {**arrays, "run.lost": np.arange(4)}, kept)
    with pytest.raises(CheckpointError, match="the TD errors under way are not those of the steps that were drawn"):
        rejeu.DQN.resume(tmp_path, agent.env)
