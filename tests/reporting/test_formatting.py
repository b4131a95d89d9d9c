import re

import numpy as np

import rejeu
from rejeu.cli import main
from rejeu.reporting.evaluation import Evaluation


def test_one_episode_is_not_called_episodes(tmp_path, capsys):
    assert str(Evaluation(np.ones(1), np.ones(1), np.ones(1))).endswith("1 episode")
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", seed=0, policy_kwargs={"net_arch": [8]})
    path = agent.save(tmp_path / "cart")
    assert main(["record", str(path), "--episodes", "1", "--seed", "0"]) == 0
    assert re.search(r"cart\.mp4: 1 episode of ", capsys.readouterr().out)
