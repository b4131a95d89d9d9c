"""What an agent owns and counts: steps, updates, episodes, parameters, environments."""

import threading

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu import callbacks
from rejeu.checkpoints import model_files
from rejeu.core.errors import CheckpointError
from rejeu.envs.make import InProcess
from tests.environments import Counter, Reach, Sampled
from tests.helpers import assert_same_parameters, count_updates, same_parameters, small_sac
from tests.tiers import exhaustive, only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

NEVER = 10**6
"""``learning_starts`` of agents that only act at random."""


def counters(n, lengths=(5,), ends="truncated"):
    return InProcess([Counter(lengths, ends) for _ in range(n)], seed=0)


@pytest.fixture(scope="module")
def agent():
    """An agent that tests may look at, and must not change."""
    return small_sac(Counter((5,))).learn(20)


# Steps.


@pytest.mark.parametrize(("n_envs", "total", "taken"), [(1, 17, 17), (3, 17, 18), (3, 18, 18), (8, 3, 8)])
def test_learn_ends_with_the_turn_that_reaches_the_number_of_steps(n_envs, total, taken):
    agent = small_sac(counters(n_envs), learning_starts=NEVER).learn(total)
    assert agent.num_timesteps == agent.replay_buffer.size() == taken
    agent.learn(total)
    assert agent.replay_buffer.size() == 2 * taken


@pytest.mark.parametrize("settings", [{"n_steps": 5}, {"n_episodes": 1, "n_steps": 9}])
def test_on_policy_learning_ends_with_a_rollout_also_after_one_that_was_stopped(settings):
    """Rollouts of 10 steps: 5 of each of two environments, whose episodes have 5 steps."""
    agent = rejeu.A2C("MlpPolicy", counters(2), seed=0, **settings)
    turns = []
    agent.learn(11, lambda agent, turn: turns.append((turn.step, turn.rollout_ended)))
    assert [step for step, rollout_ended in turns if rollout_ended] == [10, 20]
    assert turns[-1] == (20, True)
    agent.learn(20, lambda agent, turn: turn.step < 24, reset_num_timesteps=False)
    assert agent.learn(1, reset_num_timesteps=False).num_timesteps == 30


@pytest.mark.parametrize("total", [0, -1, 2.5, "many", True, None])
def test_an_impossible_number_of_steps_is_refused(agent, total):
    words = (
        "learn needs total_timesteps" if total is None else "total_timesteps=.* must be a whole number of at least 1"
    )
    with pytest.raises(ValueError, match=words):
        agent.learn(total)


def test_minutes_end_a_run():
    agent = small_sac(counters(1), learning_starts=NEVER).learn(minutes=0.2 / 60)
    assert 1 < agent.num_timesteps < 10**6


# Updates.


