"""The ball environment: its rewards and ends, Gymnasium's own checks, exact resume, and what it looks like."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.stats import norm

import rejeu
from rejeu.envs.functional.ball_drawing import BallDrawing
from rejeu.teaching.ball import Ball
from tests.tiers import only

NOTHING = np.zeros(2, np.float32)
allow_pushes_of_two = pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
"""Gymnasium's checker recommends [-1, 1] to everybody, its own Pendulum included; the document's bounds are [-2, 2]."""


def placed(*position: float, sigma: float = 0.0, n_steps: int = 0, **kwargs) -> Ball:
    """Returns a ball at ``position`` after ``n_steps`` steps."""
    ball = Ball(len(position), sigma, **kwargs)
    ball.reset(seed=0)
    ball.set_state(ball.get_state() | {"position": list(position), "n_steps": n_steps})
    return ball


@allow_pushes_of_two
@pytest.mark.parametrize("dimension", [1, 2, 5])
def test_passes_gymnasiums_checker_with_no_other_warning(dimension):
    check_env(gym.make("rejeu/Ball-v0", dimension=dimension, sigma=2.0).unwrapped)


def test_next_position_is_position_plus_push_plus_noise():
    ball = Ball(3, sigma=0.5)
    start, _ = ball.reset(seed=7)
    push = np.array([0.5, -1.0, 2.0], np.float32)
    after, reward, terminated, truncated, info = ball.step(push)
    rng = np.random.default_rng(7)
    expected_start = rng.uniform(-2, 2, 3)
    np.testing.assert_allclose(start, expected_start, rtol=1e-6)
    np.testing.assert_allclose(after, expected_start + push + 0.5 * rng.standard_normal(3), rtol=1e-6)
    assert (reward, terminated, truncated, info) == (1.0, False, False, {})
    assert after.dtype == np.float32


LOST = (-10.0, True, False, {"is_success": False})


@pytest.mark.parametrize(
    ("start", "n_steps", "push", "after", "rest"),
    [
        ((1.0, -1.0), 0, (5.0, -2.5), (3.0, -3.0), (1.0, False, False, {})),  # pushes beyond the bounds are clipped
        ((0.0, 0.0), 0, (3.0, -np.inf), (2.0, -2.0), (1.0, False, False, {})),
        ((9.0, 0.0), 0, (1.0, 0.0), (10.0, 0.0), (1.0, False, False, {})),  # the wall itself is inside
        ((9.0, 0.0), 0, (1.5, 0.5), (10.0, 0.5), LOST),  # seen on the wall
        ((9.0, 0.0), 499, (2.0, 0.0), (10.0, 0.0), LOST),
    ],
)
def test_leaving_costs_in_the_step_that_leaves(start, n_steps, push, after, rest):
    found, *others = placed(*start, n_steps=n_steps).step(np.array(push))
    np.testing.assert_array_equal(found, np.float32(after))
    assert tuple(others) == rest


def test_holding_for_500_steps_is_a_time_limit_worth_50():
    ball = Ball(2, sigma=0.0)
    ball.reset(seed=0)
    steps = [ball.step(NOTHING) for _ in range(500)]
    assert [step[1] for step in steps] == [1.0] * 499 + [50.0]
    assert not any(step[2] for step in steps)
    assert [step[3] for step in steps] == [False] * 499 + [True]
    assert steps[-1][4] == {"is_success": True}


def over():
    ball = placed(9.0, 0.0)
    ball.step(np.array([2.0, 0.0]))
    return ball


def state_of(ball):
    ball.reset(seed=0)
    return ball.get_state()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: Ball().step(NOTHING), gym.error.ResetNeeded, r"call reset\(\) before step\(\)"),
        (lambda: over().step(NOTHING), gym.error.ResetNeeded, r"call reset\(\) before step\(\)"),
        (lambda: placed(0.0, 0.0).step(np.zeros(3)), ValueError, r"shape \(3,\), expected \(2,\)"),
        (lambda: placed(0.0, 0.0).step(np.array([np.nan, 0.0])), ValueError, "not a number"),
        (lambda: placed(0.0, 0.0).step(np.array([0.0, np.nan])), ValueError, "not a number"),
        (lambda: Ball(dimension=0), ValueError, "dimension"),
        (lambda: Ball(dimension=2.0), ValueError, "dimension"),
        (lambda: Ball(sigma=-1.0), ValueError, "sigma"),
        (lambda: Ball(sigma=np.nan), ValueError, "sigma"),
        (lambda: Ball(render_mode="ansi"), ValueError, "render_mode"),
        (lambda: Ball(3).set_state(state_of(Ball(2))), ValueError, "2 dimensions and this ball has 3"),
        (lambda: placed(0.0, 0.0).render(), ValueError, "render_mode='rgb_array'"),
    ],
)
def test_what_makes_no_sense_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize(
    "part",
    [{"position": [np.nan, 0.0]}, {"position": [11.0, 0.0]}, {"position": []}, {"n_steps": 500}, {"n_steps": -1}],
)
def test_a_state_in_which_no_ball_can_be_under_way_is_refused_and_changes_nothing(part):
    ball = Ball(2)
    before = state_of(ball)
    with pytest.raises(ValueError, match="no ball is under way"):
        ball.set_state(before | part)
    assert ball.get_state() == before


def test_restored_state_continues_exactly():
    ball, other = Ball(2, sigma=2.0), Ball(2, sigma=2.0)
    ball.reset(seed=3)
    ball.step(NOTHING)
    other.reset(seed=99)
    other.set_state(ball.get_state())
    for _ in range(20):
        if ball.over:
            np.testing.assert_array_equal(ball.reset()[0], other.reset()[0])
        one, two = ball.step(NOTHING), other.step(NOTHING)
        np.testing.assert_array_equal(one[0], two[0])
        assert one[1:] == two[1:]


def survival(sigma: float, n_cells: int = 400, n_steps: int = 500) -> float:
    """Returns the probability that clip(-x, -2, 2) holds one dimension, from its transition kernel on a grid."""
    edges = np.linspace(-10, 10, n_cells + 1)
    centres = 0.5 * (edges[:-1] + edges[1:])
    pushed = centres + np.clip(-centres, -2, 2)
    kernel = np.diff(norm.cdf((edges[None] - pushed[:, None]) / sigma), axis=1)
    density = np.where(np.abs(centres) <= 2, 1.0, 0.0)
    density /= density.sum()
    power = np.linalg.matrix_power(kernel, n_steps)
    return float(density @ power.sum(axis=1))


@pytest.mark.parametrize("sigma", only([2.0], [1.0, 2.0]))
def test_pushing_to_the_middle_holds_as_many_episodes_as_its_markov_chain_does(sigma):
    ball = Ball(2, sigma)
    position, _ = ball.reset(seed=0)
    held, n_episodes = 0, 100
    for _ in range(n_episodes):
        while not ball.over:
            position, *_, info = ball.step(np.clip(-position, -2, 2))
        held += info["is_success"]
        position, _ = ball.reset()
    expected = survival(sigma) ** 2
    assert expected == pytest.approx({1.0: 1.0, 2.0: 0.9}[sigma], abs=0.015)
    assert abs(held / n_episodes - expected) <= 4 * np.sqrt(expected * (1 - expected) / n_episodes) + 1e-9


@pytest.mark.parametrize("dimension", [1, 2])
def test_picture_shows_the_ball_where_it_is(dimension):
    """Counts pixels of the ball's blue around where the position is to be drawn, by the drawing's own scales."""
    pytest.importorskip("pygame")
    ball = placed(*[6.0, -3.0][:dimension], render_mode="rgb_array")
    frame = ball.render()
    assert frame.dtype == np.uint8
    height, width, channels = frame.shape
    assert channels == 3
    assert height % 2 == width % 2 == 0  # for videos
    drawing = BallDrawing(dimension, 500, "rgb_array")
    place = drawing.main.place
    x, y = drawing.main.points(np.array([ball.position]), 0)[0]
    patch = frame[round(y) - 5 : round(y) + 6, max(round(x) - 5, 0) : round(x) + 6].astype(int)
    assert (patch[..., 2] > patch[..., 0] + 40).mean() > 0.7
    inside = [(place(-10, 0)[0], place(10, 0)[0])] if dimension == 2 else []
    for left, right in inside:
        assert left < x < right
        assert (x - left) / (right - left) == pytest.approx(0.8)
    assert (place(0, -10)[1] - y) / (place(0, -10)[1] - place(0, 10)[1]) == pytest.approx(
        0.35 if dimension == 2 else 0.8
    )
    ball.close()


def test_pictures_differ_once_the_ball_is_lost():
    pytest.importorskip("pygame")
    ball = placed(9.0, 0.0, render_mode="rgb_array")
    before = ball.render()
    ball.step(np.array([2.0, 0.0]))
    after = ball.render()
    reddish = lambda frame: ((frame[..., 0].astype(int) - frame[..., 2]) > 100).sum()  # noqa: E731
    assert reddish(after) > reddish(before) + 200


def test_window_opens_and_closes_without_a_display(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    ball = Ball(1, render_mode="human")
    ball.reset(seed=0)
    ball.step(np.zeros(1))
    assert ball.render() is None
    ball.close()
    ball.close()


def test_several_balls_make_one_vector_environment():
    vector = rejeu.make_vector("rejeu/Ball-v0", n_envs=3, backend="auto", seed=0, sigma=2.0)
    obs = vector.reset()
    assert vector.backend == "gymnasium"
    assert vector.max_episode_steps == gym.spec("rejeu/Ball-v0").max_episode_steps == 500
    assert obs.shape == (3, 2)
    assert len(np.unique(obs)) == 6
    vector.close()
