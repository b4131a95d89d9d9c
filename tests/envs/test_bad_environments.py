"""Environments that do one thing wrong: found before training, and explained or mended where nobody looked."""

import re
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import rejeu
from rejeu.agents import presets
from rejeu.core.errors import BadEnvironmentError
from rejeu.envs import checker
from rejeu.envs.checker import findings
from rejeu.envs.make import GymnasiumVector, make_vector
from rejeu.envs.registry import make_env
from rejeu.envs.workers import pool
from rejeu.lab.cli import main
from rejeu.sb3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor
from rejeu.training import checks
from rejeu.training.checks import check_finite
from tests.bad_environments import EVERY, Good, Line, RewardReadsInfo, RewardWithAxis, SameArray, seeing
from tests.helpers import small_sac
from tests.tiers import crossed, only

ENDING = [name for name, fault in EVERY.items() if fault.trained is not None]
GOING_ON = [name for name, fault in EVERY.items() if fault.trained is None]
SEEN = r"(environment 0, (step 3|the first reset)|in environment 0 after [24] steps)"
"""Where a fault is said to be: each shows at the third step, or at the first reset."""


@pytest.mark.parametrize("name", EVERY)
def test_each_fault_is_found_before_training(name, monkeypatch):
    monkeypatch.setattr(checker, "MOST_SECONDS", 60.0)  # not fewer steps on a slow machine
    fault = EVERY[name]
    found = findings(fault.make())
    assert any(one.level == fault.level and re.search(fault.checked, one.text) for one in found), found
    assert (fault.level == "error") == any(one.level == "error" for one in found), found


@pytest.mark.parametrize("make", [Good, Line])
def test_nothing_is_found_where_nothing_is_wrong(make):
    assert findings(make()) == []


def test_all_errors_are_raised_together_and_warnings_as_warnings():
    class Both(EVERY["reward of one"].make):
        def observe(self):
            return super().observe().astype(np.float64)

    with pytest.raises(BadEnvironmentError, match=r"(?s)Both: reset .* float64.*\nstep returned a reward"):
        rejeu.check_env(Both(), warn=False)
    with pytest.warns(UserWarning, match="terminated at its time limit of 10 steps"):
        rejeu.check_env(EVERY["folded limit"].make())


@pytest.mark.filterwarnings("ignore")  # Box2D's module warns when it is imported, and crashes where that is an error
@pytest.mark.parametrize(
    "env_id", only({"Pendulum-v1"}, [*dict.fromkeys(one.env_id for one in presets.ALL), "rejeu/Ball-v0"])
)
def test_no_environment_with_a_preset_is_refused(env_id):
    try:
        env = make_env(env_id)
    except rejeu.MissingExtra as error:
        pytest.skip(str(error))
    except ValueError as error:
        if "which is not installed" not in str(error):
            raise
        pytest.skip(str(error))
    assert [one for one in findings(env) if one.level == "error"] == []
    env.close()


def walk(vector, n_steps=12):
    """Steps a vector as the loops do."""
    try:
        vector.reset(0)
        for n in range(n_steps):
            step = vector.step(np.zeros((vector.n_envs, 1), np.float32))
            check_finite(SimpleNamespace(env=vector, action=None), step, n * vector.n_envs)
            done = step.terminated | step.truncated
            if done.any():
                vector.reset_done(done)
    finally:
        vector.close()


BACKENDS = {
    "in this process": lambda make: make_vector(make, 2, "gymnasium"),
    "in workers": lambda make: make_vector(make, 2, "gymnasium-async"),
    "self-resetting": lambda make: make_vector(VecMonitor(DummyVecEnv([make] * 2))),
}