@pytest.mark.parametrize("n_envs", only([3], [1, 3, 8]))
@pytest.mark.parametrize(
    ("train_freq", "gradient_steps", "expected"),
    [
        pytest.param(1, 1, lambda steps: steps, marks=exhaustive),
        (4, 2, lambda steps: 2 * (steps // 4)),
        pytest.param(1, 3, lambda steps: 3 * steps, marks=exhaustive),
        (16, -1, lambda steps: None),
    ],
)
def test_gradient_steps_follow_the_steps_after_learning_starts(n_envs, train_freq, gradient_steps, expected):
    """72 steps, of which the first 8 (9 for 3 environments) are not learnt from; 64 (63) remain."""
    starts = 9 if n_envs == 3 else 8
    agent = small_sac(
        counters(n_envs), train_freq=train_freq, gradient_steps=gradient_steps, learning_starts=starts, batch_size=2
    )
    calls = count_updates(agent)
    agent.learn(72)
    steps = 72 - starts
    if gradient_steps == -1:  # as many as steps passed since the last time, in all no more than steps and lacking < 16
        assert steps - 16 < sum(calls) <= steps
    else:
        assert sum(calls) == expected(steps)
    assert agent.n_updates == sum(calls)


@pytest.mark.parametrize(("gradient_steps", "updates"), [(-1, 20), (3, 6)])
def test_learning_by_episodes_takes_as_many_gradient_steps_as_environment_steps_or_a_number_each(
    gradient_steps, updates
):
    """Episodes of 5 steps; learning starts after 10 steps and, at the end of each second episode, takes 10 steps."""
    agent = small_sac(counters(1), train_freq=(2, "episode"), gradient_steps=gradient_steps, learning_starts=10)
    calls = count_updates(agent)
    agent.learn(34)
    assert sum(calls) == updates
    assert max(calls) <= 16


def test_nothing_is_learnt_before_learning_starts():
    agent = small_sac(counters(1), learning_starts=20)
    before = agent.get_parameters()
    agent.learn(20)
    assert all(np.array_equal(value, before[name]) for name, value in agent.get_parameters().items())
    agent.learn(1)
    assert agent.n_updates == 1


# Actions.


def test_training_actions_respect_asymmetrical_bounds_and_reach_both_ends():
    env = Counter((5,), low=[2.0, -1.0], high=[6.0, -0.5])
    small_sac(env, learning_starts=150).learn(300)
    actions = np.stack(env.actions)
    assert (actions >= [2.0, -1.0]).all()
    assert (actions <= [6.0, -0.5]).all()
    random = actions[:150]
    assert (random.min(axis=0) < [2.2, -0.97]).all()
    assert (random.max(axis=0) > [5.8, -0.53]).all()
    assert actions.dtype == np.float32


def test_what_is_stored_is_the_action_before_scaling():
    env = Counter((5,), low=[2.0], high=[6.0])
    agent = small_sac(env, learning_starts=NEVER).learn(5)
    stored = agent.replay_buffer.ring.action[:5, 0]
    np.testing.assert_allclose(np.stack(env.actions)[:, 0], 4.0 + 2.0 * stored, rtol=1e-6)


def test_the_first_actions_are_random_and_later_ones_the_policys():
    """The policy's actions hardly vary when its standard deviation is e^-20."""
    env = Counter((50,))
    agent = small_sac(env, learning_starts=20, learning_rate=0.0)
    head = agent.get_parameters()
    head["actor.head.weight"][:] = 0.0
    head["actor.head.bias"][:] = [0.5, -20.0]
    agent.set_parameters(head)
    agent.learn(40)
    actions = np.stack(env.actions)[:, 0]
    assert actions[:20].std() > 0.3
    np.testing.assert_allclose(actions[20:], np.tanh(0.5), atol=1e-6)


# What is stored.


@pytest.mark.parametrize(("ends", "discount"), [("truncated", 0.9), ("terminated", 0.0)])
def test_a_time_limit_still_bootstraps_and_a_termination_does_not(ends, discount):
    agent = small_sac(counters(3, (4,), ends), learning_starts=NEVER, gamma=0.9).learn(30)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (500,))
    last = batch.obs[:, 1] == 3
    assert last.any()
    np.testing.assert_array_equal(batch.discount[last], np.float32(discount))
    np.testing.assert_array_equal(batch.discount[~last], np.float32(0.9))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_stored_transitions_are_consecutive_moments_of_one_episode(n_envs):
    agent = small_sac(counters(n_envs, (4, 2, 7)), learning_starts=NEVER).learn(50)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (500,))
    np.testing.assert_array_equal(batch.next_obs[:, 0], batch.obs[:, 0])  # the episode
    np.testing.assert_array_equal(batch.next_obs[:, 1], batch.obs[:, 1] + 1)  # the time
    np.testing.assert_array_equal(batch.next_obs[:, 2], batch.obs[:, 2])  # drawn at its beginning
    np.testing.assert_array_equal(batch.reward, 100 * batch.obs[:, 0] + batch.obs[:, 1])


