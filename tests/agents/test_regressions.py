"""What Stable-Baselines3 shipped wrong and mended later, by its changelog, where no test of a part has it already."""

import gc
import time
import tracemalloc
from types import SimpleNamespace

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import rejeu
from rejeu.agents import training
from rejeu.core import algorithm as core, checkpoint, spaces
from rejeu.envs.make import InProcess
from rejeu.logs.logging import Console, CsvFile
from rejeu.replay.ring import Ring
from rejeu.replay.uniform import ReplayBuffer
from tests.algorithms.probes.environments import Probe
from tests.environments import Counter, Sampled, Timed
from tests.every_agent import env_of, every_kind
from tests.helpers import small_sac
from tests.tiers import exhaustive

NEVER = 10**6


# Hindsight.


class Pilgrim(Timed):
    """Episodes of 10 steps that each have a number of their own; what is achieved is (that number, the time)."""

    observation_space = gym.spaces.Dict(
        {key: gym.spaces.Box(-np.inf, np.inf, (2,)) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def __init__(self, first: int) -> None:
        self.number = first - 1

    def begin(self, seed):
        self.number += 1

    def observe(self):
        where = np.float32([self.number, self.time])
        return {"observation": where, "achieved_goal": where, "desired_goal": np.full(2, -1.0, np.float32)}

    def compute_reward(self, achieved, desired, info):
        return np.zeros(np.shape(achieved)[:-1], np.float32)


def test_an_episode_cut_short_by_saving_is_not_joined_to_the_next(tmp_path):
    """Saved after 4 steps of its second episode, the buffer goes on in an agent that is within its own episode 100."""
    settings = {"replay_buffer_class": rejeu.HerReplayBuffer, "learning_starts": NEVER}
    path = small_sac(Pilgrim(0), **settings).learn(14).save_replay_buffer(tmp_path / "buffer")
    agent = small_sac(Pilgrim(100), **settings).learn(6)
    agent.load_replay_buffer(path)
    agent.learn(13)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (2000,))
    obs, following, goal = (
        leaf.astype(int)
        for leaf in (batch.obs["observation"], batch.next_obs["observation"], batch.obs["desired_goal"])
    )
    kept = {(0, t) for t in range(10)} | {(1, t) for t in range(4)} | {(101, t) for t in range(10)}
    assert set(map(tuple, obs.tolist())) == kept | {(102, t) for t in range(3)}
    np.testing.assert_array_equal(following, obs + np.array([0, 1]))
    relabelled = goal[:, 0] >= 0
    assert relabelled.sum() == 1600
    np.testing.assert_array_equal(goal[relabelled, 0], obs[relabelled, 0])
    assert (goal[relabelled, 1] > obs[relabelled, 1]).all()
    assert set(goal[relabelled][obs[relabelled, 0] == 1, 1].tolist()) == {1, 2, 3, 4}
    np.testing.assert_array_equal(batch.discount, np.float32(0.99))


# Final observations.


def doubled(lengths):
    return lambda: gym.wrappers.TransformObservation(Counter(lengths), lambda obs: 2 * obs, Counter.observation_space)


def in_process():
    return InProcess([doubled((3,))(), doubled((2, 4))()], seed=0)


def inside(mode):
    return lambda: SyncVectorEnv([doubled((3,)), doubled((2, 4))], autoreset_mode=mode)


def outside(mode):
    def make():
        plain = SyncVectorEnv([lambda: Counter((3,)), lambda: Counter((2, 4))], autoreset_mode=mode)
        return gym.wrappers.vector.TransformObservation(plain, lambda obs: 2 * obs, plain.observation_space)

    return make


@pytest.mark.parametrize(
    "make",
    [
        in_process,
        *(inside(mode) for mode in AutoresetMode),
        outside(AutoresetMode.NEXT_STEP),
        outside(AutoresetMode.DISABLED),
    ],
)
def test_wrappers_change_final_observations_like_all_others(make):
    """The wrapper doubles (episode, time, a number drawn once an episode), so all successors are 2 later in time."""
    agent = small_sac(make(), learning_starts=NEVER).learn(30)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (400,))
    np.testing.assert_array_equal(batch.next_obs - batch.obs, np.tile(np.float32([0.0, 2.0, 0.0]), (400, 1)))
    assert set(batch.next_obs[:, 1].tolist()) == {2.0, 4.0, 6.0, 8.0}
    np.testing.assert_array_equal(batch.reward, 50 * batch.obs[:, 0] + batch.obs[:, 1] / 2)


# Targets.

PICTURE = gym.spaces.Box(0, 255, (8, 8, 1), np.uint8)


def parameter_names(kind, observation_space):
    """The names of everything in a state, by the part they belong to: ``{"critics": {...}, "target_critics": {...}}``."""
    module = kind.agent.algorithm
    config = module.Config(policy_kwargs={"net_arch": [4]})
    init = module.make(config, observation_space, env_of(kind).action_space).init
    found = {}
    for name in core.names(jax.eval_shape(init, jax.ShapeDtypeStruct((2,), jnp.uint32))):
        part, _, rest = name.partition(".")
        found.setdefault(part, set()).add(rest)
    return found


@every_kind
def test_networks_and_targets_encode_images_each_by_themselves(kind):
    names = parameter_names(kind, PICTURE)
    parts = {part for part in names if part.removeprefix("target_") in ("actor", "critic", "critics", "network")}
    assert len(parts) > 1
    for part in parts:
        assert names[part] == names[part.removeprefix("target_")]
        assert any("encoder.images" in name for name in names[part]), part


