"""Vector environments that reset themselves: what agents make of them, and what the wrappers refuse."""

import math

import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.core import checkpoint
from rejeu.core.errors import BadEnvironmentError, CheckpointError
from rejeu.sb3.common.env_util import make_vec_env
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.running_mean_std import RunningMeanStd
from rejeu.sb3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    is_vecenv_wrapped,
    sync_envs_normalization,
    unwrap_vec_wrapper,
)
from rejeu.training.learner import Readings
from tests.bad_environments import Good, SameArray
from tests.environments import Reach
from tests.golden.vec_env_script import Walk
from tests.logs.test_video import Lamp

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [4]}, "seed": 0}


class Doubled(VecEnvWrapper):
    """A wrapper as a user writes it: observations doubled, rewards made negative."""

    def reset(self):
        return 2 * self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = 2 * info["terminal_observation"]
        return 2 * obs, -rewards, dones, infos


class Forgetful(VecEnvWrapper):
    """Says nothing of what an episode ended in, or shows it as it was."""

    def __init__(self, venv, forget):
        self.forget = forget
        space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        super().__init__(venv, venv.observation_space if forget else space)

    def reset(self):
        return self.shown(self.venv.reset())

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if self.forget:
                info.pop("terminal_observation", None)
        return self.shown(obs), rewards, dones, infos

    def shown(self, obs):
        return obs if self.forget else obs[:, :2]


class Batch(VecEnv):
    """A simulator of many environments at once, derived from the base alone: counts up to its limits."""

    limits = np.array([2, 3])

    def __init__(self):
        super().__init__(2, gym.spaces.Box(-np.inf, np.inf, (3,), np.float32), gym.spaces.Discrete(2))
        self.closed = False

    def observe(self):
        return np.stack([self.time, 7 * self.time, np.arange(2)], axis=1).astype(np.float32)

    def reset(self):
        self.time = np.zeros(2, int)
        return self.observe()

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        self.time += 1
        dones = self.time == self.limits
        last, infos = self.observe(), [{}, {}]
        for i in np.flatnonzero(dones):
            infos[i] = {"terminal_observation": last[i], "TimeLimit.truncated": i == 1}
        rewards = self.time.astype(np.float64)
        self.time[dones] = 0
        return self.observe(), rewards, dones, infos

    def close(self):
        self.closed = True

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name) for _ in (range(2) if indices is None else indices)]

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False, False]


def walks(n=2, wrap=Monitor):
    return DummyVecEnv([lambda i=i: wrap(Walk(i)) for i in range(n)])


def replayed(env, steps=60):
    """Returns what DQN stores of an environment: a large sample of transitions."""
    agent = rejeu.DQN("MlpPolicy", env, learning_starts=1000, **SMALL).learn(steps)
    assert agent.replay_buffer.size() == steps
    return agent.replay_buffer.sample(np.random.default_rng(0), (500,))


def taught(agent):
    """Replaces the gradient by nothing; returns a list that will hold the rollouts."""
    rollouts = []

    def update(state, batch, clock):
        rollouts.append([jax.tree.map(np.array, part) for part in batch[:5]])
        return state, Readings((), np.zeros(1)), None

    agent.learner.update = update
    return rollouts


