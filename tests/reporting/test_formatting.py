import re

import numpy as np

import rejeu
from rejeu.cli import main
from rejeu.reporting.evaluation import Evaluation
from rejeu.reporting.formatting import number


def test_large_numbers_have_thousands_separators_and_small_ones_four_digits():
    assert [number(x) for x in (1234567.0, -1234567.0, 1000.0, -1000.4)] == [
        "1,234,567",
        "-1,234,567",
        "1,000",
        "-1,000",
    ]
    assert [number(x) for x in (999.96, -0.012345, 1e12, -1e30, np.nan)] == ["1000", "-0.01235", "1e+12", "-1e+30", "-"]


def test_one_episode_is_not_called_episodes(tmp_path, capsys):
    assert str(Evaluation(np.ones(1), np.ones(1), np.ones(1))).endswith("1 episode")
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", seed=0, policy_kwargs={"net_arch": [8]})
    path = agent.save(tmp_path / "cart")
    assert main(["record", str(path), "--episodes", "1", "--seed", "0"]) == 0
    assert re.search(r"cart\.mp4: 1 episode of ", capsys.readouterr().out)