@every_kind
def test_optimizers_hold_the_networks_that_learn_and_no_targets(kind):
    names = parameter_names(kind, Probe.observation_space)
    optimizers = {part for part in names if part.endswith("optimizer")}
    learning = {part for part in ("actor", "critic", "critics", "value", "network", "log_alpha") if part in names}
    assert len(optimizers) == len(learning)
    for part in learning:
        optimizer = {"log_alpha": "alpha_optimizer", "network": "optimizer"}.get(part, f"{part}_optimizer")
        moments = {f"{moment}.{name}".rstrip(".") for moment in ("mu", "nu") for name in names[part]}
        assert names[optimizer] == moments | {"count"}


# Dtypes.


def test_every_part_of_a_dict_observation_keeps_its_dtype_and_value():
    """All numbers are such that a detour through float32 or a narrower integer would change them."""
    space = gym.spaces.Dict(
        {
            "pixels": gym.spaces.Box(0, 255, (2, 2, 1), np.uint8),
            "small": gym.spaces.Box(-(2**15), 2**15 - 1, (1,), np.int16),
            "large": gym.spaces.Box(-(2**31), 2**31 - 1, (1,), np.int64),
            "real": gym.spaces.Box(-1.0, 1.0, (1,), np.float32),
            "choice": gym.spaces.Discrete(2**24 + 3),
        }
    )
    shown = {
        "pixels": np.uint8([[[255], [254]], [[1], [0]]]),
        "small": np.int16([-32767]),
        "large": np.int64([2**24 + 1]),
        "real": np.float32([1 / 3]),
        "choice": np.int64(2**24 + 1),
    }

    class Exhibition(Sampled):
        def observe(self):
            return shown

    vector = InProcess([Exhibition(space), Exhibition(space)])
    replay = ReplayBuffer(Ring(20, 2, spaces.leaves(space), spaces.structure(space), (1,), np.float32), 0.9)
    replay.begin(vector.reset())
    step = vector.step(np.zeros((2, 1), np.float32))
    replay.add(np.zeros((2, 1), np.float32), step.reward, step.terminated, step.obs)
    batch = replay.sample(np.random.default_rng(0), (3,))
    for obs in (batch.obs, batch.next_obs):
        kept = {key: obs[key].dtype.name for key in sorted(shown)}
        assert kept == {"choice": "int32", "large": "int32", "pixels": "uint8", "real": "float32", "small": "int16"}
        for key, value in shown.items():
            np.testing.assert_array_equal(obs[key], np.stack([value] * 3), err_msg=key)


# Files.


@pytest.mark.slow
def test_a_file_of_more_than_4_gigabytes_comes_back(tmp_path):
    array = np.zeros(2**32 + 16, np.uint8)
    array[[0, 2**31, 2**32, -1]] = [1, 2, 3, 4]
    path = checkpoint.write(tmp_path / "large", "replay", {"obs": array, "tail": np.arange(3.0)}, {})
    assert path.stat().st_size > 2**32
    _, arrays = checkpoint.read(path, "replay")
    path.unlink()
    assert arrays["obs"].shape == array.shape
    np.testing.assert_array_equal(arrays["obs"][[0, 1, 2**31, 2**32, -1]], [1, 0, 2, 3, 4])
    np.testing.assert_array_equal(arrays["tail"], [0.0, 1.0, 2.0])


# Memory.


@exhaustive
def test_loading_a_hundred_times_keeps_no_memory(tmp_path):
    agent = small_sac(Counter((5,)), learning_starts=NEVER, buffer_size=3000).learn(3000)
    model, buffer = agent.save(tmp_path / "model"), agent.save_replay_buffer(tmp_path / "buffer")

    def load(times):
        for _ in range(times):
            agent.set_parameters(model)
            agent.load_replay_buffer(buffer)

    load(3)
    n_arrays = len(jax.live_arrays())
    tracemalloc.start()
    try:
        load(5)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        load(100)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert len(jax.live_arrays()) <= n_arrays
    assert grown < 3 * buffer.stat().st_size


# Logging.


def test_long_names_that_begin_alike_are_all_logged(tmp_path, capsys):
    metrics = {f"train/{'very_' * 8}long_name_{i}": 0.25 * i for i in (1, 2, 3)}
    table = CsvFile(tmp_path / "metrics.csv")
    table.write(7, metrics)
    table.close()
    header, row = (tmp_path / "metrics.csv").read_text().splitlines()
    assert header.split(",") == ["step", *metrics]
    assert row.split(",") == ["7", "0.25", "0.5", "0.75"]
    Console().write(7, metrics)
    printed = capsys.readouterr().out
    assert [line.split()[-1] for line in printed.splitlines() if "very" in line] == ["0.25", "0.5", "0.75"]


def test_a_clock_that_stands_still_does_not_end_a_run(monkeypatch):
    agent = small_sac(Counter((5,)), learning_starts=NEVER)
    now = time.perf_counter()
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    agent.learn(12)
    assert agent.num_timesteps == 12
    assert len(agent.history) == 2


@pytest.mark.parametrize(
    ("env_id", "n_envs", "share", "hints"),
    [
        ("CartPole-v1", 1, 0.96, True),
        ("CartPole-v1", 4, 0.96, False),
        ("CartPole-v1", 1, 0.5, False),
        ("Own", 1, 0.96, False),
    ],
)
def test_a_run_that_waits_for_one_environment_names_the_call_that_makes_eight(env_id, n_envs, share, hints, recwarn):
    seconds = {"env": 20 * share, "replay": 0.0, "update": 20 * (1 - share), "total": 20.0}
    run = SimpleNamespace(env=SimpleNamespace(env_id=env_id, n_envs=n_envs), seconds=seconds)
    training.hint_at_more_environments(SimpleNamespace(run=run, record=SimpleNamespace(steps_per_second=37.0)))
    assert ["rejeu.make_vector('CartPole-v1', n_envs=8)" in str(one.message) for one in recwarn] == [True] * hints