# Episodes.


def test_episodes_are_recorded_with_return_and_length():
    agent = small_sac(counters(2, (3, 5)), learning_starts=NEVER).learn(32)
    assert agent.history["length"].tolist() == [3, 3, 5, 5, 3, 3, 5, 5]
    assert agent.history["return"].tolist() == [3, 3, 510, 510, 603, 603, 1510, 1510]
    assert agent.history["env"].tolist() == [0, 1] * 4
    assert agent.history["step"].tolist() == [6, 6, 16, 16, 22, 22, 32, 32]


def test_the_window_of_statistics_keeps_the_last_episodes():
    agent = small_sac(counters(1, (2,)), learning_starts=NEVER, stats_window_size=3).learn(20)
    assert [(e["r"], e["l"]) for e in agent.ep_info_buffer] == [(100 * 2 * k + 1, 2) for k in (7, 8, 9)]
    assert agent.ep_info_buffer.maxlen == 3
    assert agent.statistics()["rollout/ep_rew_mean"] == pytest.approx(1601.0)
    assert agent.statistics()["rollout/ep_len_mean"] == 2.0
    assert "rollout/success_rate" not in agent.statistics()
    reaching = small_sac(Reach()).learn(40)
    assert len(reaching.ep_success_buffer) == 4
    row = reaching.statistics()
    assert row["rollout/success_rate"] == np.mean(reaching.ep_success_buffer)
    assert {"train/critic_loss", "train/actor_loss", "train/ent_coef", "train/n_updates"} <= set(row)
    assert all(isinstance(value, int | float) for value in row.values())


@pytest.mark.parametrize("window", [1, 200])
def test_best_weights_are_kept_from_the_20th_episode_on_whatever_the_window_of_statistics(window):
    """Returns grow with the episode, so the last 20 are always the best so far: at the 25th, those of episodes 5 to 24."""
    agent = small_sac(counters(1, (2,)), learning_starts=NEVER, stats_window_size=window).learn(2 * 19)
    assert agent.best is None
    agent.learn(2 * 6)
    assert agent.best.score == pytest.approx(np.mean([2 * 100 * k + 1 for k in range(5, 25)]))
    assert (agent.best.by, agent.best.step) == ("training", 50)


def test_with_a_window_of_one_the_weights_of_the_best_single_episode_are_kept():
    agent = small_sac("rejeu/Ball-v0", learning_starts=8, best_window=1)
    kept = []
    agent.learn(300, lambda agent, turn: kept.append(agent.best.step) if turn.episodes else None)
    records = agent.history.records()
    assert 1 < len(records) < len(agent.history)
    assert sorted({*kept}) == [episode.step for episode in records]
    assert agent.best.score == agent.history.best_return == records[-1].episode_return


def test_of_episodes_that_end_together_the_best_counts():
    """The first environment returns twice what the second does, and is booked before it."""

    class Twice(gym.RewardWrapper):
        def reward(self, reward):
            return 2 * reward

    agent = small_sac(InProcess([Twice(Counter((2,))), Counter((2,))], seed=0), learning_starts=NEVER, best_window=1)
    agent.learn(4)
    assert agent.history["return"].tolist() == [2.0, 1.0]
    assert agent.best.score == 2.0


def test_the_best_return_stands_in_every_row_and_records_can_be_printed(capsys):
    agent = small_sac(counters(1, (2,)), learning_starts=NEVER).learn(6, callbacks.print_records)
    assert capsys.readouterr().out.splitlines() == [
        f"\N{NORTH EAST ARROW} return {value:.2f} at step {step}" for value, step in ((1, 2), (201, 4), (401, 6))
    ]
    assert agent.statistics()["rollout/ep_rew_best"] == 401.0


# Callbacks.


