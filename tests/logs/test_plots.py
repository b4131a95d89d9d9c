import sys

import numpy as np
import pytest

from rejeu.core.errors import MissingExtra
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.history import History
from rejeu.logs.plots import learning_curve
from rejeu.training.run import Episode


def history(n=200, success=float("nan")):
    return History([Episode(1_000 * (i + 1), 0, -1000.0 + i, 50, success, i / 10) for i in range(n)])


def evaluated(step, success=float("nan")):
    return step, Evaluation(np.array([-500.0, -400.0]), np.array([50, 50]), np.array([success, success]))


def test_success_has_a_panel_of_its_own_where_it_is_known():
    assert len(learning_curve(history()).axes) == 1
    assert len(learning_curve(history(success=1.0)).axes) == 2


def test_the_line_is_the_moving_average():
    record = history(20)
    figure = learning_curve(record, window=5)
    line = next(line for line in figure.axes[0].lines if line.get_label() == "mean of 5 episodes")
    expected = [np.mean(record["return"][max(0, i - 4) : i + 1]) for i in range(20)]
    np.testing.assert_allclose(line.get_ydata(), expected)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"window": 0}, ValueError, "window=0 must be a whole number of at least 1"),
        ({"against": "epochs"}, ValueError, "step, seconds"),
        ({}, MissingExtra, r"rejeu\[plot\]"),
    ],
)
def test_what_cannot_be_drawn_is_an_error_that_says_why(given, error, message, monkeypatch):
    if not given:
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(error, match=message):
        learning_curve(history(), **given)


def test_a_notebook_shows_the_curve_without_matplotlibs_magic():
    from IPython.core.interactiveshell import InteractiveShell

    formatted, _ = InteractiveShell().display_formatter.format(history().plot())
    assert formatted["image/png"].startswith(b"\x89PNG")


@pytest.mark.parametrize(("against", "at"), [("step", [50_000, 100_000]), ("seconds", [4.9, 9.9])])
def test_evaluations_are_drawn_at_their_steps_or_at_their_time(against, at):
    """Episode 49 ended at step 50,000 after 4.9 s."""
    evaluations = [evaluated(50_000), evaluated(100_000)]
    axes = learning_curve(history(), against=against, evaluations=evaluations).axes[0]
    points = next(line for line in axes.lines if line.get_label().startswith("evaluation"))
    np.testing.assert_allclose(points.get_xdata(), at, rtol=1e-5)
    np.testing.assert_array_equal(points.get_ydata(), [-450, -450])
    assert (axes.get_xlabel() == "seconds of training") == (against == "seconds")


@pytest.mark.parametrize("n", [0, 1])
def test_a_run_of_hardly_any_episodes_can_be_drawn(tmp_path, n):
    learning_curve(history(n, success=1.0), tmp_path / "curve.png", evaluations=[evaluated(1_000, 1.0)])
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_of_matplotlibs_global_state_is_touched():
    import matplotlib

    backend = matplotlib.rcParams._get("backend")
    learning_curve(history(), title="a title")
    assert matplotlib.rcParams._get("backend") is backend
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_an_evaluation_draws_every_episode_by_success_and_the_mean_with_its_interval(tmp_path):
    result = Evaluation(np.array([1.0, 5.0, 3.0]), np.array([9, 9, 9]), np.array([0.0, 1.0, 1.0]))
    panel = result.plot(tmp_path / "evaluation.png").axes[0]
    shown = {line.get_label(): (line.get_xdata(), line.get_ydata()) for line in panel.lines}
    np.testing.assert_array_equal(shown["success (2)"], [[2, 3], [5.0, 3.0]])
    np.testing.assert_array_equal(shown["no success (1)"], [[1], [1.0]])
    assert shown["mean 3"][1][0] == 3.0
    (band,) = panel.patches
    assert (band.get_y(), band.get_y() + band.get_height()) == pytest.approx(result.return_interval)
    assert (tmp_path / "evaluation.png").exists()
    panel = Evaluation(np.array([1.0]), np.array([9]), np.array([np.nan])).plot().axes[0]
    assert not panel.patches
    assert [line.get_label() for line in panel.lines] == ["mean 1", "episodes"]
