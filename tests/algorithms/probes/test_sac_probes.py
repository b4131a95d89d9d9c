"""What SAC alone does on the probes: its temperature reaches the target entropy; and hindsight solves sparse rewards."""

from __future__ import annotations

import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import ByAction
from tests.environments import Reach
from tests.helpers import q_values, small_sac

GAMMA = 0.5
ALPHA = 0.01
"""Fixed temperature: a uniform policy on [-1, 1] has entropy log 2, so no value moves by more than 0.007 / (1 - gamma)."""


def solve(environment, steps=700):
    return small_sac(
        environment(),
        gamma=GAMMA,
        ent_coef=ALPHA,
        learning_rate=1e-2,
        tau=0.05,
        batch_size=32,
        buffer_size=2000,
        learning_starts=64,
        policy_kwargs={"net_arch": [32]},
    ).learn(steps)


def values(agent, sights):
    """Values of the agent's own best actions, which are what is learnt best."""
    obs = np.float32(sights)[:, None]
    action = agent.predict(obs, deterministic=True)[0] - 1.0  # bounds 0 and 2 to -1 and 1
    return q_values(agent, obs, action)


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