@pytest.mark.parametrize(("name", "backend"), crossed(list(ENDING), list(BACKENDS)))
def test_a_fault_that_nobody_looked_for_is_explained(name, backend):
    fault = EVERY[name]
    if name == "nan seen" and backend == "self-resetting":
        pytest.skip("VecCheckNan looks for that")
    with pytest.raises(BadEnvironmentError, match=fault.trained) as caught:
        walk(BACKENDS[backend](fault.make))
    if (name, backend) != ("nan reward", "self-resetting"):  # which is noticed outside, where only the vector is known
        assert fault.make.__name__ in str(caught.value)
    if name != "nan seen":  # which is looked for now and then, and where episodes end
        assert re.search(SEEN, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(("name", "backend"), crossed([name for name in GOING_ON if name != "endless"], list(BACKENDS)))
def test_a_fault_that_can_be_mended_or_borne_does_not_end_a_run(name, backend):
    if name == "folded in info" and backend == "self-resetting":
        pytest.skip("the info is what such a vector says of time limits")
    walk(BACKENDS[backend](EVERY[name].make))


@pytest.mark.parametrize("name", only({"scalar", "no seed"}, ["scalar", "missing key", "four values", "no seed"]))
def test_training_ends_with_the_words(name):
    fault = EVERY[name]
    agent = small_sac(fault.make(), learning_starts=99)
    with pytest.raises(BadEnvironmentError, match=fault.trained):
        agent.learn(25)


def test_what_is_cast_keeps_its_values():
    rows = {}
    for name in ("double", "list", "reward of one", "zeros"):
        vector = make_vector(EVERY[name].make, 1, "gymnasium", seed=0)
        vector.reset()
        for _ in range(4):
            step = vector.step(np.full((1, 1), 0.25, np.float32))
        assert (step.obs.dtype, step.reward.dtype, step.terminated.dtype) == (np.float32, np.float32, bool)
        rows[name] = [*step.obs[0].tolist(), float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0])]
    assert rows["double"][1:] == [4.0, 1.0, 1.0, False, False]
    assert len({str(row) for row in rows.values()}) == 1


def test_images_of_another_integer_type_are_taken_if_they_fit():
    class Wide(EVERY["float as image"].make):
        value = 255

        def observe(self):
            return np.full((2, 2, 3), self.value, np.int64)

    vector = make_vector(Wide, 1, "gymnasium")
    assert vector.reset().min() == 255
    Wide.value = 256
    with pytest.raises(BadEnvironmentError, match=r"expected uint8, which cannot hold 256 at index \(0, 0, 0\)"):
        vector.reset_done(np.ones(1, bool))


def test_what_an_environment_raises_itself_is_raised_as_it_is():
    class Broken(Good):
        def step(self, action):
            raise ValueError("the motor is off")

    for vector in (
        make_vector(Broken, 2, "gymnasium"),
        GymnasiumVector(SyncVectorEnv([Broken] * 2, autoreset_mode=AutoresetMode.DISABLED)),
    ):
        with pytest.raises(ValueError, match=r"^the motor is off$"):
            walk(vector)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scalar", r"Scalar, environment 0, step 3: step returned the observation of shape \(\), expected \(3,\)"),
        ("too long", r"environment 0, step 3: step returned the observation of shape \(4,\)"),
        ("nested shape", r"environment 0, step 3: step returned the observation under 'arm.angles' of shape \(3,\)"),
        ("four values", r"environment 0, step 3: step returned 4 values .*, expected \(obs, reward, term"),
        ("nan reward", r"returned the reward nan in environment 0 after 4 steps"),
        ("only observation", r"environment 0, the first reset: reset returned the observation only"),
    ],
)
def test_vectors_that_were_given_are_explained(name, words):
    env = SyncVectorEnv([EVERY[name].make] * 2, autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(BadEnvironmentError, match=words):
        walk(make_vector(env))


@pytest.mark.filterwarnings("ignore::UserWarning")  # by which Gymnasium shows the traceback
def test_workers_that_were_given_are_explained():
    env = AsyncVectorEnv([EVERY["too long"].make] * 2, context=pool.START_METHOD, autoreset_mode=AutoresetMode.DISABLED)
    vector = GymnasiumVector(env)
    vector.reset(0)
    action = np.zeros((2, 1), np.float32)
    vector.step(action)
    vector.step(action)
    with pytest.raises(BadEnvironmentError, match=r"environment \d, step 3: ValueError: .*see rejeu.check_env\(env\)"):
        vector.step(action)
    env.close(terminate=True)


class Batch(gym.vector.VectorEnv):
    """A vector environment of one's own; ``answer`` is what its third step returns."""

    metadata = {"autoreset_mode": AutoresetMode.DISABLED}
    num_envs = 2
    single_observation_space, single_action_space = Good.observation_space, Good.action_space
    n_steps = 0
    answer = None

    def reset(self, *, seed=None, options=None):
        return np.zeros((2, 3), np.float32), {}

    def step(self, action):
        self.n_steps += 1
        flags = np.zeros(2, bool)
        good = {"obs": np.zeros((2, 3), np.float32), "reward": np.zeros(2), "terminated": flags, "truncated": flags}
        good |= self.answer if self.n_steps == 3 else {}
        return *good.values(), {}


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ({"obs": np.zeros((3, 3))}, r"Batch, one of the environments, step 3: .*shape \(3, 3\), expected \(2, 3\)"),
        ({"obs": None}, "observations as None, expected a batch of Box"),
        ({"reward": 0.0}, r"rewards as 0.0 of type float, expected numbers of shape \(2,\)"),
        ({"reward": [None, 0.0]}, r"rewards as a list of 2 values, expected numbers"),
        ({"terminated": [None, None]}, r"terminated as a list of 2 values, expected bools of shape \(2,\)"),
        ({"truncated": np.zeros((2, 1), bool)}, r"truncated as an array of shape \(2, 1\) .*expected bools"),
        ({"more": 1}, "step returned a tuple of 6 values, expected .obs, reward, terminated, truncated, info"),
    ],
)
def test_answers_of_a_vector_of_ones_own_are_checked(answer, words):
    env = Batch()
    env.answer = answer
    with pytest.raises(BadEnvironmentError, match=words):
        walk(GymnasiumVector(env))


