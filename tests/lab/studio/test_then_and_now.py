"""Policies of the course of training side by side, without a browser."""

from functools import partial

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")
pytest.importorskip("pygame")

import rejeu
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.studio.then_and_now import FOOTER, HEADER, MARGIN, WIDTH, frames, in_row, open_game, policies, save_clip
from rejeu.teaching.play import opened
from tests.lab.reporting.report.folders import write
from tests.playing import LEVER, Pull


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run with models of 8 steps and more; that of 16 steps was the best."""
    folder = RunFolder(write(tmp_path_factory.mktemp("course") / "run", videos=False))
    folder.models.mkdir()
    settings = {"learning_starts": 100, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", seed=0, **settings)
    for step in (8, 16, 24, 32):
        agent.learn(8, reset_num_timesteps=False)
        agent.save(folder.models / f"step_{step:012}.safetensors")
        if step == 16:
            agent.save(folder.best)
    agent.save(folder.agent)
    return folder


def test_the_early_the_middle_the_best_and_the_current_policy_are_shown_once(folder):
    assert [*policies(folder)] == ["after 8 steps", "best, after 16 steps", "after 24 steps", "current, after 32 steps"]
    folder.best.rename(folder.path / "elsewhere")
    assert [model.stem for model in policies(folder).values()] == ["step_000000000008", "step_000000000024", "agent"]
    best = (folder.path / "elsewhere").read_bytes()
    folder.best.write_bytes(folder.agent.read_bytes())
    assert [*policies(folder)][-1] == "best, current, after 32 steps"
    folder.best.write_bytes(best)


def test_a_run_without_a_model_says_so(tmp_path):
    folder = RunFolder(write(tmp_path / "run", videos=False))
    folder.agent.unlink()
    with pytest.raises(FileNotFoundError, match="the first is kept at the first evaluation"):
        open_game(folder, RunOptions(), 0)


def test_all_begin_in_the_same_state_and_a_clip_is_saved(folder, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    with open_game(folder, RunOptions(), 3) as playing:
        playing.begin()
        starts = [player.obs for player in playing.game.players]
        assert len(starts) == 4
        np.testing.assert_array_equal(starts, starts[:1] * 4)
    path = save_clip(tmp_path / "clip.gif", folder, RunOptions(), 3)
    assert path.read_bytes()[:6] == b"GIF89a"


def test_a_clip_has_the_start_each_stride_and_the_end():
    start = partial(opened, LEVER, {"pull": Pull(), "again": Pull()}, False, seed=0)  # episodes of 5 steps
    with start() as playing:
        rows = [*frames(playing.game, stride=2)]
    assert len(rows) == 4  # after 0, 2, 4 and 5 steps
    middle = HEADER + WIDTH // 4
    assert [int(row[middle, MARGIN + 9, 0]) for row in rows] == [
        0,
        80,
        160,
        200,
    ]  # the lever's frame of step t is gray 40 t
    with start() as playing:
        assert len([*frames(playing.game, most_steps=3)]) == 4


def test_pictures_stand_in_one_row_with_words_above_and_below():
    captions = [{"name": "then", "score": "score 1", "message": "", "won": False}] * 2
    row = in_row([np.full((100, 2 * WIDTH, 3), value, np.uint8) for value in (10, 200)], captions)
    assert row.shape == (HEADER + 50 + FOOTER, 2 * WIDTH + 3 * MARGIN, 3)
    assert (row[HEADER + 25, [MARGIN + 5, 2 * MARGIN + WIDTH + 5]] == [[10] * 3, [200] * 3]).all()
    assert row[:HEADER].min() < 100  # letters
