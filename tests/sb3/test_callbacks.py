"""Callbacks with hooks, as scripts for Stable-Baselines3 write them; when they are called is in test_sb3_golden.py."""

import csv

import gymnasium as gym
import numpy as np
import pytest

import rejeu
import rejeu.sb3
from rejeu.logs.logging import CsvFile, Logger
from rejeu.sb3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from rejeu.sb3.common.env_util import make_vec_env
from rejeu.sb3.common.vec_env import VecNormalize
from tests.golden.vec_env_script import Walk
from tests.sb3.test_vec_env import taught

pytestmark = pytest.mark.usefixtures("learners_are_shared")


def dqn(env=None, **settings):
    settings = {"learning_starts": 1000, "policy_kwargs": {"net_arch": [4]}, "seed": 0, **settings}
    return rejeu.DQN("MlpPolicy", make_vec_env(Walk) if env is None else env, **settings)


class Note(BaseCallback):
    """Keeps what a hook sees."""

    def __init__(self, look=lambda self: self.n_calls, goes_on=lambda self: True):
        super().__init__()
        self.look, self.goes_on, self.seen = look, goes_on, []

    def _on_step(self):
        self.seen.append(self.look(self))
        return self.goes_on(self)


def test_a_callback_stops_training_and_knows_the_agent():
    note = Note(lambda self: (self.num_timesteps, self.model.num_timesteps), lambda self: self.n_calls < 3)
    agent = dqn().learn(50, callback=note)
    assert agent.num_timesteps == 3
    assert note.seen == [(1, 1), (2, 2), (3, 3)]
    assert note.model is agent
    assert note.training_env is agent.get_env()
    agent.learn(2, callback=note, reset_num_timesteps=False)
    assert note.seen[-1] == (4, 4)


def test_the_total_of_steps_counts_those_before():
    note = Note(lambda self: (self.num_timesteps, self.locals["total_timesteps"], self.model._total_timesteps))
    agent = rejeu.sb3.DQN("MlpPolicy", Walk(), learning_starts=1000, policy_kwargs={"net_arch": [4]})
    assert agent._total_timesteps == 0
    agent.learn(2, callback=note)
    agent.learn(3, callback=[note, ProgressBarCallback()], reset_num_timesteps=False)
    assert note.seen == [(1, 2, 2), (2, 2, 2), (3, 5, 5), (4, 5, 5), (5, 5, 5)]
    assert agent._total_timesteps == 5


def test_a_variable_that_the_loop_does_not_have_is_explained():
    note = Note(lambda self: (self.locals.get("obs_tensor"), self.locals["clipped_actions"] is self.locals["actions"]))
    dqn().learn(1, callback=note)
    assert note.seen == [(None, True)]
    with pytest.raises(KeyError, match=r"locals has no 'obs_tensor', but .*new_obs.*rollout_buffer"):
        dqn().learn(1, callback=Note(lambda self: self.locals["obs_tensor"]))


def test_a_subclass_of_the_evaluation_sees_every_step():
    class Seeing(EvalCallback):
        n_seen = 0

        def _log_success_callback(self, locals_, globals_):
            super()._log_success_callback(locals_, globals_)
            self.n_seen += 1

    evaluate = Seeing(Walk(0), eval_freq=4, n_eval_episodes=2, verbose=0)
    dqn().learn(4, callback=evaluate)
    assert evaluate.n_seen == 6  # two episodes of three steps


@pytest.mark.parametrize("callback", [Note(goes_on=lambda self: None), ConvertCallback(lambda _locals, _globals: None)])
def test_returning_nothing_stops_training_as_in_the_original(callback):
    with pytest.warns(UserWarning, match="_on_step returned None"):
        assert dqn().learn(5, callback=callback).num_timesteps == 1


def test_a_callback_with_hooks_and_functions_of_rejeu_go_together():
    calls, note = [], Note()
    dqn().learn(4, callback=[note, lambda agent, progress: calls.append(progress.step), Note()])
    assert calls == note.seen == [1, 2, 3, 4]