def rolled(env, steps=60):
    """Returns what PPO learns from, flattened over steps and environments."""
    agent = rejeu.PPO("MlpPolicy", env, n_steps=steps // env.num_envs, batch_size=steps, **SMALL)
    rollouts = taught(agent)
    agent.learn(steps)
    (batch,) = rollouts
    return rejeu.core.algorithm.Rollout(*(part.reshape(-1, *part.shape[2:]) for part in batch), *[None] * 5)


VECTORS = {
    "dummy": (walks, 1.0),
    "user's wrapper": (lambda: Doubled(walks()), 2.0),
    "wrapped wrapper": (lambda: VecCheckNan(VecMonitor(walks())), 1.0),
    "user's vector": (Batch, 1.0),
    "subclass": (lambda: type("Mine", (DummyVecEnv,), {})([lambda: Walk(0), lambda: Walk(1)]), 1.0),
}


@pytest.mark.parametrize("collect", [replayed, rolled])
@pytest.mark.parametrize("name", VECTORS)
def test_successors_are_what_an_episode_ended_in_not_the_next_one_s_beginning(name, collect):
    make, scale = VECTORS[name]
    batch = collect(make())
    np.testing.assert_array_equal(batch.next_obs[:, 0], batch.obs[:, 0] + scale)
    # the environment of rank 0 terminates at its limit, that of rank 1 is truncated
    limit = 2 if name == "user's vector" else 3
    ends = {discount == 0.0: set() for discount in batch.discount} | {True: set()}
    for obs, discount in zip(batch.next_obs, batch.discount, strict=True):
        ends[discount == 0.0].add(float(obs[0]) / scale)
    assert ends[True] == {limit}
    assert limit + 1 in ends[False]
    assert np.sign(batch.reward).tolist() == [-1.0 if name == "user's wrapper" else 1.0] * len(batch.reward)


def test_normalised_successors_are_those_of_the_episode_too():
    env = VecNormalize(walks(), clip_obs=100.0)
    batch = replayed(env)
    # time is scaled by statistics that move, so only the order is left of it
    assert (batch.next_obs[:, 0] > batch.obs[:, 0] - 0.5).all()
    assert 0 < (batch.discount == 0).mean() < 0.5


@pytest.mark.parametrize(("forget", "said"), [(True, "no 'terminal_observation'"), (False, r"shape \(3,\).*\(2,\)")])
def test_a_vector_that_hides_what_episodes_end_in_is_an_error(forget, said):
    agent = rejeu.DQN("MlpPolicy", Forgetful(walks(), forget), **SMALL)
    with pytest.raises(BadEnvironmentError, match=said):
        agent.learn(20)


def test_the_last_observation_of_an_episode_outlasts_an_environment_that_writes_into_one_array():
    vectors = [DummyVecEnv([kind]) for kind in (Good, SameArray)]
    for vector in vectors:
        vector.seed(3)
        vector.reset()
    ends = []
    while not ends:
        infos = [vector.step(np.zeros((1, *vector.action_space.shape), np.float32))[3][0] for vector in vectors]
        ends = [info["terminal_observation"] for info in infos if "terminal_observation" in info]
    np.testing.assert_array_equal(*ends)


def test_returns_are_counted_beneath_wrappers_that_change_rewards():
    env = VecNormalize(walks())
    agent = rejeu.DQN("MlpPolicy", env, learning_starts=1000, **SMALL).learn(24)
    # Walk pays 1 + 2 + 3, with rank 1 in four steps 1.25 + 2.25 + 3.25 + 4.25
    assert {(e["r"], e["l"]) for e in agent.ep_info_buffer} == {(6.0, 3), (11.0, 4)}
    assert rejeu.evaluate_policy(agent, env, 2) == (8.5, 2.5)
    assert rejeu.evaluate_policy(agent, env, 3, return_episode_rewards=True) == ([6.0, 11.0, 11.0], [3, 4, 4])
    rejeu.evaluate_policy(agent, env, 2, reward_threshold=8.4)
    with pytest.raises(AssertionError, match="not above"):
        rejeu.evaluate_policy(agent, env, 2, reward_threshold=8.5)
    assert sorted(agent.evaluate(2, env=env).returns) == [6.0, 11.0]
    plain = rejeu.DQN("MlpPolicy", Doubled(walks(wrap=lambda env: env)), learning_starts=1000, **SMALL).learn(24)
    assert {e["r"] for e in plain.ep_info_buffer} == {-6.0, -11.0}


def test_an_agent_of_scaled_observations_is_not_shown_raw_ones(tmp_path):
    agent = rejeu.DQN("MlpPolicy", VecNormalize(make_vec_env("CartPole-v1")), **SMALL)
    with pytest.raises(ValueError, match="evaluated in one that has the same statistics"):
        agent.evaluate(1, env="CartPole-v1")
    with pytest.raises(ValueError, match="wrapped in VecNormalize, which a new one would not have"):
        rejeu.record_video(agent, tmp_path / "video")


def test_an_agent_gives_back_the_vector_it_was_given():
    env = VecNormalize(walks())
    agent = rejeu.DQN("MlpPolicy", env, **SMALL)
    assert agent.get_env() is env
    assert agent.get_vec_normalize_env() is env
    assert agent.env.venv is env
    dummy = walks()
    agent.set_env(dummy)
    assert agent.get_env() is dummy
    assert agent.get_vec_normalize_env() is None
    assert agent.get_env().get_attr("rank") == [0, 1]


def test_environments_of_envpool_are_returned_as_a_vector_without_access_to_single_ones():
    agent = rejeu.DQN("MlpPolicy", rejeu.make_vector("CartPole-v1", 1, "envpool"), **SMALL)
    env = agent.get_env()
    assert env.reset().shape == (1, 4)
    assert len(env.step([0])) == 4
    assert env.env_is_wrapped(Monitor) == [False]
    assert not env.has_attr("spec")
    with pytest.raises(AttributeError, match=r"accessed; give the agent gymnasium\.make"):
        env.env_method("render")


def test_learning_begins_new_episodes_after_the_vector_was_stepped_by_hand():
    env = walks()
    agent = rejeu.DQN("MlpPolicy", env, learning_starts=1000, **SMALL).learn(2)
    env.reset()
    env.step([0, 0])
    env.step([0, 0])
    agent.learn(12)
    assert agent.history["length"].tolist() == [3, 4, 3]
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (200,))
    np.testing.assert_array_equal(batch.next_obs[:, 0], batch.obs[:, 0] + 1)


