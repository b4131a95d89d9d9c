"""What was played, read back: by Minari, and from the video."""

import re
import sys

import numpy as np
import pytest

from rejeu.envs.registry import make_env
from rejeu.lab.cli import main
from rejeu.logs.video import HOLD_SECONDS
from rejeu.teaching.play import play
from tests.helpers import error_of
from tests.logs.test_video import decode
from tests.playing import LEVER, Lever, down, hold, perform, tap, up

minari = pytest.importorskip("minari")


def play_and_record(folder, env=LEVER):
    """Plays an episode of 5 steps with d held, gives one up after 2, and another of which none was taken."""

    def script(window, game):
        down("d")
        while game.phase != "over":
            yield
        up("d")
        while game.phase == "over":
            yield
        tap("a")
        yield
        yield
        tap("r")
        yield

    perform(script, main, ["play", env, "--seed", "3", "--record", str(folder)])


def test_a_recording_is_read_back_by_minari(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    play_and_record(tmp_path / "played")
    text = capsys.readouterr().out
    assert "2 episodes in video.mp4" in text
    dataset_id = re.search(r"load_dataset\('(.*)'\)", text).group(1)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "played"))
    dataset = minari.load_dataset(dataset_id)
    whole, given_up = dataset[0], dataset[1]
    assert whole.actions.tolist() == [2] * 5
    assert whole.rewards.tolist() == [2.0] * 5
    assert (whole.terminations.tolist(), whole.truncations.tolist()) == ([False] * 4 + [True], [False] * 5)
    assert given_up.actions.tolist() == [0, 1]
    assert (given_up.terminations.tolist(), given_up.truncations.tolist()) == ([False] * 2, [False, True])
    env = make_env(LEVER)
    expected = [env.reset(seed=3)[0], *(env.step(2)[0] for _ in range(5))]
    np.testing.assert_array_equal(whole.observations, expected)
    assert [row["seed"] for row in dataset.storage.get_episode_metadata([0, 1])] == [3, 4]
    assert dataset.recover_environment().unwrapped.render_mode is None
    assert not (tmp_path / "home").exists()


def test_an_environment_that_cannot_be_described_or_has_no_id_is_recorded_all_the_same(tmp_path, monkeypatch):
    play_and_record(tmp_path / "played", "rejeu-play-test/Class-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "played"))
    dataset = minari.load_dataset("rejeu-play-test/Class-v0/human-v0")
    assert (dataset.total_episodes, dataset.env_spec) == (2, None)
    assert dataset.observation_space == Lever.observation_space
    perform(hold(["d"], 4, lambda e: None, []), play, Lever, record=tmp_path / "other")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "other"))
    dataset = minari.load_dataset("Lever/human-v0")
    assert (dataset[0].actions.tolist()[:3], dataset.env_spec) == ([2, 2, 2], None)


def test_a_recording_is_also_a_video(tmp_path):
    play_and_record(tmp_path / "played")
    found = decode(tmp_path / "played" / "video.mp4")
    assert found.fps == 20
    held = round(HOLD_SECONDS * 20)
    expected = [0, 40, 80, 120, 160, 200] + [200] * held + [0, 40, 80] + [80] * held
    np.testing.assert_allclose(found.frames.mean((1, 2, 3)), expected, atol=4)


def test_goals_and_continuous_actions_are_recorded(tmp_path, monkeypatch):
    found = []
    perform(hold(["w", "d"], 4, lambda e: None, found), play, "parking-v0", seed=0, record=tmp_path / "played")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "played"))
    episode = minari.load_dataset("parking-v0/human-v0")[0]
    assert episode.actions.tolist() == [[1, 1]] * len(episode.actions)
    assert len(episode.actions) >= 3
    assert set(episode.observations) == {"observation", "achieved_goal", "desired_goal"}
    assert len(episode.observations["desired_goal"]) == len(episode.actions) + 1


def test_the_dataset_has_the_spaces_and_arguments_of_the_environment_that_was_played(tmp_path, monkeypatch):
    command = ["play", "rejeu/Ball-v0", "--env-kwargs", "dimension=3", "--record", str(tmp_path / "played")]
    perform(hold(["d", "w"], 4, lambda e: None, []), main, command)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "played"))
    dataset = minari.load_dataset("rejeu/Ball-v0/human-v0")
    assert dataset[0].actions.tolist() == [[2, 2, 0]] * len(dataset[0].actions)
    assert (dataset.observation_space.shape, dataset.recover_environment().observation_space.shape) == ((3,), (3,))


def test_nothing_played_leaves_nothing_behind_and_nothing_is_overwritten(tmp_path, capsys):
    assert perform(lambda window, game: iter(()), main, ["play", LEVER, "--record", str(tmp_path / "played")]) == 0
    assert "nothing was played" in capsys.readouterr().out
    assert not [*tmp_path.iterdir()]
    (tmp_path / "kept").write_text("")
    assert "is not an empty folder" in error_of(capsys, "play", LEVER, "--record", str(tmp_path))


def test_what_was_played_is_kept_when_something_goes_wrong(tmp_path, monkeypatch):

    def script(window, game):
        down("d")
        yield
        yield
        raise KeyError

    with pytest.raises(KeyError):
        perform(script, play, LEVER, record=tmp_path / "played")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "played"))
    assert minari.load_dataset("rejeu-play-test/Lever-v0/human-v0")[0].truncations.tolist() == [False, True]
    assert (tmp_path / "played" / "video.mp4").exists()


@pytest.mark.parametrize("package", ["minari", "h5py"])
def test_a_recording_without_minari_names_the_extra(capsys, tmp_path, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    text = error_of(capsys, "play", LEVER, "--record", str(tmp_path / "played"))
    assert 'pip install "rejeu[play]"' in text