def test_functions_of_the_other_form_are_converted():
    seen = []
    callback = ConvertCallback(lambda _locals, _globals: seen.append(_locals["self"].num_timesteps) or len(seen) < 3)
    assert dqn().learn(9, callback=callback).num_timesteps == 3
    assert seen == [1, 2, 3]


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: make_vec_env(Walk, 2), id="vector of python objects"),
        pytest.param(lambda: VecNormalize(make_vec_env(Walk, 2), norm_obs=False, norm_reward=False), id="wrapped"),
        pytest.param(lambda: rejeu.make_vector(Walk, 2), id="rejeu's own"),
    ],
)
def test_infos_say_how_episodes_ended(make):
    def look(self):
        return [
            (info["episode"]["r"], info["episode"]["l"], info["TimeLimit.truncated"], info["terminal_observation"][0])
            for info in self.locals["infos"]
            if "episode" in info
        ]

    note = Note(look)
    dqn(make()).learn(12, callback=note)
    assert note.seen == [[], [], [(6.0, 3, False, 3.0)] * 2] * 2


def test_recorded_numbers_reach_the_row_of_their_step(tmp_path):
    class Record(BaseCallback):
        def _on_step(self):
            self.logger.record("mine/last", self.n_calls)
            self.logger.record_mean("mine/mean", self.n_calls)
            return True

    sink = CsvFile(tmp_path / "rows.csv")
    dqn().learn(6, callback=Record(), log_interval=1, sinks=[sink])
    sink.close()
    with (tmp_path / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    # as Stable-Baselines3 2.9.2 writes them, when an episode of three steps has ended
    assert [(row["step"], row["mine/last"], row["mine/mean"]) for row in rows] == [("3", "3", "2.0"), ("6", "6", "5.0")]


def test_an_inner_callback_records_numbers_for_the_next_row(tmp_path):
    inner = Note(lambda self: self.logger.record("mine/n", self.n_calls))
    dqn().learn(6, callback=EveryNTimesteps(2, inner), log_interval=1, sinks=[CsvFile(tmp_path / "rows.csv")])
    with (tmp_path / "rows.csv").open() as file:
        assert [row["mine/n"] for row in csv.DictReader(file)] == ["1", "3"]
    with pytest.raises(TypeError, match=r"record\('mine/text'\) expected a number, got str"):
        Logger().record("mine/text", "words")


def test_the_best_model_is_kept_and_loads_under_either_suffix(tmp_path):
    evaluate = EvalCallback(Walk(1), eval_freq=5, n_eval_episodes=2, best_model_save_path=tmp_path / "best", verbose=0)
    agent = dqn().learn(10, callback=evaluate)
    assert evaluate.best_mean_reward == evaluate.last_mean_reward == 11.0
    assert [path.name for path in (tmp_path / "best").iterdir()] == ["best_model.zip"]
    for name in ("best_model", "best_model.zip", "best_model.safetensors"):
        loaded = rejeu.DQN.load(tmp_path / "best" / name)
        assert loaded.num_timesteps == 5
    assert agent.num_timesteps == 10
    with pytest.raises(FileNotFoundError, match=r"other\.zip"):
        rejeu.DQN.load(tmp_path / "best" / "other.zip")


def test_results_are_printed_logged_and_written(tmp_path, capsys):
    rows = []

    class Rows:
        def write(self, step, metrics):
            rows.append((step, dict(metrics)))

        def close(self):
            pass

    evaluate = EvalCallback(Walk(0), eval_freq=4, n_eval_episodes=2, log_path=tmp_path)
    dqn().learn(9, callback=evaluate, sinks=[Rows()], log_interval=100)
    assert "Eval num_timesteps=4, episode_reward=6.00 +/- 0.00" in capsys.readouterr().out
    expected = {"eval/mean_reward": 6.0, "eval/mean_ep_length": 3.0, "eval/success_rate": 1.0}
    assert rows == [(step, {**expected, "time/total_timesteps": step}) for step in (4, 8)]
    with np.load(tmp_path / "evaluations.npz", allow_pickle=False) as file:
        assert file["timesteps"].tolist() == [4, 8]
        assert file["successes"].tolist() == [[True, True]] * 2


def test_evaluation_wants_environments_of_its_own():
    env = Walk()
    with pytest.raises(ValueError, match="that the agent trains in; give it others"):
        dqn(env).learn(5, callback=EvalCallback(env))
    vector = make_vec_env(Walk)
    with pytest.raises(ValueError, match="that the agent trains in"):
        dqn(vector).learn(5, callback=EvalCallback(VecNormalize(vector)))
    with pytest.raises(TypeError, match="got str"):
        EvalCallback("CartPole-v1")


@pytest.mark.parametrize(
    ("stop", "best", "calls"),
    [
        (StopTrainingOnNoModelImprovement(1), [5, 5, 6, 6, 6], 5),
        (StopTrainingOnNoModelImprovement(0), [5, 6, 6], 3),
        (StopTrainingOnNoModelImprovement(1, min_evals=2), [5, 5, 5, 5], 4),
        (StopTrainingOnNoModelImprovement(1, min_evals=3), [5, 6, 6, 6, 6], 5),
        (StopTrainingOnRewardThreshold(5.0), [4.9, 5.0], 2),
    ],
)
def test_an_evaluation_stops_training(stop, best, calls, capsys):
    stop.parent, stop.verbose = EvalCallback(Walk(1)), 1
    for call, stop.parent.best_mean_reward in enumerate(best, 1):
        stop.n_calls = call
        assert stop._on_step() == (call < calls)
        assert ("Stopping" in capsys.readouterr().out) == (call == calls)


def test_judges_of_evaluations_belong_to_one():
    with pytest.raises(TypeError, match="StopTrainingOnRewardThreshold needs evaluations; give it to EvalCallback"):
        dqn().learn(5, callback=StopTrainingOnRewardThreshold(1.0))


def test_statistics_are_shared_with_the_evaluation():
    env = VecNormalize(make_vec_env(Walk, 2))
    eval_env = VecNormalize(make_vec_env(Walk, 1), training=False, norm_reward=False)
    agent = rejeu.PPO("MlpPolicy", env, n_steps=8, batch_size=16, policy_kwargs={"net_arch": [4]}, seed=0)
    taught(agent)
    evaluate = EvalCallback(eval_env, eval_freq=8, n_eval_episodes=2, verbose=0)
    agent.learn(16, callback=evaluate)
    np.testing.assert_array_equal(eval_env.obs_rms.mean, env.obs_rms.mean)
    assert eval_env.ret_rms.count == env.ret_rms.count
    assert evaluate.last_mean_reward == 6.0
    with pytest.raises(ValueError, match="wrap both in the same way"):
        agent.learn(16, callback=EvalCallback(make_vec_env(Walk, 1), eval_freq=8))


def test_checkpoints_hold_all_that_learning_needs(tmp_path):
    env = VecNormalize(make_vec_env(Walk, 2))
    callback = CheckpointCallback(4, tmp_path, "dqn", save_replay_buffer=True, save_vecnormalize=True)
    agent = dqn(env).learn(16, callback=callback)
    names = {
        f"dqn_{kind}{step}_steps{'.pkl' if kind else '.zip'}"
        for step in (8, 16)
        for kind in ("", "replay_buffer_", "vecnormalize_")
    }
    assert {path.name for path in tmp_path.iterdir()} == names
    env = VecNormalize.load(tmp_path / "dqn_vecnormalize_16_steps.pkl", make_vec_env(Walk, 2))
    loaded = rejeu.DQN.load(tmp_path / "dqn_16_steps.zip", env=env)
    loaded.load_replay_buffer(tmp_path / "dqn_replay_buffer_16_steps.pkl")
    assert loaded.replay_buffer.size() == agent.replay_buffer.size() == 16


def test_a_list_calls_every_one_though_the_first_stops():
    first, second = Note(goes_on=lambda self: False), Note()
    assert dqn().learn(5, callback=CallbackList([first, second, StopTrainingOnMaxEpisodes(9)])).num_timesteps == 1
    assert second.seen == [1]


def test_the_training_environments_can_be_changed_between_steps():
    class Harder(BaseCallback):
        def _on_rollout_start(self):
            self.training_env.set_attr("scale", 1.0 + self.num_timesteps // 3)

        def _on_step(self):
            return True

    agent = dqn(train_freq=3).learn(9, callback=Harder())
    assert agent.history["return"].tolist() == [6.0, 12.0, 18.0]


def test_a_bar_is_shown(capsys):
    dqn().learn(5, callback=ProgressBarCallback())
    assert "5/5 steps" in capsys.readouterr().out


def test_hooks_are_called_where_episodes_or_time_end_training():
    events = []

    class Log(BaseCallback):
        def _on_training_end(self):
            events.append(self.num_timesteps)

        def _on_step(self):
            return True

    dqn(gym.wrappers.TimeLimit(Walk(5), 4)).learn(episodes=2, callback=Log())
    assert events == [8]