def test_evaluating_leaves_a_given_vector_open():
    env = Batch()
    agent = rejeu.DQN("MlpPolicy", Batch(), **SMALL)
    assert agent.evaluate(2, env=env).returns.tolist() == [3.0, 6.0]
    assert not env.closed


def test_rollouts_of_whole_episodes_need_no_wrapped_environment_to_wait():
    agent = rejeu.PPO("MlpPolicy", Doubled(walks(1)), n_episodes=2, **SMALL)
    taught(agent)
    assert agent.learn(12).history["length"].tolist() == [3, 3, 3, 3]


def test_masks_are_found_in_a_vector():
    class Masked(Walk):
        def action_masks(self):
            return np.array([self.time % 2 == 0, True])

    agent = rejeu.MaskablePPO("MlpPolicy", make_vec_env(Masked, n_envs=2), n_steps=8, batch_size=16, **SMALL)
    taught(agent)
    assert agent.learn(16).num_timesteps == 16
    wrapped = rejeu.MaskablePPO("MlpPolicy", Doubled(make_vec_env(Masked, 2)), n_steps=8, batch_size=16, **SMALL)
    assert wrapped.learn(16).num_timesteps == 16


def test_hindsight_works_in_wrapped_vectors_and_refuses_scaled_goals():
    def make(wrap):
        env = wrap(DummyVecEnv([Reach, Reach]))
        return rejeu.SAC(
            "MultiInputPolicy", env, replay_buffer_class=rejeu.HerReplayBuffer, learning_starts=99, **SMALL
        )

    agent = make(VecMonitor).learn(60)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (300,))
    reached = np.abs(batch.next_obs["achieved_goal"] - batch.obs["desired_goal"])[:, 0] < 0.5
    np.testing.assert_array_equal(batch.reward, reached - 1.0)
    assert 0.05 < reached.mean() < 0.95
    with pytest.raises(ValueError, match="normalize=True"):
        make(VecNormalize)


