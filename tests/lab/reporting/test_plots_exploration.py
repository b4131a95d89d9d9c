"""Pictures of noise: its processes, the repulsive boundary, and saturation with and without it."""

import numpy as np
import pytest

from rejeu.exploration.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, ParameterNoise
from rejeu.logs import plots


def curves(panel) -> list[np.ndarray]:
    """Returns what the solid lines of a panel show, bounds and marks left out."""
    return [np.asarray(line.get_ydata(), float) for line in panel.lines if len(line.get_xdata()) > 2]


def test_the_curves_of_noise_are_what_calling_it_gives():
    noise = OrnsteinUhlenbeckActionNoise([0.1], [0.3], theta=1.0, dt=0.1)
    noise.reset(seed=4)
    expected = [noise().item() for _ in range(50)]
    figure = plots.noise(noise, n_steps=50, n_processes=1, seed=4)
    (shown,) = curves(figure.axes[0])
    np.testing.assert_allclose(shown, expected, atol=1e-7)


def test_several_noises_have_a_panel_each_of_one_scale_and_a_curve_for_each_process_and_dimension():
    noises = [NormalActionNoise([0.0, 0.0], 0.1), OrnsteinUhlenbeckActionNoise([0.0, 0.0], 0.1)]
    figure = plots.noise(noises, n_steps=20, n_processes=3)
    assert [len(curves(panel)) for panel in figure.axes] == [6, 6]
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_the_boundary_holds_noise_back_only_where_the_action_is_near_it():
    """Between two runs with the same random numbers, one at 0 and one at 0.9, nothing but the push differs."""
    noise = OrnsteinUhlenbeckActionNoise([0.0], 0.05, repulsive=1e-3)
    middle, near = (
        np.concatenate(curves(plots.noise(noise, n_steps=100, action=a, seed=1).axes[0])) for a in (0.0, 0.9)
    )
    assert near.mean() < middle.mean() - 0.1


def test_the_repulsive_boundary_is_drawn_with_its_derivative_in_the_units_of_the_action():
    """The course's smile over [a, b] is z^6 with z = (x - a) / (b - a) pi - pi / 2, and 1e-4 times its slope is the push."""
    a, b, strength = -1.0, 2.0, 1e-4
    figure = plots.repulsive_boundary(4 * strength / (b - a) ** 2, low=a, high=b)
    for panel, power, factor in ((figure.axes[0], 6, 1.0), (figure.axes[1], 5, 6 * np.pi / (b - a))):
        line = max(panel.lines, key=lambda line: len(line.get_xdata()))
        z = (line.get_xdata() - a) / (b - a) * np.pi - np.pi / 2
        np.testing.assert_allclose(line.get_ydata(), strength * factor * z**power, atol=1e-12)


def test_saturation_is_drawn_in_red_and_counted_with_and_without_the_boundary():
    """As in the course: the policy at 0.6 of [-1, 1], sigma 0.4, strength 4e-4, 700 steps."""
    figure = plots.saturation(OrnsteinUhlenbeckActionNoise([0.0], 0.4, repulsive=4e-4))
    red = [
        sum(np.isfinite(line.get_ydata()).sum() for line in panel.lines if line.get_color() == "#cd3e34")
        for panel in figure.axes
    ]
    assert red[0] > 100
    assert red[1] == 0
    shares = [float(panel.texts[0].get_text().split(": ")[1].split("%")[0]) for panel in figure.axes]
    assert shares[0] == pytest.approx(21, abs=8)  # 0.21 over 500 processes, docs/exploration.md
    assert shares[1] == 0.0


@pytest.mark.parametrize("noise", [NormalActionNoise([0.0], 0.1), OrnsteinUhlenbeckActionNoise([0.0], 0.1)])
def test_saturation_of_noise_without_a_boundary_is_an_error_that_says_what_to_give(noise):
    with pytest.raises(ValueError, match=r"no repulsive boundary; use .*repulsive=1e-4"):
        plots.saturation(noise)


def test_noise_on_parameters_cannot_be_drawn_as_noise_on_actions():
    with pytest.raises(TypeError, match="not action noise"):
        plots.noise([ParameterNoise()])