def test_subprocesses_explain_too():
    env = SubprocVecEnv([EVERY["too long"].make] * 2)
    env.reset()
    for _ in range(2):
        env.step(np.zeros((2, 1), np.float32))
    with pytest.raises(
        BadEnvironmentError, match=r"environment 0, step 3: step returned .*shape \(4,\), expected \(3,\)"
    ):
        env.step(np.zeros((2, 1), np.float32))
    assert env.closed


def test_a_reward_of_goals_that_is_no_number_is_explained():
    """An array of one number is taken as that number, as in Stable-Baselines3."""
    places = np.arange(4.0, dtype=np.float32)[:, None]
    with_axis, plain = (make_vector(kind, 1, "gymnasium").goals() for kind in (RewardWithAxis, Line))
    np.testing.assert_array_equal(with_axis.reward(places, 0 * places), plain.reward(places, 0 * places))

    class TwoRewards(RewardWithAxis):
        def compute_reward(self, achieved, desired, info):
            return np.repeat(super().compute_reward(achieved, desired, info), 2, axis=-1)

    goals = make_vector(TwoRewards, 1, "gymnasium").goals()
    with pytest.raises(BadEnvironmentError, match=r"compute_reward returned an array of shape \(2,\) .* of one goal"):
        goals.reward(places, places)


def test_a_reward_that_reads_the_info_is_explained():
    goals = make_vector(RewardReadsInfo, 1, "gymnasium").goals()
    places = np.arange(4.0, dtype=np.float32)[:, None]
    with pytest.raises(
        BadEnvironmentError, match="compute_reward found no key 'scale': the info is empty in hindsight"
    ):
        goals.reward(places, places)
    np.testing.assert_array_equal(goals.reward(places, places, [{"scale": 3.0}] * 4), np.zeros(4))


class OneDict(Good):
    """Has one info, which it empties at every reset."""

    def __init__(self):
        self.info = {}

    def reset(self, **kwargs):
        self.info.clear()
        return super().reset(**kwargs)[0], self.info

    def step(self, action):
        self.info["time"] = self.time
        return (*super().step(action)[:4], self.info)


def test_the_last_info_of_an_episode_outlasts_the_reset():
    vector, venv = make_vector(OneDict), DummyVecEnv([OneDict])
    vector.reset(), venv.reset()
    for _ in range(10):
        step, (_, _, _, infos) = vector.step(np.zeros((1, 1))), venv.step(np.zeros((1, 1)))
    vector.reset_done(step.truncated)
    assert step.info[0] == {"time": 9}
    assert infos[0]["time"] == 9


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_final_observations_that_a_reset_would_overwrite_are_refused(mode):
    def made(kind):
        env = AsyncVectorEnv([kind], autoreset_mode=mode, context="forkserver")
        try:
            return make_vector(env)
        finally:
            env.close()

    made(Good)
    made(seeing("Constant", lambda env: np.zeros(3, np.float32)))
    if mode == AutoresetMode.DISABLED:
        made(SameArray)
    else:
        with pytest.raises(ValueError, match=r"SameArray writes all observations into one array.*DISABLED"):
            made(SameArray)


