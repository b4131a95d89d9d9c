"""Taking over from an agent while it trains, and from a clone, with key events in SDL's own queue."""

import signal

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.demonstrations import clone, dagger, read, record
from rejeu.lab.cli import main
from rejeu.teaching.play.assist import Assist, Expert
from rejeu.teaching.play.window import Window
from tests.environments import Timed
from tests.helpers import error_of
from tests.playing import LEVER, Pull, down, pygame, up
from tests.tiers import exhaustive

pytestmark = pytest.mark.usefixtures("learners_are_shared")
SMALL = {"policy_kwargs": {"net_arch": [8]}, "seed": 0}


class Slide(Timed):
    """Episodes of 10 steps; the observation is the last action."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    observation_space = action_space = gym.spaces.Box(-2, 2, (1,))

    def __init__(self, render_mode=None):
        self.render_mode, self.actions = render_mode, []

    def observe(self):
        return np.float32(self.actions[-1:]) if self.time else np.zeros(1, np.float32)

    def reward(self, action):
        self.actions.append(float(action[0]))
        return 1.0

    def render(self):
        return np.zeros((300, 300, 3), np.uint8)


gym.register("rejeu-assist-test/Slide-v0", f"{__name__}:Slide")
SLIDE = "rejeu-assist-test/Slide-v0"


def at_steps(monkeypatch, events):
    """Calls functions instead of waiting for the n-th step, from 0."""
    count = iter(range(10_000))
    monkeypatch.setattr(Window, "wait", lambda self, fps: events.get(next(count), lambda: None)())


def test_who_holds_a_key_acts_and_the_replay_buffer_holds_it(monkeypatch, tmp_path):
    pytest.importorskip("minari")
    at_steps(monkeypatch, {2: lambda: down("d"), 5: lambda: up("d"), 14: lambda: down("a"), 16: lambda: up("a")})
    env = gym.make(SLIDE, render_mode="rgb_array")
    agent = rejeu.SAC("MlpPolicy", env, learning_starts=1000, **SMALL)
    assist = Assist(tmp_path / "assisted")
    agent.learn(30, assist)
    actions = np.array(env.unwrapped.actions)
    full = np.flatnonzero(abs(actions) == 2.0)
    assert full.tolist() == [4, 5, 6, 16, 17]
    assert actions[full].tolist() == [2, 2, 2, -2, -2]
    assert assist.steps == 5
    stored = agent.replay_buffer.ring.action[agent.replay_buffer.ring.kind[:] != 2].ravel()
    assert np.count_nonzero(stored == 1.0) == 3
    assert np.count_nonzero(stored == -1.0) == 2
    shown = read(tmp_path / "assisted")
    assert [len(episode) for episode in shown.episodes] == [3, 2]
    assert shown.episodes[0].actions.ravel().tolist() == [2, 2, 2]
    assert shown.episodes[0].observations.ravel().tolist()[1:] == [2, 2, 2]


def test_a_closed_window_gives_the_agent_back(monkeypatch):
    at_steps(monkeypatch, {2: lambda: down("d"), 4: lambda: pygame.event.post(pygame.event.Event(pygame.QUIT))})
    env = gym.make(SLIDE, render_mode="rgb_array")
    agent = rejeu.SAC("MlpPolicy", env, learning_starts=1000, **SMALL).learn(30, Assist())
    assert agent.num_timesteps == 30
    assert sum(action == 2.0 for action in env.unwrapped.actions) == 2


def test_a_person_takes_over_from_a_clone(monkeypatch):
    held = {i: (lambda: down("d")) if i % 4 == 0 else (lambda: up("d")) for i in range(0, 400, 2)}
    at_steps(monkeypatch, held)
    env = gym.make(SLIDE, render_mode="rgb_array")
    agent = rejeu.PPO("MlpPolicy", env, **SMALL)
    labeled = dagger(agent, Expert(env), env, takes_over=True, rounds=2, steps=20, updates=200, learning_rate=1e-2)
    assert {float(a) for episode in labeled.episodes for a in episode.actions.ravel()} == {2.0}
    assert {len(episode) for episode in labeled.episodes} <= {1, 2}
    assert agent.predict(np.zeros(1, np.float32), deterministic=True)[0][0] > 1.5
    assert labeled.n_steps == 20  # of 40


def test_a_clone_that_nobody_corrects_stays_as_it_is(monkeypatch):
    at_steps(monkeypatch, {})
    env = gym.make(SLIDE, render_mode="rgb_array")
    shown = record(Zero(), env, 2, seed=0)
    one, other = (rejeu.PPO("MlpPolicy", env, **SMALL) for _ in range(2))
    clone(one, shown, 20, seed=0)
    labeled = dagger(other, Expert(env), env, shown, takes_over=True, rounds=2, steps=10, updates=20)
    assert labeled.n_steps == shown.n_steps
    obs = np.ones(1, np.float32)
    assert one.predict(obs, deterministic=True)[0] == other.predict(obs, deterministic=True)[0]


class Zero:
    """Plays 0."""

    def predict(self, obs, deterministic=True):
        return np.zeros(1, np.float32), None


def test_a_run_is_assisted(monkeypatch, tmp_path):
    pytest.importorskip("minari")
    at_steps(monkeypatch, {2: lambda: down("d"), 5: lambda: up("d")})
    out = tmp_path / "run"
    how = ["--algo", "SAC", "--steps", "20", "--seed", "0", "--out", str(out), "--no-report", "--no-video"]
    small = ["--evaluate-episodes", "1", "--import", __name__, "--set", "policy_kwargs.net_arch=[8]", "buffer_size=100"]
    assert main(["train", SLIDE, "--assist", *how, *small]) == 0
    assert read(out / "assisted").n_steps == 3


@exhaustive
def test_a_clone_is_corrected_by_hand(monkeypatch, tmp_path, capsys):
    pytest.importorskip("minari")
    record(Zero(), gym.make(SLIDE, render_mode="rgb_array"), 1, tmp_path / "shown", seed=0)
    played = ["--updates", "5", "--by-hand", "--rounds", "1", "--round-steps", "10", "--algo", "PPO", "--seed", "0"]
    rest = ["--no-report", "--no-video", "--evaluate-episodes", "1", "--import", __name__]
    at_steps(monkeypatch, {2: lambda: down("d"), 5: lambda: up("d")})
    assert (
        main(["clone", str(tmp_path / "shown"), "--env", SLIDE, *played, *rest, "--out", str(tmp_path / "clone")]) == 0
    )
    assert "round  1      13 labeled steps" in capsys.readouterr().out


def test_what_cannot_be_assisted_is_one_line(tmp_path, capsys):
    out = ["--out", str(tmp_path / "run"), "--set", "policy_kwargs.net_arch=[8]"]
    imports = ["--import", "tests.playing"]
    argv = ["train", SLIDE, "--assist", "--algo", "PPO", "--import", __name__, *out]
    assert "learns from its own actions alone" in error_of(capsys, *argv)
    assert "for a single run" in error_of(capsys, "train", LEVER, "--assist", "--seeds", "2", *imports)
    switches = ["rejeu-play-test/Switches-v0", "--assist", "--algo", "SAC"]
    assert error_of(capsys, "train", *switches, *out, *imports)
    assert "exclude each other" in error_of(capsys, "clone", "nothing", "--by-hand", "--expert", "run")
    agent = rejeu.SAC("MlpPolicy", rejeu.make_vector("Pendulum-v1", 2, "gymnasium"), **SMALL)
    with pytest.raises(ValueError, match="needs one environment"):
        agent.learn(10, Assist())
    assert Pull().predict(None, deterministic=True)[0] == 2


def test_without_a_screen_nothing_is_trained_first(monkeypatch, tmp_path, capsys):
    pygame.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    monkeypatch.delenv("DISPLAY", raising=False)
    how, out = [SLIDE, "--assist", "--algo", "SAC", "--set", "policy_kwargs.net_arch=[8]"], tmp_path / "run"
    assert "cannot open a window" in error_of(capsys, "train", *how, "--out", str(out))
    assert not out.exists()
    with pytest.raises(OSError, match="cannot open a window"):
        Expert(gym.make(SLIDE, render_mode="rgb_array"))


def test_a_pause_ends_with_the_training(monkeypatch):
    """After Ctrl-C nobody waits for a key in a window that is paused."""

    def stop():
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_p))
        signal.raise_signal(signal.SIGINT)

    at_steps(monkeypatch, {3: stop})
    env = gym.make(SLIDE, render_mode="rgb_array")
    agent = rejeu.SAC("MlpPolicy", env, learning_starts=1000, **SMALL).learn(30, Assist())
    assert 0 < agent.num_timesteps < 10
