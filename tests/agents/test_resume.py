"""Whole runs on disk: cut off anywhere and taken up again, they are the run without a break, bit for bit."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from rejeu.checkpoints.run_folder import checkpoint_files
from rejeu.core import checkpoint, hardware, xla
from rejeu.core.errors import BadEnvironmentError, CheckpointError, RunInUseError
from rejeu.envs.functional.gym_env import GymnasiumEnv
from rejeu.envs.make import InProcess
from rejeu.sb3.common.callbacks import BaseCallback, EvalCallback
from tests.bit_flipping import BitFlipping
from tests.environments import Sampled
from tests.every_agent import KINDS
from tests.helpers import small_sac
from tests.jax_environments import Forbidden
from tests.sharing import shared_learners
from tests.tiers import only, only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [8]}, "seed": 3}
RECURRENT = {"policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 8}, "n_steps": 16, "batch_size": 16, "seed": 3}
OFF = {**SMALL, "learning_starts": 20, "batch_size": 8, "buffer_size": 90}
BALL = "rejeu/Ball-v0"  # steps in this process, whatever else is installed
NOISES = {
    "normal": rejeu.NormalActionNoise([0.0], [0.3]),
    "Ornstein-Uhlenbeck": rejeu.OrnsteinUhlenbeckActionNoise([0.0], [0.3]),
    "parameters": rejeu.ParameterNoise(),
}


def vector(env_id, n_envs=3, backend="gymnasium"):
    return lambda: rejeu.make_vector(env_id, n_envs, backend, seed=1)


CASES = {
    **{
        name: (kind.name, vector("MountainCar-v0" if kind.discrete else "Pendulum-v1", 1), OFF)
        for name, kind in KINDS.items()
    },
    "three environments": ("SAC", vector("Pendulum-v1"), OFF),
    "priorities, n steps": ("DQN", vector("CartPole-v1", 2), {**OFF, "priorities": {}, "n_steps": 3}),
    "episodes": ("TD3", vector("rejeu/Ball-v0", 2), {**OFF, "train_freq": (1, "episode"), "gradient_steps": -1}),
    "every 7 steps": ("SAC", vector("Pendulum-v1", 2), {**OFF, "train_freq": 7, "gradient_steps": 3}),
    "normalised": ("SAC", vector("Pendulum-v1", 2), {**OFF, "normalize": True}),
    "held, limited": ("SAC", vector("Pendulum-v1", 2), {**OFF, "action_repeat": 3, "action_share": 0.5}),
    "schedule": ("SAC", vector("Pendulum-v1", 1), {**OFF, "learning_rate": rejeu.Linear(1e-2, 0.0)}),
    **{f"{n} noise": ("DDPG", vector("Pendulum-v1", 2), {**OFF, "action_noise": x}) for n, x in NOISES.items()},
    "EnvPool": ("SAC", vector("Pendulum-v1", 2, "envpool"), OFF),
    "EnvPool, a seed each": ("SAC", lambda: rejeu.make_vector("Pendulum-v1", 2, "envpool", seed=[9, 4]), OFF),
    "EnvPool, PPO": ("PPO", vector("CartPole-v1", 3, "envpool"), {**SMALL, "n_steps": 16, "batch_size": 16}),
    "EnvPool, whole episodes": ("PPO", vector("CartPole-v1", 3, "envpool"), {**SMALL, "n_steps": 16, "n_episodes": 1}),
    "worker processes": ("SAC", vector("Pendulum-v1", 2, "gymnasium-async"), OFF),
    "DQN, masks": (
        "DQN",
        lambda: InProcess([GymnasiumEnv(Forbidden()), GymnasiumEnv(Forbidden())], 1),
        {**OFF, "action_masks": True},
    ),
    "TD3, memory, noise": (
        "TD3",
        vector("Pendulum-v1", 2),
        {**OFF, "action_noise": 0.1, "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4, "sequence_length": 4}},
    ),
    "PPO": ("PPO", vector("CartPole-v1"), {**SMALL, "n_steps": 16, "batch_size": 16}),
    "PPO, normalised": ("PPO", vector("Pendulum-v1"), {**SMALL, "n_steps": 16, "batch_size": 16, "normalize": True}),
    "PPO, whole episodes": ("PPO", vector("rejeu/Ball-v0"), {**SMALL, "n_steps": 16, "n_episodes": 1}),
    "PPO, gSDE": ("PPO", vector("Pendulum-v1"), {**SMALL, "n_steps": 16, "batch_size": 16, "use_sde": True}),
    "A2C": ("A2C", vector("MountainCar-v0"), {**SMALL, "n_steps": 5}),
    "TRPO": ("TRPO", vector("CartPole-v1"), {**SMALL, "n_steps": 16, "batch_size": 16}),
    "ARS": ("ARS", vector("CartPole-v1", 2), {"n_delta": 1, "n_steps": 60, "zero_policy": False, "seed": 0}),
    "PQN": ("PQN", vector("CartPole-v1"), {**SMALL, "n_steps": 16, "batch_size": 16}),
    "RecurrentPPO": ("RecurrentPPO", vector("rejeu/CartPoleNoVelocity-v0"), RECURRENT),
}

DEFAULT_CASES = {
    *("priorities, n steps", "TD3, memory, noise", "PPO, normalised", "RecurrentPPO", "ARS", "DQN, masks"),
    "EnvPool, whole episodes",
}
"""Each kind of loop, replay and memory once; the others are exhaustive."""


def facts(agent):
    """Everything of a run that does not depend on the clock."""
    buffer = agent.run.replay.arrays()
    history = np.array([(*e[:5], 0.0) for e in agent.history.episodes])
    return {
        **agent.get_parameters(),
        **{f"buffer.{key}": value for key, value in buffer.items()},
        "history": history,
        "counters": np.array([agent.num_timesteps, agent.n_updates, agent.n_predictions]),
        "best": np.array([] if agent.best is None else [agent.best.step]),
        "window": np.array([e["r"] for e in agent.ep_info_buffer]),
    }


def assert_same(one, two):
    assert one.keys() == two.keys()
    for key in one:
        np.testing.assert_array_equal(one[key], two[key], err_msg=key)


class Rows:
    """Keeps rows of statistics, the columns that depend on the clock left out."""

    def __init__(self):
        self.rows = []

    def write(self, step, metrics):
        self.rows.append({"step": step, **{k: v for k, v in metrics.items() if not k.startswith("time/")}})

    def close(self):
        pass


@pytest.mark.parametrize("case", only(DEFAULT_CASES, CASES))
def test_a_run_that_is_cut_off_goes_on_as_if_it_had_not_been(case, tmp_path):
    name, make_env, settings = CASES[case]
    n, cut = 230, 107
    make = lambda: rejeu.AGENTS[name]("MlpPolicy", make_env(), **settings)  # noqa: E731
    with shared_learners():
        whole_rows, first_rows, second_rows = Rows(), Rows(), Rows()
        whole = make().learn(n, log_interval=1, sinks=[whole_rows])
        cut_off = make().learn(
            n, [lambda agent, turn: turn.step < cut, Checkpoint(tmp_path, every=40)], log_interval=1, sinks=[first_rows]
        )
        assert cut <= cut_off.num_timesteps < n
        again = rejeu.AGENTS[name].resume(tmp_path, make_env())
        assert again.resumed.exact
        assert_same(facts(again), facts(cut_off))
        again.learn(sinks=[second_rows])
    assert_same(facts(again), facts(whole))
    np.testing.assert_equal(first_rows.rows + second_rows.rows, whole_rows.rows)
    obs = np.array(whole.observation_space.sample())
    np.testing.assert_array_equal(whole.predict(obs)[0], again.predict(obs)[0])


def test_hindsight_goes_on_exactly_where_the_environment_offers_its_state(tmp_path):
    class Carried(BitFlipping):
        def get_state(self):
            return {
                "state": self.state,
                "goal": self.goal,
                "time": self.time,
                "rng": self.np_random.bit_generator.state,
            }

        def set_state(self, state):
            self.state, self.goal, self.time = state["state"], state["goal"], state["time"]
            self.np_random.bit_generator.state = state["rng"]

    settings = {**OFF, "replay_buffer_class": rejeu.HerReplayBuffer, "n_steps": 2, "priorities": {}}
    make = lambda: rejeu.DQN("MultiInputPolicy", Carried(4), **settings)  # noqa: E731
    with shared_learners():
        whole = make().learn(150)
        make().learn(150, [Checkpoint(tmp_path, every=1000), lambda agent, turn: turn.step < 61])
        again = rejeu.DQN.resume(tmp_path, Carried(4))
        assert again.resumed.exact
        assert_same(facts(again.learn()), facts(whole))


def cut_run(folder, steps=60, cut=30, env=BALL, callbacks=(), **settings):
    agent = small_sac(env, **settings)
    agent.predict(agent.observation_space.sample(), deterministic=False)  # the next one draws something else, then too
    return agent.learn(steps, [*callbacks, Checkpoint(folder, every=10), lambda agent, turn: turn.step < cut])


def test_two_checkpoints_are_kept_and_only_the_rows_they_need(tmp_path):
    (tmp_path / ".run_000000000010.safetensors.1a2b.tmp").write_bytes(b"half")  # of a process that died
    agent = cut_run(tmp_path, 100, 95, buffer_size=25)
    assert not list(tmp_path.glob(".*"))
    assert [path.name for path in checkpoint_files(tmp_path)] == [
        "run_000000000095.safetensors",
        "run_000000000090.safetensors",
    ]
    rows = sorted(path for path in tmp_path.iterdir() if path.name.startswith("rows_"))
    assert [int(path.name.split("_")[1]) for path in rows] == [70, 80, 90, 95]
    assert max(len(checkpoint.read(path, "rows")[1]["reward"]) for path in rows) <= 15  # new ones only
    assert_same(facts(rejeu.SAC.resume(tmp_path)), facts(agent))


def test_all_rows_are_written_again_if_a_file_of_some_is_gone(tmp_path):
    def remove(agent, turn):
        if turn.step == 25:
            min(tmp_path.glob("rows_*")).unlink()

    agent = cut_run(tmp_path, callbacks=[remove])
    assert_same(facts(rejeu.SAC.resume(tmp_path)), facts(agent))


def test_a_damaged_checkpoint_is_passed_over_for_the_one_before_it(tmp_path):
    cut_run(tmp_path)
    newest = checkpoint_files(tmp_path)[0]
    newest.write_bytes(newest.read_bytes()[:-10])
    with pytest.warns(UserWarning, match="resuming from the checkpoint before it"):
        agent = rejeu.SAC.resume(tmp_path)
    assert agent.num_timesteps == 20
    assert agent.learn(callback=Checkpoint(tmp_path, every=10)).num_timesteps == 60
    assert [path.name for path in checkpoint_files(tmp_path)] == [
        "run_000000000060.safetensors",
        "run_000000000050.safetensors",
    ]
    assert newest.with_name(f"{newest.name}.damaged").exists()  # nothing is thrown away


def test_newer_checkpoints_stay_as_they_are_where_an_older_one_is_resumed(tmp_path):
    cut_run(tmp_path)
    files = {path.name: path.read_bytes() for path in tmp_path.glob("*.safetensors")}
    agent = rejeu.SAC.resume(checkpoint_files(tmp_path)[-1])
    with pytest.raises(FileExistsError, match=r"contains checkpoints after the agent's step 20; continue it with SAC"):
        agent.learn(callback=Checkpoint(tmp_path, every=10))
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.safetensors")} == files
    assert agent.learn(callback=Checkpoint(tmp_path / "other", every=10)).num_timesteps == 60
    assert rejeu.SAC.resume(tmp_path / "other").num_timesteps == 60


def test_rows_that_are_missing_or_damaged_are_noticed(tmp_path):
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        rejeu.SAC.resume(tmp_path)
    cut_run(tmp_path)
    path, older = checkpoint_files(tmp_path)
    whole, (header, arrays) = path.read_bytes(), checkpoint.read(path, "run")
    header["rows"].pop(1)
    checkpoint.write(path, "run", arrays, {k: v for k, v in header.items() if k not in checkpoint.RESERVED})
    older.rename(tmp_path / "aside")
    with pytest.raises(CheckpointError, match="rows of the replay buffer are missing"):
        rejeu.SAC.resume(tmp_path)
    path.write_bytes(whole)
    (tmp_path / "aside").rename(older)
    for path in tmp_path.glob("rows_*"):
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.warns(UserWarning, match="before it"), pytest.raises(CheckpointError, match="cut short"):
        rejeu.SAC.resume(tmp_path)
    for path in tmp_path.glob("rows_*"):
        path.unlink()
    with pytest.warns(UserWarning, match="before it"), pytest.raises(CheckpointError, match="missing"):
        rejeu.SAC.resume(tmp_path)


def test_the_algorithm_and_the_number_of_environments_must_be_the_same(tmp_path):
    cut_run(tmp_path)
    checkpoint_files(tmp_path)[1].unlink()
    with pytest.raises(CheckpointError, match="holds a SAC agent, not DDPG"):
        rejeu.DDPG.resume(tmp_path)
    with pytest.raises(CheckpointError, match="had 1 environments, and 2 are given"):
        rejeu.SAC.resume(tmp_path, vector(BALL, 2)())
    cut_run(tmp_path / "given", env=gym.make("Pendulum-v1"))
    checkpoint_files(tmp_path / "given")[1].unlink()
    with pytest.raises(CheckpointError, match="give it again"):
        rejeu.SAC.resume(tmp_path / "given")
    assert rejeu.SAC.resume(tmp_path / "given", gym.make("Pendulum-v1")).resumed.exact


def test_a_complete_run_needs_a_new_limit_and_its_folder_takes_no_other_run(tmp_path):
    small_sac(BALL).learn(30, Checkpoint(tmp_path, every=10))
    agent = rejeu.SAC.resume(tmp_path)
    with pytest.raises(ValueError, match="the run is complete"):
        agent.learn()
    assert agent.learn(10, Checkpoint(tmp_path, every=10), reset_num_timesteps=False).num_timesteps == 40
    with pytest.raises(FileExistsError, match="another run"):
        small_sac(BALL).learn(20, Checkpoint(tmp_path, every=10))


def test_the_first_checkpoint_is_there_before_the_first_step(tmp_path):
    whole = small_sac(BALL).learn(40)

    def fail(agent, turn):
        raise KeyboardInterrupt  # which nothing saves after

    with pytest.raises(KeyboardInterrupt):
        small_sac(BALL).learn(40, [fail, Checkpoint(tmp_path, every=1000)])
    again = rejeu.SAC.resume(tmp_path)
    assert (again.resumed.step, again.resumed.exact) == (0, True)
    assert_same(facts(again.learn()), facts(whole))


class Hidden(gym.Wrapper):
    """Might remember anything."""


def test_where_the_state_cannot_be_carried_new_episodes_begin_and_a_warning_says_so(tmp_path):
    env = lambda: Hidden(gym.make("Pendulum-v1"))  # noqa: E731
    cut_off = cut_run(tmp_path, env=env())
    with pytest.warns(UserWarning, match="at the start of new episodes: the state of Pendulum-v1 .* cannot be carried"):
        agent = rejeu.SAC.resume(tmp_path, env())
    assert not agent.resumed.exact
    assert_same(agent.get_parameters(), cut_off.get_parameters())
    assert agent.replay_buffer.size() == 30
    agent.learn()
    assert agent.num_timesteps == 60
    assert agent.replay_buffer.size() == 60


def test_the_number_of_threads_is_saved_and_a_resumed_run_says_if_it_has_another(tmp_path, monkeypatch):
    cut_run(tmp_path)
    header, _ = checkpoint.read(checkpoint_files(tmp_path)[0], "run")
    assert header["threads"] == xla.threads()
    asked = []
    monkeypatch.setattr(xla, "start_device", asked.append)
    monkeypatch.setattr(hardware, "cores", lambda: 64)
    assert rejeu.SAC.resume(tmp_path).resumed.exact
    assert asked == [header["threads"]]  # and not what suits an agent with one environment
    monkeypatch.setattr(xla, "threads", lambda: header["threads"] + 1)
    with pytest.warns(UserWarning, match=rf"computes with {header['threads'] + 1} threads here and had"):
        assert not rejeu.SAC.resume(tmp_path).resumed.exact


def test_a_rollout_keeps_the_steps_of_the_episodes_that_cannot_go_on(tmp_path):
    env = lambda: Hidden(gym.make("CartPole-v1"))  # noqa: E731
    make = lambda: rejeu.PPO("MlpPolicy", env(), n_steps=32, batch_size=16, **SMALL)  # noqa: E731
    make().learn(96, [Checkpoint(tmp_path, every=10), lambda agent, turn: turn.step < 40])
    with pytest.warns(UserWarning, match="cannot be carried"):
        agent = rejeu.PPO.resume(tmp_path, env())
    assert agent.run.replay.size() == 8
    agent.learn(1, reset_num_timesteps=False)
    assert agent.run.replay.ended[7, 0]


def test_another_process_is_told_that_the_run_is_in_use(tmp_path):
    script = """
    import sys
    from filelock import FileLock
    with FileLock(sys.argv[1]):
        print("held", flush=True)
        sys.stdin.readline()
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "lock")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(RunInUseError, match="another process is training in"):
            small_sac(BALL).learn(20, Checkpoint(tmp_path, every=10))
        process.communicate("\n")
    small_sac(BALL).learn(20, Checkpoint(tmp_path, every=10))


