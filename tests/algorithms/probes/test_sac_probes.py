"""What SAC alone does on the probes: its temperature reaches the target entropy; and hindsight solves sparse rewards."""

from __future__ import annotations

import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import ByAction
from tests.environments import Reach
from tests.helpers import small_sac


def test_the_automatic_temperature_reaches_the_target_entropy():
    """The policy starts with 0.5 nats and the best action alone would have none left; the target is -2."""
    entropies = []
    small_sac(
        ByAction(), target_entropy=-2.0, learning_rate=3e-3, batch_size=32, learning_starts=64, ent_coef="auto_0.1"
    ).learn(1000, callback=lambda _, p: entropies.append(p.metrics["entropy"]) if p.step > 700 else None)
    assert np.mean(entropies) == pytest.approx(-2.0, abs=0.4)


def test_hindsight_solves_what_sparse_rewards_alone_do_not():
    """A point that must be brought within 0.5 of a goal, up to 4 away, with steps of at most 1."""
    agent = small_sac(
        InProcess([Reach() for _ in range(4)], seed=0),
        replay_buffer_class=rejeu.HerReplayBuffer,
        gamma=0.8,
        learning_rate=3e-3,
        tau=0.05,
        batch_size=64,
        buffer_size=5000,
        learning_starts=200,
        policy_kwargs={"net_arch": [32, 32]},
    ).learn(1600)
    assert agent.evaluate(40, env=InProcess([Reach() for _ in range(4)], seed=1)).success_rate >= 0.9
