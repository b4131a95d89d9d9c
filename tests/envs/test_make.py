"""Every backend keeps the same contract: the true successor is seen, and nothing resets by itself."""

import importlib
import re
import subprocess
import sys
from collections import OrderedDict

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import rejeu
from rejeu.core.errors import MissingExtra
from rejeu.envs.make import EnvPool, GymnasiumVector, InProcess, auto_backend, make_vector
from rejeu.envs.registry import import_envpool, make_env
from rejeu.sb3.common.env_util import make_vec_env
from rejeu.sb3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from rejeu.training.run import restart
from tests.environments import Counter, Reach, Sampled, Timed
from tests.helpers import small_sac

LENGTHS = (2, 4), (3, 1)
"""Of the episodes of two environments, over and over."""
MODES = (AutoresetMode.DISABLED, AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)


def counters():
    return [lambda lengths=lengths: Counter(lengths) for lengths in LENGTHS]


def in_process():
    return InProcess([make() for make in counters()], seed=7)


def synchronous(mode):
    return lambda: GymnasiumVector(SyncVectorEnv(counters(), autoreset_mode=mode), seed=7)


def walk(vector, n_steps=12):
    """Observations that actions are chosen from, and steps, as the training loop sees them (copied)."""
    rows = []
    obs = vector.reset().copy()
    for _ in range(n_steps):
        step = vector.step(np.zeros((vector.n_envs, *vector.action_space.shape), np.float32))
        rows.append((obs, step.obs.copy(), step.reward.copy(), step.terminated.copy(), step.truncated.copy()))
        done = step.terminated | step.truncated
        obs = (vector.reset_done(done) if done.any() else step.obs).copy()
    return rows


def expected_walk(n_steps=12):
    """The (episode, time) pairs of the two counters, by counting."""
    rows, episode, time = [], [0, 0], [0, 0]
    for _ in range(n_steps):
        before = [(episode[i], time[i]) for i in range(2)]
        time = [t + 1 for t in time]
        after = [(episode[i], time[i]) for i in range(2)]
        over = [time[i] == LENGTHS[i][episode[i] % 2] for i in range(2)]
        rows.append((before, after, over))
        for i in range(2):
            if over[i]:
                episode[i], time[i] = episode[i] + 1, 0
    return rows


@pytest.mark.parametrize("make", [in_process, *map(synchronous, MODES)], ids=["in-process", *(m.name for m in MODES)])
def test_the_successor_of_every_step_is_the_true_one(make):
    vector = make()
    for (obs, next_obs, reward, terminated, truncated), (before, after, over) in zip(
        walk(vector), expected_walk(), strict=True
    ):
        np.testing.assert_array_equal(obs[:, :2], before)
        np.testing.assert_array_equal(next_obs[:, :2], after)
        np.testing.assert_array_equal(next_obs[:, 2], obs[:, 2])  # drawn once an episode
        np.testing.assert_array_equal(reward, [100 * episode + time for episode, time in before])
        np.testing.assert_array_equal(truncated, over)
        assert not terminated.any()
        assert obs.dtype == next_obs.dtype == reward.dtype == np.float32
    vector.close()


@pytest.mark.parametrize("mode", MODES)
def test_the_environments_of_a_synchronous_vector_are_stepped_one_by_one(mode):
    given = SyncVectorEnv(counters(), autoreset_mode=mode)
    vector = make_vector(given, seed=7)
    assert isinstance(vector, InProcess)
    assert vector.envs == given.envs
    for one, two in zip(walk(in_process()), walk(vector), strict=True):
        for left, right in zip(one, two, strict=True):
            np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize("mode", MODES)
def test_worker_processes_walk_like_the_one_in_process(mode):
    vector = GymnasiumVector(AsyncVectorEnv(counters(), autoreset_mode=mode, context="forkserver"), seed=7)
    assert vector.backend == "gymnasium-async"
    for one, two in zip(walk(in_process()), walk(vector), strict=True):
        for left, right in zip(one, two, strict=True):
            np.testing.assert_array_equal(left, right)
    vector.close()