def test_a_replay_buffer_that_was_replaced_is_written_whole(tmp_path):
    agent = small_sac(BALL).learn(30, Checkpoint(tmp_path / "run", every=10))
    agent.load_replay_buffer(agent.save_replay_buffer(tmp_path / "replay"))
    agent.learn(20, Checkpoint(tmp_path / "run", every=10), reset_num_timesteps=False)
    assert_same(rejeu.SAC.resume(tmp_path / "run").replay_buffer.arrays(), agent.replay_buffer.arrays())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not delete what is open")
def test_a_folder_that_vanishes_is_filled_anew(tmp_path):
    folder = tmp_path / "run"
    clear = lambda agent, turn: shutil.rmtree(folder) if turn.step == 25 else None  # noqa: E731
    agent = small_sac(BALL).learn(40, [clear, Checkpoint(folder, every=10)])
    assert_same(facts(rejeu.SAC.resume(folder)), facts(agent))


def test_an_error_of_the_environment_leaves_a_checkpoint_of_all_that_was_learnt(tmp_path):
    class Breaking(gym.Wrapper):
        n = 0

        def step(self, action):
            self.n += 1
            obs, reward, *rest = self.env.step(action)
            return obs, float("nan") if self.n == 25 else reward, *rest

    with pytest.raises(BadEnvironmentError):
        small_sac(Breaking(gym.make("Pendulum-v1"))).learn(60, Checkpoint(tmp_path, every=10))
    with pytest.warns(UserWarning, match="the run ended with BadEnvironmentError"):
        agent = rejeu.SAC.resume(tmp_path, Breaking(gym.make("Pendulum-v1")))
    assert agent.num_timesteps == 24
    assert agent.learn(10, reset_num_timesteps=False).num_timesteps == 34


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM to handle")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_training_with_a_checkpoint(number, tmp_path):
    def kill(agent, turn):
        if turn.step == 33:
            os.kill(os.getpid(), number)

    agent = small_sac(BALL).learn(60, [kill, Checkpoint(tmp_path, every=1000)])
    assert (agent.interrupted, agent.call.interrupted_by) == (True, number)
    assert rejeu.SAC.resume(tmp_path).num_timesteps == 33


