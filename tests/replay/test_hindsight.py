"""Hindsight replay against a brute-force relabeller.

The achieved goal of every observation names its environment and its place in that environment's history, so each
sampled goal tells where it was taken from.
"""

import dataclasses
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from rejeu.envs.goals import GoalFunctions, over_batches
from rejeu.replay.hindsight import (
    GoalSelectionStrategy,
    HerReplayBuffer,
    HindsightConfig,
    counters,
    register_goal_strategy,
)
from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.uniform import ReplayBuffer
from tests.replay_model import GOAL_OBSERVATION, Model, Turn, histories, make_ring, observe_goal, play

GAMMA = 0.9
OWN_GOAL = np.array([-1.0, -1.0], np.float32)
"""What every environment asks for."""
STRATEGIES = [strategy.value for strategy in GoalSelectionStrategy]
MIXES = [{"future": 2, "desired": 2}, {"episode": 1, "random": 2, "desired": 1}, {"desired": 1}]
EVEN = ["future", "final", "episode", "random"]
"""Strategies by which all allowed goals are equally likely."""


def reward(achieved, desired):
    """Different when the two are swapped, and exact in float32."""
    return (achieved[..., 1] - 2.0 * desired[..., 1] + 0.25 * desired[..., 0]).astype(np.float32)


def terminated(achieved, desired):
    """Which goals that are not new, (-1, -1), may be reached by, too."""
    return (achieved[..., 1] % 3 == desired[..., 1] % 3) & (achieved[..., 0] <= np.abs(desired[..., 0]))


def by_info(function, other, dtype):
    """The function of single goals; ``other`` with the info of another step, and an error without one."""
    return over_batches(lambda a, d, info: function(a, d) if info["place"] == a[1] else other, dtype)


def filled(n_envs, rows, history, strategy="future", k=4, n_steps=1, ends=False, priorities=False, infos=False):
    config = HindsightConfig(n_sampled_goal=k, goal_selection_strategy=strategy, copy_info_dict=infos)
    ring = make_ring(rows * n_envs, n_envs, GOAL_OBSERVATION, counters(config))
    goals = GoalFunctions(reward, terminated if ends else None)
    if infos:
        goals = GoalFunctions(by_info(reward, 1e6, np.float32), by_info(terminated, True, bool) if ends else None)
    replay = HerReplayBuffer(
        ring,
        GAMMA,
        config,
        goals,
        n_steps,
        Priorities(ring, PriorityConfig()) if priorities else None,
    )
    model = Model(n_envs, rows)
    replay.last_infos = lambda: [{"place": len(frames)} for frames in model.frames]  # the place that a step leads to
    play(replay, model, history, observe_goal)
    return replay, model


def allowed_goals(model, strategy, env, place):
    """All (environment, place) whose achieved goal may replace the goal of the step at (env, place)."""
    episode = model.episode(env, place)
    if strategy in ("future", "closest", "next_future"):
        return {(env, later) for later in episode if later > place}
    if strategy == "final":
        return {(env, episode[-1])}
    if isinstance(strategy, dict):
        return set().union(*(allowed_goals(model, name, env, place) for name in strategy))
    if strategy == "episode":  # any moment that a kept step led to
        return {(env, other) for other in episode[1:]}
    if strategy == "desired":
        return {tuple(OWN_GOAL)}
    return {(other_env, other + 1) for other_env, other in model.steps()}


def relabelled_return(model, env, place, goal, n_steps, ends):
    """Reward and discount of the step at (env, place) for another goal, by walking along its episode."""
    total, weight, goal = 0.0, 1.0, np.array(goal, np.float32)
    for _ in range(n_steps):
        frame = model.frames[env][place]
        if frame.step is None:
            break
        place += 1
        reached = np.array([env, place], np.float32)
        total += weight * float(reward(reached, goal))
        weight *= GAMMA
        crashed = frame.step[2] and not (ends and terminated(reached, OWN_GOAL))
        if crashed or (ends and terminated(reached, goal)):
            return total, place, 0.0
        if frame.step[2]:
            break
    return total, place, weight


