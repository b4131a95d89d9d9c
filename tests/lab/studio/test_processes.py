"""Commands that the studio starts. No browser and no server."""

import pytest

from rejeu.lab.studio import processes


def test_a_command_that_is_under_way_is_not_started_again(tmp_path):
    words = ["runs", str(tmp_path)]
    process = processes.start(words, tmp_path / "mine")
    try:
        with pytest.raises(ValueError, match="rejeu runs is under way for mine; wait until it has ended"):
            processes.start(words, tmp_path / "mine")
    finally:
        process.kill()
        process.wait(30)
