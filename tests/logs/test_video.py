"""Videos: what is in the file, what happens to the file when something goes wrong, what a notebook is given."""

from __future__ import annotations

import base64
import ctypes.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest

from rejeu.envs import rendering
from rejeu.logs import video as video_file
from rejeu.logs.video import record_video, rendering_env, show_videos


class Lamp(gym.Env):
    """Episodes of 4 steps; the picture of step t has the grey value 40 t. Odd sizes, 8 frames per second."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}
    observation_space = gym.spaces.Box(0, 10, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.closed = False
        self.seeds = []

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        return np.full(1, self.time, np.float32), 0.0, self.time == 4, False, {}

    def render(self):
        return np.full((33, 51, 3), 40 * self.time, np.uint8)

    def close(self):
        self.closed = True


class Blank(Lamp):
    """Renders nothing."""

    def render(self):
        return None


class Still:
    """An agent that does nothing and remembers whether it was asked for its deterministic policy."""

    run = SimpleNamespace(env=None)

    def __init__(self):
        self.asked = []

    def predict(self, obs, state=None, episode_start=None, deterministic=False):
        self.asked.append(deterministic)
        return np.zeros(1, np.float32), None


@pytest.fixture
def lamp():
    return Lamp("rgb_array")


class Decoded(NamedTuple):
    frames: np.ndarray
    """``uint8 (n, height, width, 3)``."""
    stream: str
    """ffmpeg's description of the stream."""
    fps: float