@settings(max_examples=60)
@given(
    case=histories(),
    strategy=st.sampled_from([*STRATEGIES, *MIXES]),
    k=st.integers(0, 5),
    n_steps=st.integers(1, 4),
    ends=st.booleans(),
    priorities=st.booleans(),
    infos=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_samples_agree_with_a_brute_force_relabeller(case, strategy, k, n_steps, ends, priorities, infos, seed):
    replay, model = filled(*case, strategy, k, n_steps, ends, priorities, infos)
    steps = set(model.steps())
    assert replay.size() == len(steps)
    if not steps:
        return
    n_batches, size = 3, 20
    batch = replay.sample(np.random.default_rng(seed), (n_batches, size))
    for b in range(n_batches):
        for row in range(size):
            env, place = (int(x) for x in batch.obs["observation"][b, row])
            goal = tuple(int(x) for x in batch.obs["desired_goal"][b, row])
            assert (env, place) in steps
            np.testing.assert_array_equal(batch.obs["achieved_goal"][b, row], (env, place))
            np.testing.assert_array_equal(batch.next_obs["desired_goal"][b, row], goal)
            assert batch.action[b, row, 0] == np.float32(model.frames[env][place].step[0])
            if row < int(size * k / (k + 1)):
                assert goal in allowed_goals(model, strategy, env, place)
                expected = relabelled_return(model, env, place, goal, n_steps, ends)
            else:
                assert goal == tuple(OWN_GOAL)
                expected = model.n_step(env, place, n_steps, GAMMA)
            assert batch.reward[b, row] == pytest.approx(expected[0], rel=1e-5, abs=1e-5)
            np.testing.assert_array_equal(batch.next_obs["observation"][b, row], (env, expected[1]))
            np.testing.assert_array_equal(batch.next_obs["achieved_goal"][b, row], (env, expected[1]))
            assert batch.discount[b, row] == pytest.approx(expected[2], abs=1e-6)


def turn(*ends):
    return Turn(list(ends), [False] * len(ends))


RUNNING_AND_WRAPPED = [turn("truncated" if i == 5 else "terminated" if i == 13 else "no") for i in range(24)]
"""24 steps of one environment: in 16 rows the first episode is forgotten, the second begins before what is kept, and
the third still runs."""


@pytest.mark.parametrize("strategy", EVEN)
def test_every_allowed_goal_is_drawn_and_equally_often(strategy):
    """Pearson's chi-square of the goals of every step, at the 0.1 % level over about 15 steps together."""
    replay, model = filled(1, 16, RUNNING_AND_WRAPPED, strategy)
    episodes = {model.frames[0][place].episode for _, place in model.steps()}
    assert episodes == {1, 2}
    batch = replay.sample(np.random.default_rng(0), (40_000,))
    places = batch.obs["observation"][:32_000, 1].astype(int)
    goals = batch.obs["desired_goal"][:32_000, 1].astype(int)
    for _, place in model.steps():
        allowed = sorted(goal for _, goal in allowed_goals(model, strategy, 0, place))
        counts = [int(((places == place) & (goals == goal)).sum()) for goal in allowed]
        assert sum(counts) == (places == place).sum() > 1000
        assert min(counts) > 0
        if len(counts) > 1:
            assert stats.chisquare(counts).pvalue > 1e-3 / 15


def later_goals(strategy):
    """Of a running episode of 10 steps: times of 40,000 relabeled steps and of their goals."""
    replay, _ = filled(1, 16, [turn("no")] * 10, strategy, k=10**6)
    batch = replay.sample(np.random.default_rng(0), (40_000,))
    return (batch.obs[key][:-1, 1].astype(int) for key in ("observation", "desired_goal"))


def test_the_goal_of_closest_is_the_nearest_of_eight_later_moments():
    """The goal is at place -1, so the earliest of 8 of ``m`` is nearest: the least is above j with (1 - j/m)^8."""
    places, goals = later_goals("closest")
    for place in range(10):
        m, of_place = 10 - place, goals[places == place]
        counts = np.bincount(of_place - place - 1, minlength=m)
        above = (1 - np.arange(m + 1) / m) ** 8
        expected = len(of_place) * (above[:-1] - above[1:])
        many = expected > 5
        np.testing.assert_allclose(counts[many], expected[many], atol=5 * np.sqrt(expected[many].max()))


@pytest.mark.parametrize(("k", "share"), [(0, 0), (1, 32), (4, 51), (8, 56)])
def test_of_every_batch_the_share_k_over_k_plus_one_is_relabelled(k, share):
    replay, _ = filled(2, 8, [turn("no", "no")] * 6, k=k)
    batch = replay.sample(np.random.default_rng(0), (5, 64))
    assert ((batch.obs["desired_goal"][..., 0] >= 0).sum(axis=1) == share).all()


def test_rewards_that_are_infinite_beyond_the_episode_do_not_leak_into_it():
    """The window of an n-step return is rectangular; what lies behind the end may be no number at all."""
    history = [turn("no"), turn("truncated"), turn("no")]
    replay, _ = filled(1, 16, history, n_steps=4)

    def picky(achieved, desired):
        same_episode = (achieved[:, 1] <= 2) == (desired[:, 1] <= 2)
        real = (achieved[:, 1] > 0) & (achieved[:, 1] != 3)  # neither an unwritten row nor an episode's first
        return np.where(same_episode & real, 1.0, np.inf).astype(np.float32)

    replay.goals = GoalFunctions(picky)
    batch = replay.sample(np.random.default_rng(0), (50,))
    assert np.isfinite(batch.reward).all()


@pytest.mark.parametrize(
    ("strategy", "shares", "size"),
    [
        ("desired", {"desired": 4}, 500),
        (MIXES[0], MIXES[0], 500),
        (MIXES[1], MIXES[1], 500),
        ({"future": 60, "desired": 40}, {"future": 60, "desired": 40}, 50),  # fewer transitions than turns
    ],
)
def test_strategies_have_their_shares_of_every_batch_and_desired_takes_that_of_any_step(strategy, shares, size):
    """The desired goals of the stored steps are (100 + environment, place), as in no achieved goal."""
    replay, model = filled(2, 16, [turn("no", "no")] * 5 + [turn("truncated", "no")] + [turn("no", "no")] * 6, strategy)
    ring, n_envs = replay.ring, 2
    for env in range(n_envs):
        times = np.arange(ring.oldest()[env], ring.head[env] + 1)
        ring.obs[replay.desired][ring.index(np.full(len(times), env), times)] = np.stack(
            [np.full(len(times), 100 + env), times], axis=1
        )
    goals = replay.sample(np.random.default_rng(0), (50, size)).obs["desired_goal"][:, : size * 4 // 5]
    is_desired = goals[..., 0] >= 100
    expected = size * 4 / 5 * shares["desired"] / sum(shares.values())
    assert (np.abs(is_desired.sum(axis=1) - expected) <= 2).all()
    steps = list(model.steps())
    stored = {(100 + env, int(ring.oldest()[env]) + place) for env, place in steps}
    drawn, counts = np.unique(goals[is_desired], axis=0, return_counts=True)
    assert {tuple(int(x) for x in goal) for goal in drawn} == stored
    assert stats.chisquare(counts).pvalue > 1e-3


def test_a_subclass_chooses_the_goals_of_whole_batches_also_of_a_mix():
    class Counted(HerReplayBuffer):
        sizes = []

        def goal_index(self, rng, env, time, step):
            self.sizes.append(len(env))
            return super().goal_index(rng, env, time, step)

    replay, _ = filled(1, 16, [turn("no", "no")] * 10, MIXES[0])
    counted = Counted(replay.ring, GAMMA, replay.config, replay.goals)
    goals = counted.sample(np.random.default_rng(0), (50,)).obs["desired_goal"]
    assert Counted.sizes == [40]
    assert np.array_equal(goals, replay.sample(np.random.default_rng(0), (50,)).obs["desired_goal"])


def test_a_mix_reads_the_counters_that_any_of_its_strategies_needs():
    for strategy, expected in zip(MIXES, [("until_end",), ("since_start", "until_end"), ()], strict=True):
        assert counters(HindsightConfig(goal_selection_strategy=strategy)) == expected


@pytest.mark.parametrize("strategy", [*STRATEGIES, *MIXES])
def test_a_restored_buffer_relabels_like_the_original(strategy):
    replay, _ = filled(1, 16, RUNNING_AND_WRAPPED, strategy)
    ring = make_ring(16, 1, GOAL_OBSERVATION, counters(replay.config))
    other = HerReplayBuffer(ring, GAMMA, replay.config, replay.goals)
    other.restore(replay.arrays())
    one, two = (buffer.sample(np.random.default_rng(2), (40,)) for buffer in (replay, other))
    for key in GOAL_OBSERVATION:
        np.testing.assert_array_equal(one.obs[key], two.obs[key])
    np.testing.assert_array_equal(one.reward, two.reward)


def test_a_ring_without_the_counters_of_the_strategy_is_refused():
    config = HindsightConfig(goal_selection_strategy="episode")
    for kept, lacking in (((), "since_start and until_end"), (("until_end",), "since_start")):
        with pytest.raises(ValueError, match=f"'episode' needs a ring that keeps {lacking}; make it with Ring"):
            HerReplayBuffer(make_ring(8, 1, GOAL_OBSERVATION, kept), GAMMA, config, GoalFunctions(reward))


@pytest.mark.parametrize(
    ("strategy", "n_counters"), [("random", 0), ("future", 1), ("final", 1), ("closest", 1), ("episode", 2)]
)
def test_a_row_takes_what_the_strategy_needs(strategy, n_counters):
    """Observations like parking-v0's: 18 numbers, two actions and a reward of 4 bytes each, and one byte for the kind."""
    box = gym.spaces.Box(-np.inf, np.inf, (6,), np.float64)
    space = gym.spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
    ring = make_ring(1000, 2, space, counters(HindsightConfig(goal_selection_strategy=strategy)), n_actions=2)
    needed = 1000 * (4 * (18 + 2 + 1) + 1)
    assert ring.nbytes == needed + 1000 * 4 * n_counters
    assert strategy == "episode" or ring.nbytes < 1.05 * needed


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"goal_selection_strategy": "furture"},
            "'furture' must be one of future, final, episode, random, closest, next_future",
        ),
        ({"goal_selection_strategy": {"furture": 1}}, "'furture' must be one of future, final"),
        (
            {"goal_selection_strategy": {"future": 0}},
            "goal_selection_strategy future=0 must be a whole number of at least 1",
        ),
        ({"goal_selection_strategy": {}}, "must have names of strategies as keys, such as"),
        ({"goal_selection_strategy": {reward: 1}}, "register_goal_strategy gives a function a name"),
        ({"n_sampled_goal": -1}, "n_sampled_goal=-1 must be a whole number of at least 0"),
        ({"n_sampled_goal": 1.5}, "n_sampled_goal=1.5 must be a whole number"),
        ({"n_sampled_goal": True}, "n_sampled_goal=True must be a whole number"),
        ({"copy_info_dict": 2}, "copy_info_dict=2 must be True or False"),
    ],
)
def test_impossible_settings_are_refused(settings, words):
    with pytest.raises(TypeError if "copy_info_dict" in settings else ValueError, match=words):
        HindsightConfig(**settings)