@pytest.mark.parametrize("number", [int, np.float64])
def test_only_false_stops_training_at_once_and_learning_can_go_on(number):
    seen = []
    agent = small_sac(counters(3), learning_starts=NEVER)
    answers = iter([None, True, 0, []])
    agent.learn(10, callback=lambda a, progress: seen.append((a is agent, progress.step)) or next(answers))
    assert seen == [(True, 3), (True, 6), (True, 9), (True, 12)]
    agent = small_sac(counters(1), learning_starts=NEVER)
    assert agent.learn(10, callback=lambda a, p: number(p.step) < 4).num_timesteps == 4
    assert agent.learn(10, reset_num_timesteps=False).num_timesteps == 14


# Predictions.

SPACES = {
    "box": gym.spaces.Box(-1.0, 1.0, (2, 3)),
    "discrete": gym.spaces.Discrete(4, start=2),
    "many": gym.spaces.MultiDiscrete([2, 3]),
    "bits": gym.spaces.MultiBinary(3),
    "image": gym.spaces.Box(0, 255, (4, 4, 1), np.uint8),
}
SPACES["tuple"] = gym.spaces.Tuple([SPACES["discrete"], SPACES["box"]])
SPACES["dict"] = gym.spaces.Dict({"z": SPACES["tuple"], "a": SPACES["bits"], "m": SPACES["many"]})


@pytest.mark.parametrize("name", only(["dict"], ["discrete", "image", "dict"]))
def test_any_observation_can_be_predicted_on_and_learnt_from(name):
    space = SPACES[name]
    env = Sampled(space)
    agent = small_sac(env, learning_starts=4).learn(8)
    assert agent.n_updates == 4
    space.seed(0)
    samples = [space.sample() for _ in range(3)]
    single, state = agent.predict(samples[0], deterministic=True)
    assert (single.shape, state) == ((1,), None)
    batch = gym.vector.utils.concatenate(space, samples, gym.vector.utils.create_empty_array(space, 3))
    together, _ = agent.predict(batch, deterministic=True)
    assert together.shape == (3, 1)
    np.testing.assert_allclose(together[0], single, atol=1e-6)


def test_deterministic_predictions_repeat_and_others_vary(agent):
    obs = np.ones((4, 3), np.float32)
    fixed = [agent.predict(obs, deterministic=True)[0] for _ in range(2)]
    drawn = [agent.predict(obs)[0] for _ in range(2)]
    np.testing.assert_array_equal(*fixed)
    assert (drawn[0] != drawn[1]).all()
    assert len(np.unique(drawn[0])) == 4
    for given in (obs[0].tolist(), obs.tolist()):  # lists of numbers
        np.testing.assert_array_equal(agent.predict(given, deterministic=True)[0].ravel()[0], fixed[0][0, 0])
    assert repr(agent) == "<rejeu.SAC on Counter, 20 steps, 12 updates>"


@pytest.mark.parametrize(
    ("obs", "words"),
    [
        (np.zeros(4), r"observation has shape \(4,\), expected \(3,\), or a batch of it"),
        (np.zeros((2, 2, 3)), r"observation has shape \(2, 2, 3\), expected \(3,\)"),
        (np.zeros(()), r"observation has shape \(\), expected \(3,\)"),
        ({"a": np.zeros(3)}, "observation has the structure .* expected"),
        ([0.0, 0.0], r"has shape \(2,\), expected \(3,\)"),
        ([[0.0], [0.0, 1.0]], "has the structure list, expected Box"),
    ],
)
def test_an_observation_of_another_shape_is_refused(agent, obs, words):
    with pytest.raises(ValueError, match=words):
        agent.predict(obs)


def test_an_observation_without_a_key_is_refused():
    agent = small_sac(Reach())
    with pytest.raises(ValueError, match="observation has the structure"):
        agent.predict({"observation": np.zeros(1), "achieved_goal": np.zeros(1)})
    with pytest.raises(ValueError, match=r"observation of 'desired_goal' has shape \(2,\)"):
        agent.predict({"observation": np.zeros(1), "achieved_goal": np.zeros(1), "desired_goal": np.zeros(2)})