def test_an_id_a_function_an_environment_and_a_vector_all_become_vectors():
    assert make_vector("Pendulum-v1").backend == "gymnasium"
    assert make_vector("Pendulum-v1", g=9.0).envs[0].unwrapped.g == 9.0
    assert make_vector("Pendulum-v1", 2, "gymnasium").n_envs == 2
    assert make_vector(lambda: Counter(), 3).n_envs == 3
    assert make_vector(SyncVectorEnv(counters())).n_envs == 2
    vector = make_vector(Counter((1,), "terminated"))
    assert (vector.n_envs, make_vector(vector)) == (1, vector)
    vector.reset()
    step = vector.step(np.zeros((1, 1), np.float32))
    assert (step.terminated.tolist(), step.truncated.tolist()) == ([True], [False])


@pytest.mark.needs_envpool
def test_four_environments_of_an_id_are_those_of_envpool():
    assert make_vector("Pendulum-v1", 4).backend == "envpool"


def test_a_vector_that_resets_itself_beyond_repair_is_refused():
    class Own(gym.vector.VectorEnv):
        metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    with pytest.raises(ValueError, match=r"Own resets by itself .*AutoresetMode.SAME_STEP"):
        GymnasiumVector(Own())


def test_advice_for_gymnasiums_own_vector_of_cart_poles_can_be_typed():
    with pytest.raises(ValueError, match="CartPoleVectorEnv resets by itself") as caught:
        make_vector(gym.make_vec("CartPole-v1", num_envs=4))
    (call,) = re.findall(r"rejeu\.make_vector\([^)]*\)", str(caught.value))
    assert "vectorization_mode='sync'" in str(caught.value)
    for vector in (eval(call, {"rejeu": rejeu}), gym.make_vec("CartPole-v1", num_envs=4, vectorization_mode="sync")):
        assert rejeu.DQN("MlpPolicy", vector, learning_starts=100, buffer_size=100, seed=0).learn(8).num_timesteps == 8


# Observations of Dict spaces.


class Unordered(Timed):
    """Returns its observation as highway-env does: an OrderedDict, the keys not sorted."""

    observation_space = gym.spaces.Dict({k: gym.spaces.Box(0, 9, (1,), np.float64) for k in "zab"})
    length, ends = 1, "terminated"

    def observe(self):
        return OrderedDict([("z", np.array([3.0])), ("a", np.array([1.0])), ("b", np.array([2.0]))])


@pytest.mark.parametrize(
    "make",
    [
        lambda: InProcess([Unordered(), Unordered()]),
        lambda: GymnasiumVector(SyncVectorEnv([Unordered] * 2, autoreset_mode=AutoresetMode.DISABLED)),
        lambda: GymnasiumVector(SyncVectorEnv([Unordered] * 2, autoreset_mode=AutoresetMode.SAME_STEP)),
    ],
    ids=["in-process", "DISABLED", "SAME_STEP"],
)
def test_keys_keep_their_values_whatever_mapping_the_environment_returns(make):
    vector = make()
    for obs in (vector.reset(), vector.step(np.zeros((2, 1), np.float32)).obs, vector.reset_done(np.ones(2, bool))):
        assert type(obs) is dict
        assert {key: value.tolist() for key, value in obs.items()} == {
            "a": [[1.0], [1.0]],
            "b": [[2.0], [2.0]],
            "z": [[3.0], [3.0]],
        }
        assert obs["a"].dtype == np.float32


@pytest.mark.parametrize("backend", ["gymnasium", "envpool"])
def test_parking_observations_mean_the_same_on_every_backend(backend):
    """highway-env puts observation before the goals; EnvPool sorts. In the first observation, position is achieved."""
    vector = make_vector("parking-v0", 2, backend, seed=0)
    obs = vector.reset()
    np.testing.assert_allclose(obs["observation"], obs["achieved_goal"], atol=1e-6)
    # The goal is a parking spot: its velocity is zero and it points up or down, unlike a car that starts anyhow.
    np.testing.assert_allclose(obs["desired_goal"][:, 2:4], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.abs(obs["desired_goal"][:, 5]), 1.0, atol=1e-6)
    vector.close()


def test_observations_of_tuples_and_numbers_are_stacked():
    space = gym.spaces.Tuple([gym.spaces.Discrete(5, start=2), gym.spaces.MultiBinary(3)])
    vector = InProcess([Sampled(space), Sampled(space)], seed=0)
    number, bits = vector.reset()
    assert (number.shape, number.dtype) == ((2,), np.int32)
    assert (bits.shape, bits.dtype) == ((2, 3), np.int8)
    assert set(number.tolist()) <= {2, 3, 4, 5, 6}