def any_of_the_episode(steps):
    return steps.integers(steps.first, steps.last + 1)


FUNCTIONS = {
    "final": lambda steps: steps.end(steps.time),
    "future": lambda steps: steps.integers(steps.time + 1, steps.last + 1),
    "episode": any_of_the_episode,
}


@register_goal_strategy("nearby")
def nearby(steps):
    """Of four later observations, takes the one whose achieved goal is closest to the goal."""
    times = steps.integers(steps.np.repeat(steps.time[:, None] + 1, 4, axis=1), steps.last[:, None] + 1)
    distance = steps.np.abs(steps.achieved(times) - steps.desired()[:, None]).sum(axis=-1)
    return steps.np.take_along_axis(times, distance.argmin(axis=1)[:, None], axis=1)[:, 0]


def test_a_strategy_of_the_users_own_sees_goals_and_is_known_by_its_name():
    named, _ = filled(1, 40, RUNNING_AND_WRAPPED, nearby)
    assert named.config.goal_selection_strategy == "nearby"
    later, _ = filled(1, 40, RUNNING_AND_WRAPPED, "future")
    distances = []
    for buffer in (named, later):
        buffer.config = dataclasses.replace(buffer.config, n_sampled_goal=10**6)
        plain = ReplayBuffer(buffer.ring, 0.9).sample(np.random.default_rng(0), (400,))
        batch = buffer.sample(np.random.default_rng(0), (400,))
        np.testing.assert_array_equal(batch.obs["observation"], plain.obs["observation"])
        distances.append(np.abs(batch.obs["desired_goal"] - plain.obs["desired_goal"])[:-1].mean())
    assert distances[0] < distances[1]


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("strategy", FUNCTIONS)
def test_a_function_as_strategy_draws_what_the_named_one_does(strategy, n_envs):
    history = RUNNING_AND_WRAPPED if n_envs == 1 else [turn("no", "no")] * 6
    named, _ = filled(n_envs, 16, history, strategy)
    own, _ = filled(n_envs, 16, history, FUNCTIONS[strategy])
    one, two = (buffer.sample(np.random.default_rng(0), (200,)) for buffer in (named, own))
    np.testing.assert_array_equal(one.obs["desired_goal"], two.obs["desired_goal"])
    np.testing.assert_array_equal(one.reward, two.reward)