def decode(path: Path) -> Decoded:
    """Reads a file with ffmpeg. (imageio's readers fork, which JAX warns of, and leave pipes open.)"""
    command = [video_file.ffmpeg(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    result = subprocess.run(command, capture_output=True, check=True)
    stream = re.search(r"Stream #0:0.*Video: .*", result.stderr.decode()).group()
    width, height = map(int, re.search(r", (\d+)x(\d+)", stream).groups())
    frames = np.frombuffer(result.stdout, np.uint8).reshape(-1, height, width, 3)
    return Decoded(frames, stream, float(re.search(r"([\d.]+) fps", stream).group(1)))


def test_frames_are_those_of_every_reset_and_step_with_the_last_one_held_and_odd_sizes_padded(lamp, tmp_path):
    found = decode(record_video(Still(), tmp_path / "v.mp4", lamp, episodes=2))
    # half a second at 8 frames per second is 4 more of the last one; H.264 changes grey values by a little
    episode = [0, 40, 80, 120, 160, 160, 160, 160, 160]
    assert found.frames.shape == (18, 34, 52, 3)
    np.testing.assert_allclose(found.frames[:, :33, :51].mean((1, 2, 3)), episode * 2, atol=4)
    assert "h264" in found.stream
    assert "yuv420p" in found.stream
    assert found.fps == 8


class Dark(Lamp):
    """Raises, where it should render, an error of this module and name."""

    def __init__(self, module, name):
        super().__init__("rgb_array")
        self.error = type(name, (Exception,), {"__module__": module})

    def render(self):
        raise self.error("no context")


def test_mujoco_without_a_screen_is_told_how_to_draw(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(ValueError, match=r"no OpenGL context with MUJOCO_GL=glfw, .* set .*MUJOCO_GL=egl") as caught:
        record_video(Still(), tmp_path / "v.mp4", Dark("mujoco", "FatalError"))
    assert "\n" not in str(caught.value)
    assert str(caught.value.__cause__) == "no context"
    assert not (tmp_path / "v.mp4").exists()


def test_recording_is_of_the_deterministic_policy_and_ends_after_max_steps_over_all_episodes(lamp, tmp_path):
    agent = Still()
    path = record_video(agent, tmp_path / "v.mp4", lamp, episodes=5, max_steps=6, seed=7)
    assert len(decode(path).frames) == 9 + 3
    assert agent.asked == [True] * 6
    assert lamp.seeds == [7, None]
    found = decode(record_video(agent, tmp_path / "slow.mp4", lamp, episodes=1, fps=4))
    assert (found.fps, len(found.frames)) == (4, 5 + 2)


def test_own_environment_is_made_again_with_its_arguments_and_wrappers(tmp_path):
    import rejeu
    from rejeu.sb3.common.monitor import Monitor

    gym.register("Lamp-v0", f"{__name__}:Lamp", max_episode_steps=2)
    try:
        scaled = gym.wrappers.RescaleObservation(gym.make("Lamp-v0"), np.float32(0), np.float32(1))
        env = Monitor(scaled, tmp_path / "log")
        agent = rejeu.SAC("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [8]})
        log = (tmp_path / "log.monitor.csv").read_bytes()
        made = rendering_env(agent, None)
        assert made.render_mode == "rgb_array"
        assert made.observation_space == env.observation_space
        assert len(decode(record_video(agent, tmp_path / "v.mp4", episodes=1)).frames) == 3 + 4
        assert (tmp_path / "log.monitor.csv").read_bytes() == log
    finally:
        del gym.registry["Lamp-v0"]


def test_an_error_leaves_the_older_file_and_nothing_half_written(lamp, tmp_path):
    path = tmp_path / "v.mp4"
    path.write_bytes(b"older")
    agent = Still()
    agent.predict = lambda *a, **k: 1 / 0
    with pytest.raises(ZeroDivisionError):
        record_video(agent, path, lamp)
    assert path.read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["v.mp4"]


def test_environment_that_cannot_render_is_an_error(tmp_path):
    class Dark(Lamp):
        metadata = {"render_modes": ["ansi"]}

    gym.register("Dark-v0", lambda: Dark())
    try:
        with pytest.raises(ValueError, match=r"Dark-v0 cannot be rendered to arrays.*'ansi'.*expected 'rgb_array'"):
            record_video(Still(), tmp_path / "v.mp4", "Dark-v0")
    finally:
        del gym.registry["Dark-v0"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "parkign-v0"}, "parking-v0"),
        ({"env": None}, "this agent has no environment"),
        ({"env": 3}, "got int"),
        ({"env": Lamp()}, r"render_mode=None .*render_mode='rgb_array'"),
        ({"env": Blank("rgb_array")}, r"render\(\) returned None, expected whole numbers from 0 to 255"),
        ({"episodes": 0}, "episodes=0"),
        ({"max_steps": 0}, "max_steps=0"),
        ({"fps": 0}, "fps=0"),
        ({"path": "v.avi"}, "must end in .mp4"),
    ],
)
def test_bad_arguments_are_named(arguments, message, lamp, tmp_path):
    given = {"path": "v.mp4", "env": lamp} | arguments
    with pytest.raises(TypeError if given["env"] == 3 else ValueError, match=message):
        record_video(Still(), tmp_path / given.pop("path"), **given)
    assert os.listdir(tmp_path) == []


def test_show_videos_embeds_the_files_in_order(tmp_path, capsys):
    for name in ("b-10", "b-2", "a-1", "b-1", ".b-3.partial"):
        (tmp_path / f"{name}.mp4").write_bytes(name.encode())
    shown = show_videos(tmp_path, prefix="b")
    found = re.findall(r"data:video/mp4;base64,([^']+)'", shown.data)
    assert [base64.b64decode(text) for text in found] == [b"b-1", b"b-2", b"b-10"]
    assert shown._repr_html_() == shown.data
    assert capsys.readouterr() == ("", "")


def test_show_videos_escapes_names_and_says_when_there_is_none(tmp_path):
    (tmp_path / "<b>'x'.mp4").write_bytes(b"")
    assert "<b>" not in show_videos(tmp_path).data
    text = show_videos(tmp_path, prefix="sac").data
    assert "No mp4 file whose name starts with sac" in text
    assert "<video" not in text


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="EGL is Linux's")
@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs EGL")
def test_mujoco_draws_without_a_screen(monkeypatch):
    pytest.importorskip("mujoco")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    env = gym.make("InvertedPendulum-v5", render_mode="rgb_array")
    env.reset(seed=0)
    frame = rendering.rgb_frame(env)
    env.close()
    assert frame.std() > 0
    assert "MUJOCO_GL" not in os.environ