def test_wrappers_ask_their_environments_what_they_do_not_know():
    env = Doubled(VecMonitor(walks()))
    assert env.episode_count == 0
    assert env.get_attr("rank") == [0, 1]
    assert env.get_attr("rank", 1) == [1]
    env.set_attr("scale", 3.0, indices=[1])
    assert env.get_attr("scale") == [1.0, 3.0]
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit, indices=0) == [False]
    assert env.has_attr("rank")
    assert not env.has_attr("rang")
    assert env.seed(4) == [4, 5]
    assert isinstance(env.unwrapped, DummyVecEnv)
    assert unwrap_vec_wrapper(env, VecMonitor) is env.venv
    assert is_vecenv_wrapped(env, VecMonitor)
    assert not is_vecenv_wrapped(env, VecNormalize)
    with pytest.raises(AttributeError, match="nothing_like_it"):
        env.nothing_like_it  # noqa: B018


def test_wrappers_wrap_vectors_only():
    with pytest.raises(TypeError, match=r"got Walk; try DummyVecEnv"):
        VecMonitor(Walk())
    with pytest.raises(AttributeError, match=r"super\(\).__init__\(venv\)"):
        type("Rash", (Doubled,), {"__init__": lambda self: None})().num_envs  # noqa: B018


def test_pictures_are_shown_in_a_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    env = VecMonitor(DummyVecEnv([lambda: Lamp("rgb_array")] * 2))
    env.reset()
    assert env.render("human") is None
    picture = env.render("rgb_array")
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, picture)
    pygame.display.quit()
    for mode in ("human", "rgb_array", None):
        with pytest.warns(UserWarning, match=r"render_mode=None; make them with render_mode='rgb_array'"):
            assert walks().render(mode) is None
    with pytest.raises(NotImplementedError, match="Batch does not define get_images"):
        Batch().get_images()


# VecNormalize.


def test_moments_of_batches_are_those_of_all_values():
    values = np.random.default_rng(0).normal(3.0, 2.0, (50, 4))
    moments, other = RunningMeanStd(1e-9, (4,)), RunningMeanStd(1e-9, (4,))
    for part in np.split(values[:30], 6):
        moments.update(part)
    other.update(values[30:])
    moments.combine(other)
    np.testing.assert_allclose(moments.mean, values.mean(0), rtol=1e-6)
    np.testing.assert_allclose(moments.var, values.var(0), rtol=1e-6)
    assert moments.copy().count == pytest.approx(50)


def test_statistics_are_saved_without_pickle(tmp_path):
    env = VecNormalize(walks(), gamma=0.9, clip_obs=5.0)
    env.seed(0)
    env.reset()
    for _ in range(5):
        env.step([0, 0])
    path = env.save(tmp_path / "statistics")
    assert path == tmp_path / "statistics.safetensors"
    assert b"rejeu" in path.read_bytes()[:2000]
    loaded = VecNormalize.load(tmp_path / "statistics.pkl", walks())
    np.testing.assert_array_equal(loaded.obs_rms.mean, env.obs_rms.mean)
    np.testing.assert_array_equal(loaded.ret_rms.var, env.ret_rms.var)
    assert (loaded.gamma, loaded.clip_obs, loaded.obs_rms.count) == (0.9, 5.0, env.obs_rms.count)
    obs = np.array([[1.0, 2.0, 0.6], [2.0, -1.0, 0.5]], np.float32)
    np.testing.assert_array_equal(loaded.normalize_obs(obs), env.normalize_obs(obs))
    np.testing.assert_allclose(env.unnormalize_obs(env.normalize_obs(obs)), obs, rtol=1e-5)


class Partly(VecNormalize):
    """Leaves the last number of an observation as it is, and takes halves of rewards into account."""

    def _normalize_obs(self, obs, obs_rms):
        return np.concatenate([super()._normalize_obs(obs, obs_rms)[..., :-1], obs[..., -1:]], axis=-1)

    def _unnormalize_obs(self, obs, obs_rms):
        return np.concatenate([super()._unnormalize_obs(obs, obs_rms)[..., :-1], obs[..., -1:]], axis=-1)

    def _update_reward(self, reward):
        super()._update_reward(reward / 2)


