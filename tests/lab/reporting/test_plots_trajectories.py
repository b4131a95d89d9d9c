"""Trajectories as figures: a coordinate against time, the plane, and the plane beside every coordinate."""

import numpy as np
import pytest

from rejeu.logs import plots
from rejeu.teaching.ball import Ball


def course(panel) -> tuple[np.ndarray, np.ndarray]:
    """Returns what the longest line of a panel shows."""
    line = max(panel.lines, key=lambda line: len(line.get_xdata()))
    return np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)


def random_course(dimension: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(30, dimension)).cumsum(axis=0)


@pytest.mark.parametrize("shape", [(30,), (30, 1)])
def test_one_coordinate_is_drawn_against_steps(shape):
    points = random_course(1).reshape(shape)
    (panel,) = plots.trajectory(points, low=-20, high=20).axes
    x, y = course(panel)
    np.testing.assert_array_equal(x, np.arange(30))
    np.testing.assert_array_equal(y, points.ravel())
    walls = {line.get_ydata()[0] for line in panel.lines if len(line.get_xdata()) == 2}
    assert walls == {-20, 20}


def test_infinite_bounds_are_not_drawn():
    (panel,) = plots.trajectory(random_course(2), low=-np.inf, high=np.inf).axes
    assert not panel.patches
    assert np.isfinite(panel.get_xlim()).all()


def test_the_ball_draws_its_own_trajectory_where_it_left_included(tmp_path):
    ball = Ball(3, sigma=0.0)
    ball.reset(seed=0)
    starts = ball.position
    while not ball.over:
        ball.step(np.array([2.0, 0.0, 0.0]))
    assert ball.trajectory.shape == (ball.n_steps + 1, 3)
    np.testing.assert_array_equal(ball.trajectory[0], starts)
    assert ball.trajectory[-1, 0] > 10
    ball.plot(tmp_path / "ball.png")
    assert (tmp_path / "ball.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("points", "more", "message"),
    [
        (np.zeros((0, 2)), {}, "at least one row"),
        (np.zeros((2, 2, 2)), {}, r"expected \(n, dimension\)"),
        (np.zeros((2, 2)), {"names": ["x"]}, "must name all 2 coordinates"),
    ],
)
def test_what_is_no_trajectory_is_refused(points, more, message):
    with pytest.raises(ValueError, match=message):
        plots.trajectory(points, **more)