def test_minutes_between_checkpoints(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(rejeu.callbacks.checkpoint.time, "monotonic", lambda: now[0])

    def tick(agent, turn):
        now[0] += 7.0

    seen = []
    small_sac(BALL).learn(
        30, [tick, Checkpoint(tmp_path, minutes=1), lambda a, t: seen.append(checkpoint_files(tmp_path)[0].name)]
    )
    small = sorted({int(name[4:16]) for name in seen})
    assert small == [0, 9, 18, 27]


class Counting(BaseCallback):
    """Counts something of its own."""

    carried = (*BaseCallback.carried, "passed")

    def __init__(self):
        super().__init__()
        self.passed = [0]

    def _on_step(self):
        self.passed[0] += 2
        return True


def test_callbacks_go_on_with_what_they_remember(tmp_path):
    def callbacks():
        evaluate = Evaluate(BALL, every=15, episodes=2)
        judge = EvalCallback(gym.make(BALL), n_eval_episodes=1, eval_freq=20, verbose=0, log_path=tmp_path / "log")
        return [evaluate, Counting(), judge]

    given = callbacks()
    whole = small_sac(BALL).learn(60, given)
    first, second = callbacks(), callbacks()
    cut_run(tmp_path / "run", callbacks=first)
    rejeu.SAC.resume(tmp_path / "run").learn(callback=second)
    assert [r.step for r in second[0].results] == [15, 30, 45, 60]
    for one, two in zip(given[0].results, second[0].results, strict=True):
        np.testing.assert_array_equal(one.evaluation.returns, two.evaluation.returns)
    assert second[0].best.step == given[0].best.step
    assert second[1].passed == [120]
    assert second[1].n_calls == 60
    assert second[2].evaluations_timesteps == [20, 40, 60]
    assert whole.num_timesteps == 60


def test_callbacks_that_differ_from_the_saved_ones_are_named(tmp_path):
    evaluate = Evaluate(BALL, every=15, episodes=1)
    cut_run(tmp_path, callbacks=[evaluate])
    with pytest.warns(UserWarning, match="saved with Evaluate, which learn was not given now"):
        rejeu.SAC.resume(tmp_path).learn()
    with pytest.warns(UserWarning, match="without a Counting; it starts from the beginning"):
        rejeu.SAC.resume(tmp_path).learn(callback=[evaluate, Counting()])


def test_the_best_single_episode_of_a_run_that_is_cut_off_is_that_of_the_run_without_a_break(tmp_path):
    make = lambda: small_sac(BALL, best_window=1, seed=1)  # noqa: E731
    whole = make().learn(300)
    make().learn(300, [lambda agent, turn: turn.step < 150, Checkpoint(tmp_path, every=50)])
    again = rejeu.SAC.resume(tmp_path).learn()
    assert again.best_window == 1
    assert whole.history.records()[0].step < 150 < whole.best.step
    assert again.best[:3] == whole.best[:3]
    np.testing.assert_equal([e[:5] for e in again.history.records()], [e[:5] for e in whole.history.records()])
    assert_same(again.restore_best().get_parameters(), whole.restore_best().get_parameters())


def test_statistics_of_vec_normalize_are_carried(tmp_path):
    from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize

    env = lambda: VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))  # noqa: E731
    agent = small_sac(env()).learn(40, Checkpoint(tmp_path, every=10))
    with pytest.warns(UserWarning, match="cannot be carried"):
        again = rejeu.SAC.resume(tmp_path, env())
    one, two = agent.get_vec_normalize_env().statistics(), again.get_vec_normalize_env().statistics()
    assert_same(one, two)