def test_subclasses_decide_how_values_are_normalized(tmp_path):
    env, plain = Partly(walks()), VecNormalize(walks())
    for wrapper in (env, plain):
        wrapper.seed(0)
        wrapper.reset()
    obs, full = env.step([0, 0])[0], plain.step([0, 0])[0]
    np.testing.assert_array_equal(obs[:, :-1], full[:, :-1])
    np.testing.assert_array_equal(obs[:, -1], env.get_original_obs()[:, -1])
    np.testing.assert_allclose(env.unnormalize_obs(obs), env.get_original_obs(), rtol=1e-5)
    np.testing.assert_allclose(env.returns, plain.returns / 2)
    loaded = Partly.load(env.save(tmp_path / "statistics"), walks())
    np.testing.assert_array_equal(loaded.normalize_obs(env.get_original_obs()), obs)


def test_statistics_without_clipping_are_saved(tmp_path):
    env = VecNormalize(walks(), clip_obs=math.inf, clip_reward=math.inf)
    env.reset()
    path = env.save(tmp_path / "statistics")
    loaded = VecNormalize.load(path, walks())
    assert (loaded.clip_obs, loaded.clip_reward) == (math.inf, math.inf)
    assert loaded.observation_space == env.observation_space
    far = np.full((2, 3), 1e6, np.float32)
    np.testing.assert_array_equal(loaded.normalize_obs(far), env.normalize_obs(far))
    assert loaded.normalize_obs(far).min() > 1e3
    header, arrays = checkpoint.read(path, "vec_normalize")
    for key, value in (("gamma", None), ("epsilon", None), ("clip_obs", "Infinity"), ("clip_obs", -1.0)):
        bad = {"settings": {**header["settings"], key: value}, "keys": None}
        with pytest.raises(CheckpointError, match=f"{key}="):
            VecNormalize.load(checkpoint.write(tmp_path / "bad", "vec_normalize", arrays, bad), walks())


def test_statistics_of_another_environment_are_refused(tmp_path):
    path = VecNormalize(walks()).save(tmp_path / "statistics")
    with pytest.raises(CheckpointError, match=r"obs.mean is float64\[3\], expected float64\[4\]"):
        VecNormalize.load(path, make_vec_env("CartPole-v1"))
    with pytest.raises(CheckpointError, match="'vec_normalize', expected 'agent'"):
        rejeu.SAC.load(path)
    with pytest.raises(ValueError, match="does not fit these statistics"):
        VecNormalize(walks()).set_venv(make_vec_env("CartPole-v1"))


def test_statistics_move_to_another_vector():
    env = VecNormalize(walks(2))
    env.reset()
    env.set_venv(walks(3))
    assert env.num_envs == 3
    before = env.obs_rms.count
    assert env.reset().shape == (3, 3)
    assert env.obs_rms.count == before + 3


def test_nothing_moves_while_training_is_off():
    env = VecNormalize(walks(), training=False)
    env.reset()
    env.step([0, 0])
    assert env.obs_rms.count == env.ret_rms.count == 1e-4


def test_only_boxes_are_scaled():
    choices = DummyVecEnv([lambda: gym.make("FrozenLake-v1")])
    with pytest.raises(ValueError, match="only supports Box observations"):
        VecNormalize(choices)
    assert VecNormalize(choices, norm_obs=False).reset().shape == (1,)
    with pytest.raises(ValueError, match="norm_obs_keys contains 'goal'"):
        VecNormalize(DummyVecEnv([Reach]), norm_obs_keys=["goal"])
    with pytest.raises(ValueError, match="applicable only to Dict observations"):
        VecNormalize(walks(), norm_obs_keys=["goal"])


def test_statistics_are_copied_only_between_vectors_wrapped_alike():
    with pytest.raises(ValueError, match="VecNormalize where the other is VecMonitor"):
        sync_envs_normalization(VecNormalize(walks()), VecMonitor(walks()))


