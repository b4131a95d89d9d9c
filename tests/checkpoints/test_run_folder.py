"""Folders of runs, and who may write into them."""

import pytest

from rejeu.checkpoints import run_folder


@pytest.mark.parametrize("is_there", [True, False])
def test_of_two_runs_that_begin_at_once_in_a_folder_one_is_refused(is_there, tmp_path, monkeypatch):
    out, check_free = tmp_path / "out", run_folder.check_free
    if is_there:
        out.mkdir()

    def check(path):
        check_free(path)
        monkeypatch.setattr(run_folder, "check_free", check_free)
        run_folder.create(out, "CartPole-v1", "DQN", 0)  # the other process, between the check and what follows

    monkeypatch.setattr(run_folder, "check_free", check)
    with pytest.raises(FileExistsError, match="exists and is not an empty folder; name another"):
        run_folder.create(out, "CartPole-v1", "DQN", 0)
