"""Videos: what is in the file, what happens to the file when something goes wrong, what a notebook is given."""

import base64
import builtins
import ctypes.util
import importlib.util
import os
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs import rendering
from rejeu.logs import video as video_file
from rejeu.logs.video import VideoFile, record_video, rendering_env, show_videos
from tests.environments import Timed
from tests.tiers import exhaustive


class Lamp(Timed):
    """Episodes of 4 steps; the picture of step t has the grey value 40 t. Odd sizes, 8 frames per second."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}
    observation_space = gym.spaces.Box(0, 10, (1,), np.float32)
    length, ends = 4, "terminated"
    closed = False

    def __init__(self, render_mode=None):
        self.render_mode, self.seeds = render_mode, []

    def begin(self, seed):
        self.seeds.append(seed)

    def observe(self):
        return np.full(1, self.time, np.float32)

    def render(self):
        return np.full((33, 51, 3), 40 * self.time, np.uint8)

    def close(self):
        self.closed = True


class Blank(Lamp):
    """Renders nothing."""

    def render(self):
        return None


@pytest.mark.parametrize("frame", [np.full((4, 6), 7), np.full((4, 6, 1), 7.0), np.full((4, 6, 4), 7, np.int64)])
def test_frames_of_other_types_are_taken_if_their_values_fit(frame):
    shown = rendering.rgb_frame(SimpleNamespace(render=lambda: frame))
    assert (shown.dtype, shown.shape, shown.min(), shown.max()) == (np.uint8, (4, 6, 3), 7, 7)
    with pytest.raises(ValueError, match=r"returned an array of shape .* expected whole numbers from 0 to 255"):
        rendering.rgb_frame(SimpleNamespace(render=lambda: frame + 0.5))


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


@pytest.mark.parametrize(("module", "name"), [("mujoco", "UnexpectedError"), ("elsewhere", "FatalError")])
def test_other_errors_of_drawing_are_left_as_they_are(module, name, tmp_path):
    env = Dark(module, name)
    with pytest.raises(env.error, match=r"^no context$"):
        record_video(Still(), tmp_path / "v.mp4", env)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a screen")
@pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="MuJoCo is not installed")
def test_the_command_line_says_in_one_line_what_mujoco_lacks(tmp_path):
    model = rejeu.SAC("MlpPolicy", gym.make("InvertedPendulum-v5"), seed=0).save(tmp_path / "agent")
    shown = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    result = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "rejeu", "record", str(model)],
        capture_output=True,
        text=True,
        check=False,
        env=shown | {"MUJOCO_GL": "glfw"},
    )
    assert result.returncode == 2
    errors = [line for line in result.stderr.splitlines() if "rror" in line]
    assert errors[0].startswith("rejeu: error: ")
    assert "set the environment variable MUJOCO_GL=egl (or osmesa)" in errors[0]
    assert "Traceback" not in result.stderr


def test_recording_is_of_the_deterministic_policy_and_ends_after_max_steps_over_all_episodes(lamp, tmp_path):
    agent = Still()
    path = record_video(agent, tmp_path / "v.mp4", lamp, episodes=5, max_steps=6, seed=7)
    assert len(decode(path).frames) == 9 + 3
    assert agent.asked == [True] * 6
    assert lamp.seeds == [7, None]
    found = decode(record_video(agent, tmp_path / "slow.mp4", lamp, episodes=1, fps=4))
    assert (found.fps, len(found.frames)) == (4, 5 + 2)


def test_suffix_and_folders_are_supplied_and_only_environments_made_here_are_closed(lamp, tmp_path):
    path = record_video(Still(), tmp_path / "a" / "b" / "v", lamp, episodes=1)
    assert path == tmp_path / "a" / "b" / "v.mp4"
    assert os.listdir(path.parent) == ["v.mp4"]
    assert not lamp.closed
    record_video(Still(), path, lambda: lamp, episodes=1)
    assert lamp.closed


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


def test_the_environment_of_a_loaded_agent_is_made_again_with_its_arguments(tmp_path):
    import rejeu

    env = rejeu.make_vector("Pendulum-v1", 1, "gymnasium", g=2.0)
    rejeu.SAC("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [8]}).save(tmp_path / "model")
    assert rendering_env(rejeu.load(tmp_path / "model"), None).unwrapped.g == 2.0


def test_environments_in_worker_processes_are_made_again_with_their_arguments():
    vector = SimpleNamespace(env_id="Pendulum-v1", wrapped_by=None)
    agent = SimpleNamespace(run=SimpleNamespace(env=vector), origin=("Pendulum-v1", {"g": 2.0}))
    assert rendering_env(agent, None).unwrapped.g == 2.0


def test_parking_is_drawn_and_plays_at_15_frames_a_second(tmp_path):
    path = record_video(StillCar(), tmp_path / "v.mp4", "parking-v0", episodes=1, max_steps=5, seed=0)
    found = decode(path)
    assert found.frames.shape == (6, 300, 600, 3)
    assert found.frames.std() > 10  # not blank, although the tests set SDL_VIDEODRIVER=dummy
    assert found.fps == 15


class StillCar:
    def predict(self, obs, state=None, episode_start=None, deterministic=False):
        return np.array([1.0, 0.5], np.float32), None


@pytest.mark.parametrize("setting", [None, "dummy", "x11"])
def test_environment_variables_are_put_back(setting, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if setting is None:
        monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    else:
        monkeypatch.setenv("SDL_VIDEODRIVER", setting)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "given")
    before = dict(os.environ)
    with suppress(KeyError), rendering.display_for_pygame():
        inside = os.environ.get("SDL_VIDEODRIVER")
        raise KeyError
    assert dict(os.environ) == before
    assert inside in ({"x11"} if setting == "x11" else {None, "dummy"})


def test_the_display_is_open_before_a_drawing_imports_highway_env_with_its_first_picture(monkeypatch, tmp_path):
    (tmp_path / "pygame").mkdir()
    (tmp_path / "pygame" / "__init__.py").touch()
    (tmp_path / "pygame" / "display.py").write_text(
        "import os\ndrivers = []\nget_init = lambda: bool(drivers)\n"
        "init = lambda: drivers.append(os.environ['SDL_VIDEODRIVER'])\n"
    )
    for name in ("pygame", "pygame.display"):  # as before anything has imported it
        monkeypatch.setitem(sys.modules, name, None)
        del sys.modules[name]
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with rendering.display_for_pygame():
        assert "SDL_VIDEODRIVER" not in os.environ  # else highway-env's viewer stays black
        assert sys.modules["pygame.display"].drivers == ["dummy"]


def test_driver_is_left_alone_where_there_is_a_display(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    with rendering.display_for_pygame():
        assert "SDL_VIDEODRIVER" not in os.environ
    assert Path(os.environ["XDG_RUNTIME_DIR"]).is_dir()  # SDL complains without it


def test_an_error_leaves_the_older_file_and_nothing_half_written(lamp, tmp_path):
    path = tmp_path / "v.mp4"
    path.write_bytes(b"older")
    agent = Still()
    agent.predict = lambda *a, **k: 1 / 0
    with pytest.raises(ZeroDivisionError):
        record_video(agent, path, lamp)
    assert path.read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["v.mp4"]


def test_what_ffmpeg_says_is_passed_on(tmp_path):
    writer = VideoFile(tmp_path / "v.mp4", 1e99)  # no rate that ffmpeg takes
    writer.write(np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(OSError, match=r"could not be written; ffmpeg: \S"):
        writer.close()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("suffix", "beginning"), [(".gif", b"GIF89a"), (".webm", b"\x1aE\xdf\xa3")])
def test_a_video_is_a_gif_or_webm_by_its_suffix(tmp_path, suffix, beginning):
    with VideoFile(tmp_path / f"clip{suffix}", 10) as video:
        for value in (0, 200):
            video.write(np.full((9, 11, 3), value, np.uint8))  # odd sizes
    assert video.path.read_bytes().startswith(beginning)
    with pytest.raises(ValueError, match=r"must end in one of \.mp4, \.webm, \.gif"):
        VideoFile(tmp_path / "clip.avi", 10)


def test_frames_of_another_shape_or_type_are_refused(tmp_path):
    for bad in (np.zeros((8, 6, 3), np.uint8), np.zeros((8, 8, 3))):
        writer = VideoFile(tmp_path / "v", 30)
        writer.write(np.zeros((8, 8, 3), np.uint8))
        with pytest.raises(ValueError, match=r"frame 1 is .* expected uint8 of shape \(8, 8, 3\)"):
            writer.write(bad)
        writer.discard()
    assert os.listdir(tmp_path) == []


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
        ({"path": "v.avi"}, r"must end in one of \.mp4"),
    ],
)
def test_bad_arguments_are_named(arguments, message, lamp, tmp_path):
    given = {"path": "v.mp4", "env": lamp} | arguments
    with pytest.raises(TypeError if given["env"] == 3 else ValueError, match=message):
        record_video(Still(), tmp_path / given.pop("path"), **given)
    assert os.listdir(tmp_path) == []


def hide(monkeypatch, package):
    real = builtins.__import__

    def import_(name, *args, **kwargs):
        if name.split(".")[0] == package:
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", import_)
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)


@exhaustive
def test_training_episodes_are_filmed_by_gymnasiums_wrapper(tmp_path):
    pytest.importorskip("moviepy")
    env = gym.make("Pendulum-v1", render_mode="rgb_array", max_episode_steps=10)
    env = gym.wrappers.RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda episode: episode % 2 == 0)
    agent = rejeu.SAC("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, seed=0).learn(30)
    env.close()
    record_video(
        agent, tmp_path / "after.mp4", episodes=1, max_steps=5
    )  # in an environment that records nothing itself
    assert {path.name for path in (tmp_path / "videos").iterdir()} == {
        "rl-video-episode-0.mp4",
        "rl-video-episode-2.mp4",
    }


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


@pytest.mark.exhaustive
def test_an_environment_of_envpool_is_filmed_though_its_package_was_not_imported(tmp_path):
    pytest.importorskip("highway_env")
    script = """if True:
        import sys, rejeu
        env = rejeu.make_vector("parking-v0", 2, "envpool", seed=0)
        agent = rejeu.SAC("MultiInputPolicy", env, policy_kwargs={"net_arch": [8]}, seed=0)
        assert "highway_env" not in sys.modules
        print(rejeu.record_video(agent, sys.argv[1], max_steps=3))
    """
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "film")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[-1]).stat().st_size > 1000


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