class SeveralAgents:
    possible_agents = ("cat", "mouse")

    def reset(self, seed=None, options=None): ...
    def step(self, actions): ...


class Simulator:
    def action_spec(self): ...


class OldEnvironment:
    def reset(self): ...
    def step(self, action): ...


class Spaceless(gym.Env): ...


NO_ENVIRONMENTS = {
    SeveralAgents: "got SeveralAgents, an environment of several agents as PettingZoo's; rejeu trains one",
    Simulator: "got Simulator, as dm_control's; wrap it: shimmy",
    OldEnvironment: "got OldEnvironment; .*of the old package gym .*: rejeu.OldEnvironment",
    Spaceless: "Spaceless has no observation_space and no action_space; set it in __init__",
    (lambda: gym.Wrapper(Spaceless())): "Spaceless has no observation_space",
    (lambda: None): "got NoneType; derive its class",
    (lambda: "CartPole-v1"): r"got str; make it: gymnasium.make\('CartPole-v1'\)",
    (lambda: SyncVectorEnv([Good])): "got SyncVectorEnv, several environments as one; give a single one",
}


@pytest.mark.parametrize(("make", "words"), NO_ENVIRONMENTS.items())
def test_what_is_no_environment_is_named(make, words):
    for function in (
        make_vector,
        lambda make: make_vector(make, 2, "gymnasium-async"),
        lambda make: DummyVecEnv([make]),
    ):
        with pytest.raises(TypeError, match=words):
            function(make)
    with pytest.raises(TypeError, match=words):
        findings(make())
    if isinstance(make, type) and make is not Spaceless:
        with pytest.raises(TypeError, match=f"env must be an id, a Gymnasium environment, .*{words}"):
            make_vector(make())


class Far(Good):
    """Shows its place 1e6 times as far away as it is; the place is declared to be from -20 to 20."""

    scale = 1e6

    def observe(self):
        return super().observe() * np.float32([1.0, 1.0, self.scale])


@pytest.mark.parametrize("algorithm", only(["SAC"], ["SAC", "PPO"]))
def test_observations_far_outside_of_the_declared_bounds_are_told_once(algorithm):
    agent = rejeu.AGENTS[algorithm]("MlpPolicy", make_vector(Far, 2, "gymnasium"), policy_kwargs={"net_arch": [4]})
    words = r"Far returned the observation with -?\d.*e\+0\d at index 2 in environment 0, far outside of .*\[-20, 20\]"
    with pytest.warns(UserWarning, match=words) as caught:
        agent.learn(60)
    assert len(caught) == 1
    assert str(caught[0].message).endswith("declare the bounds that they really have")


def test_observations_are_compared_with_their_bounds_at_steps_twice_as_far_apart_each_time(monkeypatch):
    looked = []
    monkeypatch.setattr(checks.validation, "far_outside", lambda space, obs: looked.append(True))
    steps = []
    agent = small_sac(Good(), learning_starts=999)
    agent.learn(200, lambda agent, turn: steps.extend([turn.step] * len(looked)) or looked.clear())
    assert steps == [1, 2, 4, 8, 16, 32, 64, 128]


def test_what_is_unbounded_or_little_outside_is_not_told():
    class Little(Far):
        scale = 2.0

    class Unbounded(Far):
        observation_space = gym.spaces.Box(np.float32([-1, -1, -np.inf]), np.float32([20, 20, 1]), dtype=np.float32)

    for kind in (Little, Unbounded):
        small_sac(kind(), learning_starts=999).learn(40)  # warnings are errors in tests


# The command.


def test_the_command_prints_what_it_finds(capsys):
    assert main(["check", "MountainCar-v0"]) == 0
    assert capsys.readouterr().out == "MountainCar-v0: 0 errors, 0 warnings\n"
    assert main(["check", "tests.registered_badly:Bad-v0"]) == 1
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("error: step returned the observation of shape (), expected (3,)")
    assert out[-1] == "tests.registered_badly:Bad-v0: 1 error, 0 warnings"
    assert main(["check", "CartPole-v9000"]) == 2
    assert "did you mean CartPole" in capsys.readouterr().err
