"""The table of episodes."""

import csv
import math

import numpy as np
import pytest

from rejeu.logs.history import COLUMNS, EpisodeTable, History
from rejeu.training.run import Episode

NAN = float("nan")


def history():
    rows = [
        (10, 0, 1.0, 10, NAN, 0.5),
        (20, 1, 3.0, 10, 1.0, 1.0),
        (25, 0, 5.0, 5, 0.0, 1.5),
        (40, 1, 7.0, 15, 1.0, 2.0),
    ]
    return History(Episode(*row) for row in rows)


def test_columns_come_by_name_in_order():
    table = history()
    assert len(table) == 4
    assert table["step"].tolist() == [10, 20, 25, 40]
    assert table["return"].tolist() == [1, 3, 5, 7]
    assert table["length"].dtype == np.float64
    assert list(table.to_dict()) == list(COLUMNS)


def test_the_moving_average_takes_up_to_a_window_of_values():
    assert history().moving_average("return", 2).tolist() == [1.0, 2.0, 4.0, 6.0]
    assert history().moving_average("return", 50).tolist() == [1.0, 2.0, 3.0, 4.0]


def test_the_moving_average_leaves_out_what_is_unknown():
    average = history().moving_average("success", 2)
    assert math.isnan(average[0])
    assert average[1:].tolist() == [1.0, 0.5, 0.5]


def test_the_moving_average_of_a_long_table_equals_the_plain_mean():
    values = np.random.default_rng(0).normal(size=200)
    table = History(Episode(i, 0, value, 1, NAN, 0.0) for i, value in enumerate(values))
    expected = [values[max(i - 6, 0) : i + 1].mean() for i in range(200)]
    np.testing.assert_allclose(table.moving_average("return", 7), expected, atol=1e-12)


def test_an_empty_table_has_empty_columns():
    assert History()["return"].shape == History().moving_average().shape == (0,)


def test_the_csv_file_holds_the_table(tmp_path):
    history().write_csv(tmp_path / "episodes.csv")
    with (tmp_path / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["return"] for row in rows] == ["1.0", "3.0", "5.0", "7.0"]
    assert rows[0].keys() == set(COLUMNS)
    assert rows[0]["success"] == "nan"


def test_a_table_put_back_is_the_same_history():
    one, two = history(), History()
    two.replace(one.table())
    np.testing.assert_equal(two.episodes, one.episodes)
    assert [type(value) for value in two.last(1)[0][:4]] == [int, int, float, int]
    assert [episode.step for episode in one.last(2)] == [25, 40]
    np.testing.assert_equal(one.last(9), one.episodes)
    assert History().table().shape == (0, 6)
    with pytest.raises(ValueError, match=r"float64\[n, 6\], got float64\[2, 3\]"):
        two.replace(np.zeros((2, 3)))


def returning(*returns, successes=None):
    """Returns a history of episodes of 10 steps and 2 s each."""
    successes = [NAN] * len(returns) if successes is None else successes
    rows = enumerate(zip(returns, successes, strict=True))
    return History(Episode(10 * i + 10, 0, value, 10, success, 2.0 * i + 2) for i, (value, success) in rows)


def test_records_are_the_episodes_that_returned_more_than_all_before_them():
    table = returning(-5.0, -7.0, -5.0, -1.0, -3.0, 0.0)
    assert [(episode.step, episode.episode_return) for episode in table.records()] == [
        (10, -5.0),
        (40, -1.0),
        (60, 0.0),
    ]
    assert table.record_rows.tolist() == [0, 3, 5]
    assert table.best_return == 0.0
    assert History().records() == []
    assert History().best_return == -math.inf


def test_a_table_put_back_has_the_same_records_and_counts_further_ones():
    one, two = returning(2.0, 1.0, 4.0), returning(9.0)
    two.replace(one.table())
    np.testing.assert_equal(two.records(), one.records())
    two.append(Episode(40, 0, 3.0, 10, NAN, 8.0))
    two.append(Episode(50, 0, 5.0, 10, NAN, 10.0))
    assert [episode.episode_return for episode in two.records()] == [2.0, 4.0, 5.0]


def test_a_summary_has_the_means_of_all_and_of_the_last_episodes():
    summary = returning(1.0, 2.0, 6.0, 3.0, successes=[0.0, NAN, 1.0, 1.0]).summary(window=2)
    assert (summary.steps, summary.seconds, summary.records) == (40, 8.0, 3)
    assert (summary.all.n, summary.all.mean_return, summary.all.mean_length) == (4, 3.0, 10.0)
    assert summary.all.std_return == pytest.approx(math.sqrt((4 + 1 + 9 + 0) / 4))
    assert summary.all.success_rate == pytest.approx(2 / 3)  # of the three that are known
    assert (summary.last.n, summary.last.mean_return, summary.last.std_return) == (2, 4.5, 1.5)
    assert summary.last.success_rate == 1.0
    longer = history().summary(window=2)
    assert (longer.all.mean_length, longer.last.mean_length, longer.last.lengths.tolist()) == (10.0, 10.0, [5, 15])
    assert (longer.last.returns.tolist(), longer.last.successes.tolist()) == ([5, 7], [0, 1])
    assert (summary.best.step, summary.best.episode_return) == (30, 6.0)


def test_a_summary_shows_itself_as_a_table():
    text = repr(returning(1.0, 2.0, successes=[0.0, 1.0]).summary())
    assert text.splitlines() == [
        "2 episodes in 20 steps, 4.0 s",
        "          all            last 2",
        "return     1.50 \N{PLUS-MINUS SIGN} 0.50    1.50 \N{PLUS-MINUS SIGN} 0.50",
        "length    10.00 \N{PLUS-MINUS SIGN} 0.00   10.00 \N{PLUS-MINUS SIGN} 0.00",
        "success          50.0%          50.0%",
        "best return 2.00 at step 20 (2 records)",
    ]
    assert repr(History().summary()) == "0 episodes in 0 steps, 0.0 s"
    assert "success" not in repr(returning(1.0).summary())
    with pytest.raises(ValueError, match="window=0 must be a whole number of at least 1"):
        History().summary(0)


def test_episode_table_grows_during_training(tmp_path):
    history = History([Episode(10, 0, 1.0, 10, math.nan, 0.1)])
    table = EpisodeTable(lambda: history, tmp_path / "episodes.csv")
    for step in (20, 30):
        history.append(Episode(step, 0, 2.0, 10, 1.0, 0.2))
        table.write(step, {})
    table.write(30, {})
    grown = (tmp_path / "episodes.csv").read_bytes()
    history.write_csv(tmp_path / "whole.csv")
    assert grown == (tmp_path / "whole.csv").read_bytes()