def test_statistics_that_are_copied_are_of_each_vector_alone():
    training, evaluating = (VecNormalize(walks()) for _ in range(2))
    training.reset()
    sync_envs_normalization(training, evaluating)
    for own, other, value in ((training, evaluating, 50.0), (evaluating, training, -9.0)):
        before = {name: array.copy() for name, array in other.statistics().items()}
        own.obs_rms.update(np.full((7, *own.obs_rms.mean.shape), value))
        own.ret_rms.update(np.full(7, value))
        for name, array in other.statistics().items():
            np.testing.assert_array_equal(array, before[name])
            assert (own.statistics()[name] != array).all() or name.endswith(".count")


# Other wrappers.


def test_stacked_frames_are_learnt_from():
    batch = replayed(VecFrameStack(walks(), 3))
    assert batch.obs.shape == (500, 9)
    np.testing.assert_array_equal(batch.next_obs[:, 6], batch.obs[:, 6] + 1)
    np.testing.assert_array_equal(batch.next_obs[:, :6], batch.obs[:, 3:])


def test_stacks_are_of_boxes_along_an_axis_that_there_is():
    with pytest.raises(TypeError, match="stacks Box observations"):
        VecFrameStack(DummyVecEnv([lambda: gym.make("FrozenLake-v1")]), 2)
    with pytest.raises(ValueError, match="'first', 'last' or None"):
        VecFrameStack(walks(), 2, channels_order="middle")
    with pytest.raises(ValueError, match="needs uint8 images"):
        VecTransposeImage(walks())


def test_a_nan_is_said_where_it_comes_from():
    class Broken(Walk):
        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, float("nan"), *rest

    env = VecCheckNan(DummyVecEnv([Broken]), raise_exception=True)
    env.reset()
    with pytest.raises(BadEnvironmentError, match=r"the rewards contain nan at \(0,\) after the actions \[1\]"):
        env.step([1])
    env = VecCheckNan(DummyVecEnv([Walk]))
    env.reset()
    with pytest.warns(UserWarning, match=r"the actions contain inf at \(0,\)"):
        env.step(np.array([np.inf]))
    env.step(np.array([np.inf]))  # warned once


def test_a_monitor_around_a_vector_writes_its_file(tmp_path):
    env = VecMonitor(walks(wrap=lambda env: env), tmp_path / "all", info_keywords=("is_success",))
    env.reset()
    for _ in range(4):
        env.step([0, 0])
    lines = (tmp_path / "all.monitor.csv").read_text().split("\n")
    assert lines[1] == "r,l,t,is_success"
    assert [line.split(",")[:2] + line.split(",")[3:] for line in lines[2:4]] == [
        ["6.0", "3", "True"],
        ["11.0", "4", "False"],
    ]
    assert env.episode_count == 2


# make_vec_env.


def test_environments_are_monitored_wrapped_and_seeded(tmp_path):
    env = make_vec_env(
        "Pendulum-v1",
        n_envs=2,
        seed=7,
        start_index=3,
        monitor_dir=tmp_path / "logs",
        wrapper_class=gym.wrappers.TransformReward,
        wrapper_kwargs={"func": lambda reward: -reward},
        env_kwargs={"g": 9.0},
        monitor_kwargs={"allow_early_resets": False},
    )
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["3.monitor.csv", "4.monitor.csv"]
    assert env.get_attr("g") == [9.0, 9.0]
    assert env.get_attr("allow_early_resets") == [False, False]
    assert env.env_is_wrapped(gym.wrappers.TransformReward) == [True, True]
    assert env.render_mode == "rgb_array"
    expected = [gym.make("Pendulum-v1", g=9.0).reset(seed=7 + i)[0] for i in range(2)]
    np.testing.assert_array_equal(env.reset(), expected)
    for rank, one in zip((3, 4), env.envs, strict=True):
        assert one.action_space.sample() == spaces.Box(-2, 2, (1,), np.float32, seed=7 + rank).sample()
    assert (env.step(np.zeros((2, 1)))[1] > 0).all()


def test_environments_are_made_by_functions_too():
    env = make_vec_env(Walk, 2, env_kwargs={"rank": 4}, vec_env_cls=type("Mine", (DummyVecEnv,), {}))
    assert type(env).__name__ == "Mine"
    assert env.get_attr("rank") == [4, 4]
    assert env.render_mode is None