# Parameters.


def test_parameters_come_back_as_they_were_set_as_a_whole_in_part_and_from_a_file(tmp_path):
    one, two = small_sac(counters(1), seed=0), small_sac(counters(1), seed=1)
    assert not same_parameters(one, two)
    two.get_parameters()["actor.head.bias"][:] = 99.0  # a copy
    path = two.save(tmp_path / "model")
    two.set_parameters(before := one.get_parameters())
    assert_same_parameters(one, two)
    one.set_parameters({"log_alpha": np.float32(-3.0)}, exact_match=False)
    after = one.get_parameters()
    assert after.pop("log_alpha") == -3.0
    assert all(np.array_equal(value, before[name]) for name, value in after.items())
    one.set_parameters(path)
    assert (np.abs(one.get_parameters()["actor.head.bias"]) < 1).all()
    assert_same_parameters(one, rejeu.load(path))
    one.set_parameters(two.get_parameters())
    obs = np.ones((3, 3), np.float32)
    np.testing.assert_array_equal(*(a.predict(obs, deterministic=True)[0] for a in (one, two)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda p: p.update({"actor.head.bias": np.zeros(9, np.float32)}),
            r"actor.head.bias is float32\[9\], expected",
        ),
        (
            lambda p: p.update({"actor.head.bias": np.zeros(2)}),
            r"actor.head.bias is float64\[2\], expected float32\[2\]",
        ),
        (lambda p: p.pop("actor.head.bias"), "has no actor.head.bias"),
        (lambda p: p.update(more=np.zeros(1)), "has more, which this agent does not have"),
    ],
)
def test_parameters_that_do_not_fit_leave_the_agent_unchanged(change, words):
    agent, donor = small_sac(counters(1), seed=0), small_sac(counters(1), seed=1)
    before = agent.get_parameters()
    parameters = donor.get_parameters()
    change(parameters)
    with pytest.raises(CheckpointError, match=words):
        agent.set_parameters(parameters)
    assert all(np.array_equal(value, before[name]) for name, value in agent.get_parameters().items())


# Loading and going on.


def test_another_number_of_environments_starts_an_empty_buffer_and_collects_learning_starts_steps_before_it_learns():
    """Batches would otherwise be copies of the first few steps."""
    agent = small_sac(Counter((5,))).learn(20)
    starts, n_updates = agent.config.learning_starts, agent.n_updates
    agent.set_env(counters(2))
    assert (agent.n_envs, agent.replay_buffer.size()) == (2, 0)
    agent.learn(starts, reset_num_timesteps=False)
    assert (agent.n_updates, agent.replay_buffer.size()) == (n_updates, starts)
    agent.learn(4, reset_num_timesteps=False)
    assert agent.n_updates == n_updates + 4


def test_after_loading_the_buffer_too_learning_goes_on_at_once(agent, tmp_path):
    buffer = agent.save_replay_buffer(tmp_path / "buffer")
    loaded = rejeu.SAC.load(agent.save(tmp_path / "model"), env=Counter((5,)))
    loaded.load_replay_buffer(buffer)
    loaded.learn(3)
    assert loaded.n_updates == 15
    assert loaded.replay_buffer.size() == 23


def test_an_agent_without_environment_predicts_and_says_what_learning_needs(agent, tmp_path):
    loaded = rejeu.SAC.load(agent.save(tmp_path / "model"))
    assert loaded.get_env() is None
    assert loaded.predict(np.zeros(3))[0].shape == (1,)
    for call in (lambda: loaded.learn(1), lambda: loaded.evaluate(), lambda: loaded.load_replay_buffer("x")):
        with pytest.raises(ValueError, match=r"no environment.*give one"):
            call()
    loaded.set_env(Counter((5,)))
    assert loaded.learn(2).num_timesteps == 2


# Environments.