def last_three_episodes(steps):
    begin = steps.first - 1
    for _ in range(2):
        begin = steps.begin(begin - 1)
    return steps.integers(begin + 1, steps.last + 1)


FOUR_EPISODES = [turn("truncated" if i in (3, 8) else "terminated" if i == 12 else "no") for i in range(17)]


@pytest.mark.parametrize("rows", [40, 12])
def test_a_strategy_of_the_last_three_episodes_is_one_function(rows):
    """With 12 rows the first episode is forgotten, and of the second the beginning."""
    replay, model = filled(1, rows, FOUR_EPISODES, last_three_episodes, k=10**6)
    batch = replay.sample(np.random.default_rng(0), (20_000,))
    places, goals = (batch.obs[key][:-1, 1].astype(int) for key in ("observation", "desired_goal"))
    for _, place in model.steps():
        number = model.frames[0][place].episode
        allowed = [i for i in model.kept(0) if number - 2 <= model.frames[0][i].episode <= number][1:]
        assert {*goals[places == place]} == {*allowed}


@pytest.mark.parametrize(
    ("chosen", "received"),
    [
        (lambda steps: steps.newest + 1, r"it returned \d+ where oldest is \d+ and newest is \d+"),
        (lambda steps: steps.oldest - 1, r"it returned \d+ where oldest is \d+ and newest is \d+"),
        (lambda steps: steps.last[1:], r"of shape \(32,\); it returned int64 of shape \(31,\)"),
        (lambda steps: steps.last + 0.0, r"it returned float64 of shape \(32,\)"),
    ],
)
def test_times_that_are_not_stored_are_refused(chosen, received):
    replay, _ = filled(1, 16, RUNNING_AND_WRAPPED, chosen)
    with pytest.raises(ValueError, match=f"must return whole numbers, times that are stored.*{received}"):
        replay.sample(np.random.default_rng(0), (40,))


