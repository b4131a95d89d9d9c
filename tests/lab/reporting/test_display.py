"""What a notebook shows: IPython's own formatters and display messages, without a kernel."""

import builtins
import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from IPython.core.displaypub import CapturingDisplayPublisher
from IPython.core.interactiveshell import InteractiveShell

import rejeu
from rejeu.callbacks import ProgressBar, progress_bar
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.history import History
from rejeu.logs.logging import CsvFile
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from rejeu.training.run import Episode, Progress

pytestmark = pytest.mark.usefixtures("learners_are_shared")
NAN = math.nan
SECONDS = dict.fromkeys(("env", "replay", "update", "total"), 0.0)


class ZMQInteractiveShell(InteractiveShell):
    """Named as the shell of a notebook is, by which libraries know one."""


class Publisher(CapturingDisplayPublisher):
    """Keeps what a cell's output would hold: a message with a known display id replaces the one before it."""

    def shown(self):
        cell = {}
        for i, message in enumerate(self.outputs):
            key = message["transient"].get("display_id", i)
            assert message["update"] == (key in cell)
            cell[key] = message["data"]["text/plain"]
        return list(cell.values())


@pytest.fixture
def notebook(monkeypatch):
    """The publisher of a shell that stands for a notebook's; afterwards there is none again."""
    shell = ZMQInteractiveShell.instance()
    shell.display_pub = Publisher()
    monkeypatch.setattr(builtins, "get_ipython", lambda: shell, raising=False)
    yield shell.display_pub
    ZMQInteractiveShell.clear_instance()


def formatted(thing):
    return InteractiveShell().display_formatter.format(thing)[0]


def test_the_progress_bar_is_one_output_that_stays_in_the_notebook(notebook, monkeypatch):
    ticks = iter(range(100))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    agent = SimpleNamespace(n_envs=1, ep_info_buffer=[{"r": -3.0}], ep_success_buffer=[], seconds=SECONDS)
    bar = ProgressBar(4, None)
    for step in range(1, 5):
        bar(agent, Progress(step, [], None))
    bar.close()
    assert len(notebook.outputs) == 4
    (text,) = notebook.shown()
    assert "█" * 40 + " 100%\n4/4 steps" in text
    assert "return -3.00" in text


def test_the_progress_bar_sends_few_messages_in_a_second(notebook):
    rejeu.PPO("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs={"net_arch": [8]}, seed=0).learn(
        256, progress_bar=True
    )
    assert "256/256 steps" in notebook.shown()[0]
    assert len(notebook.outputs) < 60