def test_another_environment_of_the_same_spaces_keeps_the_buffer():
    agent = small_sac(counters(1), learning_starts=NEVER).learn(7)
    other = Counter((2,))
    agent.set_env(other)
    agent.learn(4)
    assert agent.replay_buffer.size() == 11
    assert other.episode == 2
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (300,))
    np.testing.assert_array_equal(batch.next_obs[:, 1], batch.obs[:, 1] + 1)


def test_an_environment_of_other_spaces_is_refused_and_the_old_one_kept():
    agent = small_sac(counters(1), learning_starts=NEVER)
    old = agent.env
    with pytest.raises(ValueError, match="the new environment has the observation space"):
        agent.set_env(Reach())
    with pytest.raises(ValueError, match="the new environment has the action space"):
        agent.set_env(Counter(low=[-3.0], high=[3.0]))
    assert agent.env is old


def test_an_agent_learns_in_one_thread_at_a_time():
    agent, failed = small_sac(counters(1), learning_starts=NEVER), []

    def learn():
        with pytest.raises(RuntimeError, match="learning already, in another thread") as caught:
            agent.learn(5)
        failed.append(caught.value)

    def callback(agent, progress):
        thread = threading.Thread(target=learn)
        thread.start()
        thread.join()

    assert agent.learn(3, callback).num_timesteps == 3
    assert len(failed) == 3
    assert agent.learn(2, reset_num_timesteps=False).num_timesteps == 5


def test_hindsight_rewards_come_from_the_new_environment():
    class Generous(Reach):
        def compute_reward(self, achieved, desired, info):
            return np.full(np.shape(achieved)[:-1], 7.0, np.float32)

    agent = small_sac(Reach(), replay_buffer_class=rejeu.HerReplayBuffer, learning_starts=NEVER).learn(20)
    agent.set_env(Generous())
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (10,))
    np.testing.assert_array_equal(batch.reward[:8], 7.0)


def test_action_noise_is_added_and_clipped():
    """Without it the policy's actions are tanh(0.5); with a mean of 3 they all become 1, the upper bound."""
    env = Counter((50,))
    agent = small_sac(env, learning_starts=0, learning_rate=0.0, action_noise=rejeu.NormalActionNoise([3.0], [0.1]))
    agent.learn(5)
    np.testing.assert_array_equal(np.stack(env.actions), 1.0)


def test_a_loaded_agent_evaluates_where_it_was_trained(tmp_path):
    """Spaces of three dimensions show that the keyword argument was kept: the usual ball has two."""
    env = rejeu.make_vector("rejeu/Ball-v0", 2, "gymnasium", seed=0, dimension=3)
    small_sac(env).save(tmp_path / "best")
    agent = rejeu.load(tmp_path)
    assert agent.env is None
    assert agent.observation_space.shape == (3,)
    assert len(agent.evaluate(2, seed=0).returns) == 2
    agent.save(tmp_path / "again")
    assert len(rejeu.load(tmp_path / "again").evaluate(1, seed=0).returns) == 1


@pytest.mark.parametrize(
    "said",
    [
        None,
        3,
        {"env_id": "evil:Pendulum-v1", "env_kwargs": {}},
        {"env_id": "Pendulum-v1", "env_kwargs": {"g": "evil:x"}},
        {"env_id": "Pendulum-v1", "env_kwargs": {"g": 1e9}},
        {"env_id": "Pendulum-v1"},
    ],
)
def test_a_file_names_no_environment_that_is_imported(said):
    assert model_files.trained_on({"made_from": said}) is None


def test_an_agent_of_an_environment_that_was_given_has_none_after_loading(tmp_path):
    path = small_sac(gym.make("Pendulum-v1")).save(tmp_path / "agent")
    with pytest.raises(ValueError, match="has no environment; give one"):
        rejeu.load(path).evaluate(1)
    (empty := tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="is a folder without a model"):
        rejeu.load(empty)