def test_episodes_begin_and_end_where_they_are_stored():
    replay, model = filled(1, 12, FOUR_EPISODES, lambda steps: steps.last)
    seen = []
    replay.config = dataclasses.replace(
        replay.config, goal_selection_strategy=lambda steps: [seen.append(steps), steps.last][1]
    )
    replay.sample(np.random.default_rng(0), (400,))
    (steps,) = seen
    for time in model.kept(0):
        times = np.full(len(steps.time), time)
        episode = model.episode(0, time)
        assert (steps.begin(times)[0], steps.end(times)[0]) == (episode[0], episode[-1])


def test_of_the_goals_of_next_future_a_quarter_more_is_the_next_moment():
    """With ``m`` later moments the next one has the probability 1/4 + 3/4 1/m, and every other one 3/4 1/m."""
    places, goals = later_goals("next_future")
    for place in range(10):
        m, of_place = 10 - place, goals[places == place]
        counts = np.bincount(of_place - place - 1, minlength=m)
        expected = len(of_place) * (0.75 / m + 0.25 * (np.arange(m) == 0))
        assert len(counts) == m
        assert m == 1 or stats.chisquare(counts, expected).pvalue > 1e-4


def test_termination_is_computed_anew_where_the_environment_can_say():
    """After one step from place 0 to 1, terminated((0, 1), (0, 1)) holds, whereas the step itself did not terminate."""
    replay, _ = filled(1, 8, [turn("truncated")], ends=True)
    batch = replay.sample(np.random.default_rng(0), (10,))
    np.testing.assert_array_equal(batch.discount, [0.0] * 8 + [np.float32(GAMMA)] * 2)


def test_rewards_come_from_one_call_a_sample():
    replay, _ = filled(2, 8, [turn("no", "no")] * 6)
    sizes = []
    replay.goals = GoalFunctions(lambda a, d: sizes.append(len(a)) or reward(a, d))
    replay.sample(np.random.default_rng(0), (3, 10))
    assert sizes == [24]


@pytest.mark.parametrize("strategy", [*STRATEGIES, *GoalSelectionStrategy])
def test_a_strategy_is_given_by_string_or_enum(strategy):
    chosen = HindsightConfig(goal_selection_strategy=strategy).goal_selection_strategy
    assert chosen in STRATEGIES or (strategy == "desired" and dict(chosen.shares) == {"desired": 1})


def test_after_the_end_of_an_episode_a_reward_gets_the_info_of_the_step():
    infos = np.array([{"x": 1}, None, {"x": 2}, {"x": 3}], object)
    replay = SimpleNamespace(
        ring=SimpleNamespace(index=lambda env, time: time),
        n_steps=2,
        infos=infos,
        goals=GoalFunctions(lambda infos: [info["x"] for info in infos], None),
    )
    reward, _ = HerReplayBuffer.functions_of(replay, np.array([0, 0]), np.array([0, 2]))
    assert reward() == [1, 1, 2, 3]