def test_hyperparameters_can_be_changed_on_the_way_and_the_progress_bar_counts_the_steps_before(tmp_path, capsys):
    cut_run(tmp_path)
    agent = rejeu.SAC.resume(tmp_path, learning_rate=1e-5)
    assert agent.config.learning_rate == 1e-5
    agent.learn(progress_bar=True)
    assert "100%  60/60 steps · " in capsys.readouterr().out


def test_masks_are_carried_too(tmp_path):
    class Masked(gym.Wrapper):
        def action_masks(self):
            return np.array([True, True])

        def get_state(self):
            return {"inside": rejeu.envs.snapshot.state_of(self.env)}

        def set_state(self, state):
            rejeu.envs.snapshot.restore(self.env, state["inside"])

    env = lambda: Masked(gym.make("CartPole-v1"))  # noqa: E731
    make = lambda: rejeu.MaskablePPO("MlpPolicy", env(), n_steps=16, batch_size=16, **SMALL)  # noqa: E731
    whole = make().learn(80)
    make().learn(80, [Checkpoint(tmp_path, every=100), lambda agent, turn: turn.step < 37])
    again = rejeu.MaskablePPO.resume(tmp_path, env())
    assert again.resumed.exact
    assert_same(facts(again.learn()), facts(whole))


@pytest.mark.parametrize(
    ("name", "settings"),
    only_tuples(
        [("PPO", {**SMALL, "n_steps": 16, "batch_size": 16})],
        [("PPO", {**SMALL, "n_steps": 16, "batch_size": 16}), ("RecurrentPPO", RECURRENT)],
    ),
)
def test_a_rollout_that_waits_for_the_next_learn_is_in_the_checkpoint(name, settings, tmp_path):
    """A callback stops training after 7 of the 16 turns of a rollout."""
    make_env = vector("rejeu/CartPoleNoVelocity-v0", 2)
    make = lambda: rejeu.AGENTS[name]("MlpPolicy", make_env(), **settings)  # noqa: E731
    with shared_learners():
        stop = lambda agent, turn: turn.step < 46  # noqa: E731
        whole = make().learn(64, stop).learn(50, reset_num_timesteps=False)
        cut_off = make().learn(64, [stop, Checkpoint(tmp_path)])
        assert cut_off.run.replay.length == 7
        again = rejeu.AGENTS[name].resume(tmp_path, make_env())
        assert_same(facts(again), facts(cut_off))
        again.learn(50, reset_num_timesteps=False)
    assert_same(facts(again), facts(whole))


def test_observations_of_half_precision_are_saved(tmp_path):
    env = lambda: Sampled(gym.spaces.Box(-1.0, 1.0, (2,), np.float16))  # noqa: E731
    agent = small_sac(env(), learning_starts=99).learn(20, Checkpoint(tmp_path))
    assert agent.replay_buffer.ring.obs_leaves[0].dtype == "float16"
    with pytest.warns(UserWarning, match="at the start of new episodes"):
        resumed = rejeu.SAC.resume(tmp_path, env())
    assert_same(resumed.replay_buffer.arrays(), agent.replay_buffer.arrays())