def test_a_command_in_a_cell_prints_lines_though_the_notebook_forces_colors(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(progress_bar, "LINE_SECONDS", 0.0)
    agent = SimpleNamespace(n_envs=1, ep_info_buffer=[], ep_success_buffer=[], seconds=SECONDS)
    bar = ProgressBar(2, None)
    for step in (1, 2):
        bar(agent, Progress(step, [], None))
    bar.close()
    text = capsys.readouterr().out
    assert [line[:4] for line in text.splitlines()] == [" 50%", "100%"]
    assert "\x1b" not in text


def test_verbose_training_keeps_one_table_up_to_date(notebook, tmp_path, capsys):
    agent = rejeu.PPO("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs={"net_arch": [8]}, seed=0, verbose=1)
    rows = CsvFile(tmp_path / "metrics.csv")
    agent.learn(256, log_interval=1, sinks=[rows])
    rows.close()
    steps = [line.split(",")[0] for line in (tmp_path / "metrics.csv").read_text().splitlines()[1:]]
    assert len(steps) == len(agent.history)  # files get every row
    (table,) = notebook.shown()
    assert table.startswith(f"step {int(steps[-1]):,}")
    assert capsys.readouterr().out == ""


def test_a_console_without_pauses_prints_every_row(capsys):
    console = rejeu.logs.logging.Console()
    for step in range(3):
        console.write(step, {"train/loss": 0.5})
    assert capsys.readouterr().out.count("step ") == 3


def test_an_evaluation_shows_its_numbers():
    evaluation = Evaluation(np.array([1.0, 3.0]), np.array([10, 20]), np.array([1.0, 0.0]))
    shown = formatted(evaluation)
    assert shown["text/plain"] == f"<Evaluation: {evaluation}>"
    assert "success 50.0%" in shown["text/plain"]
    assert "return 2.00 ± 1.00" in shown["text/plain"]
    assert (
        "<tr><th>return</th><td>2.00</td><td>-10.71 to 14.71</td><td>1.00</td></tr>" in shown["text/html"]
    )  # t = 12.706
    assert "<tr><th>success</th><td>50.0%</td>" in shown["text/html"]

    shown = formatted(Evaluation(np.array([2.0]), np.array([10]), np.array([NAN])))
    assert shown["text/plain"] == "<Evaluation: return 2.00 ± 0.00, length 10.0, 1 episode>"
    assert "<tr><th>return</th><td>2.00</td><td></td><td>0.00</td></tr>" in shown["text/html"]
    assert "success" not in shown["text/html"]


def test_a_history_shows_a_summary():
    rows = [(100 * (i + 1), 0, float(i), 50 + i % 2, float(i % 2), 0.5) for i in range(1_000)]
    assert formatted(History(Episode(*row) for row in rows))["text/plain"] == (
        "<History: 1,000 episodes in 100,000 steps; mean of the last 20: return 989.50, length 50.5, success 50%>"
    )
    assert repr(History([Episode(9, 0, -1.0, 9, NAN, 0.5)])) == (
        "<History: 1 episode in 9 steps; mean of the last 1: return -1.00, length 9.0>"
    )
    assert repr(History()) == "<History: no episodes>"
    mixed = [Episode(9, 0, -1.0, 9, success, 0.5) for success in (1.0, NAN, 0.0, 1.0)]
    assert "success 67%" in repr(History(mixed))  # of those where it is known


def test_vector_environments_show_what_they_step():
    assert repr(rejeu.make_vector("Pendulum-v1", 2, "gymnasium")) == "<InProcess: 2 x Pendulum-v1, backend 'gymnasium'>"
    inside = DummyVecEnv([lambda: gym.make("CartPole-v1")] * 2)
    assert repr(inside).startswith("<DummyVecEnv: 2 environments, observations Box(")
    assert repr(VecNormalize(inside)).endswith("actions Discrete(2)>")


def test_what_is_stored_is_counted(tmp_path):
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", buffer_size=500, policy_kwargs={"net_arch": [8]}, seed=0).learn(60)
    assert repr(agent.replay_buffer) == "<ReplayBuffer: 60 of 500 steps>"
    memory = rejeu.ReplayMemory(2_000, agent.observation_space, agent.action_space)
    assert repr(memory) == "<ReplayMemory: 0 of 2,000 transitions>"
    agent.remember_best(2.5, by="evaluation")
    assert repr(agent.best) == "<Best: evaluation 2.5 at step 60>"
    loaded = rejeu.load(agent.save(tmp_path / "cart"))
    assert repr(loaded).startswith("<rejeu.DQN on no environment, trained on CartPole-v1, 60 steps")


def test_agents_and_histories_are_tables():
    agent = rejeu.PPO("MlpPolicy", "CartPole-v1", seed=4)
    assert "<th>PPO</th><th>CartPole-v1</th>" in formatted(agent)["text/html"]
    assert "episodes" not in formatted(agent)["text/html"]
    agent.history.append(Episode(10, 0, 9.0, 10, NAN, 0.5))
    assert "mean of the last 1: return 9.00" in formatted(agent)["text/html"]
    text = formatted(agent.history)["text/html"]
    assert "1 episode in 10 steps" in text
    assert "<th>return</th><td>9.00 \N{PLUS-MINUS SIGN} 0.00</td>" in text
    assert "<table" not in formatted(History())["text/html"]
