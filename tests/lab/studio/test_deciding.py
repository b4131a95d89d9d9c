"""Bars of what an agent weighs at a step."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

import rejeu
from rejeu.lab.studio.deciding import MOST_BARS, bars_of, number_names, samples, spread_bars, value_bars


def test_of_many_actions_the_most_valued_are_shown_in_their_order():
    values = np.arange(30.0)[::-1]
    bars = value_bars(values, [str(i) for i in range(30)], 0, 29.0)
    assert [bar.name for bar in bars] == [str(i) for i in range(MOST_BARS)]
    assert [bar.is_chosen for bar in bars] == [True] + [False] * (MOST_BARS - 1)


def test_equal_values_are_no_preference():
    assert {bar.end for bar in value_bars(np.array([2.0, 2.0]), "ab", 0, 0.0)} == {1.0}


def test_mean_spread_and_action_are_between_the_bounds():
    drawn = np.array([[0.0, 3.0], [1.0, 5.0]])  # means 0.5 and 4, standard deviations 0.5 and 1
    first, second = spread_bars(drawn, np.array([1.0, 4.0]), np.array([-1.0, -np.inf]), np.array([1.0, np.inf]), "ab")
    assert (first.start, first.end, first.mark, first.text) == (0.5, 1.0, 1.0, "0.50 ± 0.50")
    assert (second.start, second.end, second.mark) == (0.25, 0.75, 0.5)  # from 2 to 6, one around all that was drawn


@pytest.mark.parametrize(
    ("algorithm", "env_id", "names"),
    [
        ("DQN", "CartPole-v1", ["left", "right"]),
        ("PPO", "CartPole-v1", ["left", "right"]),
        ("PPO", "Pendulum-v1", ["clockwise / counterclockwise"]),
    ],
)
def test_an_agent_has_bars_for_its_actions(algorithm, env_id, names):
    env = gym.make(env_id)
    agent = getattr(rejeu, algorithm)("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, seed=0)
    obs, _ = env.reset(seed=0)
    action, memory = agent.predict(obs, deterministic=True)
    extents = [1e9]
    bars = bars_of(agent, env, (obs, memory, action), extents)
    assert [bar.name for bar in bars] == names
    if len(names) > 1:
        assert [bar.is_chosen for bar in bars] == [i == action for i in range(2)]
    if algorithm == "DQN":
        assert [bar.text for bar in bars] == [f"{value:.4g}" for value in agent.q_values(obs, None, "mean")]
        assert [bar.end for bar in bars] == pytest.approx(
            [1.0, 1.0]
        )  # next to the differences before there is hardly any
        assert extents[1:] == [np.ptp(agent.q_values(obs, None, "mean"))]
    elif len(names) > 1:
        assert sum(bar.end for bar in bars) == pytest.approx(1.0)
        assert [bar.text for bar in bars] == [f"{100 * bar.end:.0f} %" for bar in bars]
    else:
        assert bars[0].start < (agent.predict(obs, deterministic=True)[0][0] + 2) / 4 < bars[0].end


@pytest.mark.parametrize(("size", "n"), [(4, 256), (84 * 84 * 4, 16)])
def test_of_pictures_fewer_actions_are_drawn(size, n):
    class Sampler:
        """Draws as many actions as it has observations, with a memory of two numbers for each."""

        def predict(self, obs, memory, deterministic):
            assert (memory.shape, deterministic) == ((len(obs), 2), False)
            return np.arange(len(obs)), memory

    assert samples(Sampler(), np.zeros(size), np.zeros((1, 2))).tolist() == list(range(n))


def test_numbers_are_called_by_the_keys_that_change_them():
    env = SimpleNamespace(spec=SimpleNamespace(id="LunarLanderContinuous-v3"))
    assert number_names(env, gym.spaces.Box(-1, 1, (2,))) == ["main engine", "left / right"]
    assert number_names(env, gym.spaces.Box(-1, 1, (7,))) == [f"number {i + 1}" for i in range(7)]