# Seeds.


def first_observations(vector, resets=3):
    every = np.ones(vector.n_envs, bool)
    seen = [np.array(vector.reset()), *(np.array(vector.reset_done(every)) for _ in range(resets))]
    vector.close()
    return np.stack(seen)


@pytest.mark.parametrize("backend", ["gymnasium", "envpool"])
def test_one_seed_gives_one_series_of_episodes_and_another_another(backend):
    one, two, other = (first_observations(make_vector("Pendulum-v1", 3, backend, seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, two)
    assert (one != other).any()
    assert len(np.unique(one[0, :, 0])) == 3, "the environments of a vector start differently"
    assert (one[0] != one[1]).any(), "a seed is used once and later resets differ"


def test_in_process_environments_are_seeded_one_after_the_other():
    """Environment i of a vector with seed s starts as a single environment with seed s + i."""
    obs = make_vector("Pendulum-v1", 2, "gymnasium", seed=5).reset()
    for i in range(2):
        np.testing.assert_array_equal(obs[i], gym.make("Pendulum-v1").reset(seed=5 + i)[0])


@pytest.mark.parametrize("seed", [0, 2**31 - 1, 2**31, 2**32 - 1])
def test_envpool_takes_every_seed_that_an_agent_does(seed):
    vector = make_vector("Pendulum-v1", 2, "envpool", seed)
    assert np.isfinite(vector.reset()).all()


# EnvPool.


@pytest.mark.parametrize(("env_id", "n_players"), [("intersection-multi-agent-v0", 2), ("SparrowMahjong-v1", 3)])
def test_envpool_refuses_environments_of_several_players(env_id, n_players):
    if env_id not in import_envpool().list_all_envs():
        pytest.skip("EnvPool has board games since 1.2.3")
    with pytest.raises(ValueError, match=f"{env_id} of EnvPool has {n_players} players"):
        make_vector(env_id, 2, "envpool")


def test_bounds_that_envpool_declares_for_want_of_others_are_infinite(monkeypatch, tmp_path):
    """EnvPool's are the smallest positive and the largest float64; VizDoom's actions have no others."""
    monkeypatch.chdir(tmp_path)  # where VizDoom writes a file
    vector = make_vector("Basic-v1", 1, "envpool", seed=0)
    try:
        assert vector.action_space == gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    finally:
        vector.close()


def test_envpool_walks_one_trajectory_a_seed():
    walks = []
    for _ in range(2):
        vector = EnvPool("CartPole-v1", 3, seed=1)
        rng, obs, seen = np.random.default_rng(0), vector.reset(), []
        for _ in range(80):
            step = vector.step(rng.integers(2, size=3, dtype=np.int32))
            done = step.terminated | step.truncated
            obs = vector.reset_done(done) if done.any() else step.obs
            seen.append((np.array(step.obs), step.reward, done, np.array(obs)))
        walks.append(seen)
        vector.close()
    assert any(done.any() for _, _, done, _ in walks[0])
    for one, two in zip(*walks, strict=True):
        for left, right in zip(one, two, strict=True):
            np.testing.assert_array_equal(left, right)


def test_envpool_shows_the_final_observation_and_restarts_only_what_ended():
    """CartPole ends beyond 12 degrees (0.2095 rad) or 2.4 m, and starts within 0.05 of 0 in all four numbers."""
    vector = EnvPool("CartPole-v1", 4, seed=1)
    rng, ended = np.random.default_rng(0), 0
    vector.reset()
    for _ in range(80):
        step = vector.step(rng.integers(2, size=4, dtype=np.int32))
        before = np.array(step.obs)
        outside = (np.abs(before[:, 2]) > 0.2094) | (np.abs(before[:, 0]) > 2.4)
        np.testing.assert_array_equal(step.terminated, outside)
        if step.terminated.any():
            after = vector.reset_done(step.terminated)
            assert (np.abs(after[step.terminated]) <= 0.05).all()
            np.testing.assert_array_equal(after[~step.terminated], before[~step.terminated])
            np.testing.assert_array_equal(step.obs, before)
            ended += 1
    assert ended > 3
    vector.close()


def test_envpool_knows_its_time_limit():
    vector = EnvPool("Pendulum-v1", 1, seed=0)
    assert vector.max_episode_steps == 200
    vector.reset()
    for t in range(200):
        step = vector.step(np.zeros((1, 1), np.float32))
        assert bool(step.truncated[0]) == (t == 199)
        assert not step.terminated[0]
    vector.close()
    vector = EnvPool("CliffWalking-v0", 1, seed=0)  # of which EnvPool says 2,147,483,647
    assert vector.max_episode_steps is None
    vector.close()


def test_envpool_has_no_time_limit_where_it_declares_zero():
    vector = make_vector("BabyAI-GoToLocalS8N5-v0", 1, "envpool")
    assert vector.max_episode_steps is None
    vector.close()


# Success.


@pytest.mark.parametrize(
    "make",
    [
        lambda: InProcess([Reach(stops=True), Reach(stops=True)], seed=0),
        lambda: synchronous_reach(AutoresetMode.DISABLED),
        lambda: synchronous_reach(AutoresetMode.SAME_STEP),
    ],
    ids=["in-process", "DISABLED", "SAME_STEP"],
)
def test_success_is_read_from_the_step_that_ended_the_episode(make):
    vector = make()
    obs, outcomes = vector.reset(), []
    for t in range(60):
        towards = np.clip(obs["desired_goal"] - obs["achieved_goal"], -1, 1)
        step = vector.step(towards if t % 20 < 10 else -np.sign(towards + 1e-9))
        done = step.terminated | step.truncated
        for i in np.flatnonzero(done):
            reached = abs(step.obs["achieved_goal"][i, 0] - step.obs["desired_goal"][i, 0]) < 0.5
            assert vector.success(step, i) == float(reached)
            outcomes.append(reached)
        obs = vector.reset_done(done) if done.any() else step.obs
    assert {bool(o) for o in outcomes} == {True, False}


def synchronous_reach(mode):
    return GymnasiumVector(SyncVectorEnv([lambda: Reach(stops=True)] * 2, autoreset_mode=mode), seed=0)


@pytest.mark.parametrize(
    "make", [in_process, synchronous(AutoresetMode.DISABLED), lambda: EnvPool("Pendulum-v1", 2, 0)]
)
def test_success_is_unknown_where_the_environment_does_not_say(make):
    vector = make()
    vector.reset()
    step = vector.step(np.zeros((2, 1), np.float32))
    assert np.isnan(vector.success(step, 1))


# What may be given.


@pytest.mark.parametrize(
    ("env_id", "n_envs", "kwargs", "backend"),
    [
        ("Pendulum-v1", 1, {}, "gymnasium"),
        ("Pendulum-v1", 3, {}, "gymnasium"),
        pytest.param("Pendulum-v1", 4, {}, "envpool", marks=pytest.mark.needs_envpool),
        ("Pendulum-v1", 4, {"g": 9.0}, "gymnasium"),
        ("rejeu/Ball-v0", 8, {}, "gymnasium"),
        pytest.param("Pong-v5", 1, {}, "envpool", marks=pytest.mark.needs_envpool),
    ],
)
def test_auto_uses_envpool_from_four_environments_on_or_if_gymnasium_lacks_the_id(env_id, n_envs, kwargs, backend):
    assert auto_backend(env_id, n_envs, kwargs) == backend


@pytest.fixture
def without_envpool(monkeypatch):
    """Blocks the import of EnvPool, as if it were not installed."""
    monkeypatch.setitem(sys.modules, "envpool", None)


def output_of(code):
    """Returns what a new process prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@pytest.mark.needs_envpool
def test_an_id_is_looked_up_in_envpool_without_its_games():
    code = """
import sys
from rejeu.envs.registry import import_envpool
assert "Pong-v5" in import_envpool().list_all_envs()
print(*{"matplotlib", "envpool.jumanji", "envpool.atari", "envpool.classic_control"} & {*sys.modules})
import_envpool().make_gymnasium("CartPole-v1", num_envs=1).close()
import envpool
print("envpool.classic_control" in sys.modules, hasattr(envpool, "make_spec"))
"""
    assert output_of(code).splitlines() == ["", "True True"]


@pytest.mark.needs_envpool
@pytest.mark.exhaustive
def test_envpool_knows_all_its_environments_without_its_games():
    ids = "print(*envpool.list_all_envs())"
    own = f"from rejeu.envs.registry import import_envpool; envpool = import_envpool(); {ids}"
    assert output_of(own) == output_of(f"import envpool; {ids}")


@pytest.mark.parametrize("entry", ["\nimport envpool.games.registration\n", "\nprint()\n", None])
def test_an_envpool_of_another_layout_is_imported_as_it_is(entry, tmp_path, monkeypatch):
    (tmp_path / "envpool").mkdir()
    (tmp_path / "envpool" / "__init__.py").write_text("is_whole = True\n")
    if entry is not None:
        (tmp_path / "envpool" / "entry.py").write_text(f'"""Entry point."""\n{entry}')
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "envpool"]:
        monkeypatch.delitem(sys.modules, name)
    assert import_envpool().is_whole
    del sys.modules["envpool"]
    assert "envpool.entry" not in sys.modules


IMPORTS = {
    "envpool/__init__.py": {"envpool/__init__.py": "{fault}"},
    "a game": {
        "envpool/__init__.py": "from envpool import entry\ndef list_all_envs(): return ['Pendulum-v1']\n",
        "envpool/entry.py": '"""Entry point."""\n\nimport envpool.early.registration\nimport envpool.games.registration\n',
        "envpool/registration.py": "ids = []\ndef register(name):\n    assert name not in ids\n    ids.append(name)\n",
        "envpool/early/registration.py": "from envpool.registration import register\nregister('Early-v0')\n",
        "envpool/games/__init__.py": "{fault}",
        "envpool/games/registration.py": "from envpool import games\n",
    },
}


@pytest.fixture(params=IMPORTS)
def envpool_without_libraries(request, tmp_path, monkeypatch):
    """An EnvPool whose import fails like that of version 1.2.7 in a slim container."""
    fault = "raise ImportError('libEGL.so.1: cannot open shared object file: No such file or directory')\n"
    for name, text in IMPORTS[request.param].items():
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_text(text.replace("{fault}", fault))
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "envpool"]:
        monkeypatch.delitem(sys.modules, name)
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "envpool"]:
        del sys.modules[name]


FAILED_IMPORT = (
    r"backend='envpool' needs EnvPool \(.*\), whose import fails: libEGL\.so\.1: cannot open shared object file: .*; "
    "on Debian or Ubuntu, run: apt-get install libegl1 libgl1 libopengl0"
)


def test_auto_uses_gymnasium_with_a_warning_if_the_import_of_envpool_fails(envpool_without_libraries):
    for _ in range(2):  # nothing of the first import stays behind
        with pytest.raises(ImportError, match="libEGL"):
            importlib.import_module("envpool")
        with pytest.warns(UserWarning, match=f"^{FAILED_IMPORT}; Gymnasium's environments are used instead$"):
            assert make_vector("Pendulum-v1", 4).backend == "gymnasium"


def test_the_envpool_backend_says_which_system_packages_to_install_if_its_import_fails(envpool_without_libraries):
    with pytest.raises(rejeu.MissingExtra, match=f"^{FAILED_IMPORT}$"):
        make_vector("Pendulum-v1", 4, backend="envpool")


def test_auto_uses_gymnasium_without_envpool(without_envpool):
    assert make_vector("Pendulum-v1", 4).backend == "gymnasium"
    agent = rejeu.DQN("MlpPolicy", make_vector("CartPole-v1", 4), policy_kwargs={"net_arch": [4]}, seed=0).learn(8)
    assert agent.num_timesteps == 8


def test_the_envpool_backend_without_envpool_says_how_to_install_it_and_its_size(without_envpool):
    said = r'EnvPool \(about 770 MB with its assets\), which is not installed; run: pip install "rejeu\[envpool\]"'
    with pytest.raises(rejeu.MissingExtra, match=said):
        make_vector("Pendulum-v1", backend="envpool")
    with pytest.raises(ValueError, match="no environment is called 'Pong-v5'"):
        make_vector("Pong-v5")


SAME = Counter()


def self_seeding():
    return VecMonitor(DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2))


@pytest.mark.parametrize(
    ("env", "arguments", "words"),
    [
        ("Pendulum-v1", {"backend": "gym"}, "backend='gym' must be one of auto, envpool, gymnasium"),
        ("Pendulum-v1", {"n_envs": 0}, "n_envs=0 must be a whole number of at least 1"),
        ("Pendulum-v1", {"n_envs": True}, "n_envs=True must be"),
        (Counter(), {"n_envs": 2}, "n_envs=2 needs an id or a function"),
        (3, {}, "env must be an id, a Gymnasium environment, .* got int"),
        (lambda: SAME, {"n_envs": 2}, "one environment was given more than once"),
        ("Pendulum-v1", {"backend": "envpool", "g": 9.0}, "envpool backend takes no environment arguments"),
        ("Pendulun-v1", {}, "no environment is called 'Pendulun-v1'; did you mean .*Pendulum-v1"),
        ("parkin-v0", {}, "no environment is called 'parkin-v0'; did you mean .*parking-v0"),
        ("Zzzzzz", {}, "no environment is called 'Zzzzzz'; rejeu list"),
        ("Pendulun-v1", {"backend": "envpool"}, "no environment is called 'Pendulun-v1'; did you mean"),
        ("Pendulum-v1", {"n_envs": 3, "seed": [1, 2]}, r"seed=\[1, 2\] must be a whole number .* or a sequence of 3"),
        ("Pendulum-v1", {"n_envs": 3, "seed": [1, 2, -3]}, "must have whole numbers from 0 to 2"),
        ("Pendulum-v1", {"n_envs": 3, "seed": [1, 2, 2.5]}, "must have whole numbers from 0 to 2"),
        ("Pendulum-v1", {"n_envs": 3, "seed": [1, 2, 2**31]}, "must have whole numbers from 0 to 2"),
        (self_seeding(), {"seed": [1, 2]}, "VecMonitor takes a single seed and seeds its environments itself"),
    ],
)
def test_a_wrong_argument_is_named_with_its_remedy(env, arguments, words):
    with pytest.raises(TypeError if env == 3 else ValueError, match=words) as caught:
        make_vector(env, **arguments)
    assert "\n" not in str(caught.value)


def test_an_environment_that_only_gymnasium_has_is_referred_to_it(monkeypatch):
    monkeypatch.setitem(gym.registry, "OnlyHere-v0", gym.envs.registration.EnvSpec("OnlyHere-v0", Counter))
    with pytest.raises(ValueError, match="EnvPool does not have OnlyHere-v0; use backend='gymnasium'"):
        make_vector("OnlyHere-v0", backend="envpool")
    assert make_vector("OnlyHere-v0").backend == "gymnasium"


def test_a_missing_package_is_named_with_the_command_that_installs_it(monkeypatch):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "gymnasium_robotics" else real(name))
    with pytest.raises(MissingExtra, match=r'FetchReach-v99 needs gymnasium-robotics.*pip install "rejeu\[robotics\]"'):
        make_env("FetchReach-v99")


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("dm_control/cartpole-balance-v0", r'package shimmy, .*: pip install "shimmy\[dm-control\]"$'),
        ("PandaReach-v3", "package panda_gym, which is not installed: pip install panda-gym$"),
        ("Meta-World/MT1", "pip install metaworld$"),
        pytest.param(
            "MiniGrid-Empty-5x5-v0",
            "pip install minigrid; EnvPool has MiniGrid-Empty-5x5-v0: backend='envpool'",
            marks=pytest.mark.needs_envpool,
        ),
    ],
)
def test_an_environment_of_a_package_without_extra_is_named_with_that_package(monkeypatch, env_id, words):
    import importlib.util

    real, absent = importlib.util.find_spec, ("shimmy", "panda_gym", "metaworld", "minigrid")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in absent else real(name))
    with pytest.raises(ValueError, match=words):
        make_env(env_id)


def test_robots_can_be_made_with_enumerations_that_equal_no_numpy_integer(monkeypatch):
    """As in MuJoCo 3.12 and later."""
    mujoco = pytest.importorskip("mujoco")
    utils = pytest.importorskip("gymnasium_robotics.utils.mujoco_utils")

    class Kind(int):
        __eq__ = lambda self, other: type(other) is Kind and int(self) == int(other)  # noqa: E731
        __hash__ = int.__hash__

    class Kinds:
        __members__ = {name: Kind(kind) for name, kind in mujoco.mjtJoint.__members__.items()}

    for name, kind in Kinds.__members__.items():
        setattr(Kinds, name, kind)
    monkeypatch.setattr(mujoco, "mjtJoint", Kinds)
    monkeypatch.setattr(utils, "mujoco", mujoco)
    env = make_env("FetchReach-v4")
    assert env.reset(seed=0)[0]["achieved_goal"].shape == (3,)
    env.close()


# One seed for each environment.


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async", "envpool"])
def test_each_environment_begins_with_the_seed_that_is_given_for_it(backend):
    """What a single environment shows with that seed: two of the seeds are equal, and so are their episodes."""
    seeds = [7, 3, 7]
    vector = make_vector("Pendulum-v1", 3, backend, seed=seeds)
    obs = np.array(vector.reset())
    for row, seed in zip(obs, seeds, strict=True):
        one = make_vector("Pendulum-v1", 1, backend.removesuffix("-async"), seed=seed)
        np.testing.assert_array_equal(row, one.reset()[0])
        one.close()
    again = np.array(vector.reset([3, 3, 7]))
    np.testing.assert_array_equal(again, obs[[1, 1, 0]])
    vector.close()


def test_a_gymnasium_vector_environment_takes_one_seed_for_each_environment():
    make = lambda: gym.make("Pendulum-v1")  # noqa: E731
    vector = make_vector(gym.vector.SyncVectorEnv([make, make]), seed=[5, 2])
    expected = [make().reset(seed=seed)[0] for seed in (5, 2)]
    np.testing.assert_array_equal(vector.reset(), expected)


@pytest.mark.parametrize("backend", ["gymnasium", "envpool"])
def test_training_begins_with_the_seeds_given_for_each_environment_and_not_with_the_agents(backend):
    def first(agent_seed, seeds):
        env = make_vector("Pendulum-v1", 2, backend, seed=seeds)
        agent = small_sac(env, seed=agent_seed)
        seen = []
        agent.learn(2, lambda agent, turn: seen.append(agent.run.replay.arrays()["obs.array"][:, 0]))
        return seen[0]

    expected = np.array(make_vector("Pendulum-v1", 2, backend, seed=[4, 9]).reset())
    np.testing.assert_array_equal(first(0, [4, 9]), expected)
    np.testing.assert_array_equal(first(1, [4, 9]), expected)
    assert (first(0, 4) != first(1, 4)).any()  # one number is the agent's to choose


@pytest.mark.parametrize("kind", ["gymnasium", "envpool", "jax", "SyncVectorEnv", "VecNormalize"])
def test_runs_with_consecutive_seeds_share_no_first_observation(kind):
    def environments():
        if kind == "VecNormalize":
            return VecNormalize(make_vec_env("Pendulum-v1", 8), norm_obs=False)
        if kind == "SyncVectorEnv":
            return gym.vector.SyncVectorEnv([lambda: gym.make("Pendulum-v1")] * 8)
        return make_vector("jax/Pendulum-v1" if kind == "jax" else "Pendulum-v1", 8, kind)

    starts = [restart(small_sac(environments(), seed=seed).run).copy() for seed in range(5)]
    assert len(np.unique(np.concatenate(starts), axis=0)) == 40


def test_a_dict_in_a_dict_that_holds_one_array_is_read():
    space = gym.spaces.Dict({"arm": gym.spaces.Dict({"angles": gym.spaces.Box(-1.0, 1.0, (2,))})})
    vector = InProcess([Sampled(space) for _ in range(2)], seed=0)
    assert vector.reset()["arm"]["angles"].shape == (2, 2)
    assert vector.step(np.zeros((2, 1), np.float32)).obs["arm"]["angles"].shape == (2, 2)


def test_environments_of_ones_own_are_not_looked_up_in_envpool(monkeypatch):
    def refuse():
        raise AssertionError("EnvPool is imported")

    monkeypatch.setattr("rejeu.envs.registry.import_envpool", refuse)
    gym.register("rejeu-test/Own-v0", lambda: gym.make("CartPole-v1"))
    assert auto_backend("rejeu-test/Own-v0", 8) == "gymnasium"
