"""Reading and drawing the files that Monitor writes."""

import csv
import json
import tracemalloc

import numpy as np
import pytest
from matplotlib import pyplot

from rejeu.sb3.common.logger import read_csv, read_json
from rejeu.sb3.common.monitor import LoadMonitorResultsError
from rejeu.sb3.common.results_plotter import (
    X_EPISODES,
    X_TIMESTEPS,
    X_WALLTIME,
    load_results,
    plot_curves,
    plot_results,
    ts2xy,
    window_func,
)


def test_files_of_several_monitors_are_read_in_the_order_of_time(tmp_path):
    for name, start, rows in (("0", 100.0, "1.5,3,7.0,yes\n2.5,4,20.0,no\n"), ("1", 110.0, "-3.0,5,1.0,no\n")):
        head = json.dumps({"t_start": start, "env_id": "x"})
        (tmp_path / f"{name}.monitor.csv").write_text(f"#{head}\nr,l,t,won\n{rows}")
    table = load_results(tmp_path)
    # ends at 107, 120 and 111 seconds; counted from the first file's beginning
    assert table.r.tolist() == [1.5, -3.0, 2.5]
    assert table["t"].tolist() == [7.0, 11.0, 20.0]
    assert table["won"].tolist() == ["yes", "no", "no"]
    assert table["l"].dtype == np.int64
    assert [ts2xy(table, axis)[0].tolist() for axis in (X_TIMESTEPS, X_EPISODES)] == [[3, 8, 12], [0, 1, 2]]
    np.testing.assert_allclose(ts2xy(table, X_WALLTIME)[0], np.array([7, 11, 20]) / 3600)
    with pytest.raises(ValueError, match="must be one of timesteps, episodes, walltime_hrs"):
        ts2xy(table, "days")
    x, y = window_func(np.arange(4), np.array([1.0, 3.0, 5.0, 7.0]), 2, np.mean)
    assert (x.tolist(), y.tolist()) == ([1, 2, 3], [2.0, 4.0, 6.0])
    plot_curves([(np.arange(150), np.arange(150.0))], X_EPISODES, "line")
    assert pyplot.gcf().axes[0].lines[0].get_xdata()[0] == 99
    pyplot.close()
    plot_results([tmp_path], 10, X_TIMESTEPS, "runs")
    axes = pyplot.gcf().axes[0]
    assert (axes.get_title(), axes.collections[0].get_offsets().tolist()) == ("runs", [[3.0, 1.5], [8.0, -3.0]])
    pyplot.close()


def test_a_folder_without_monitor_files_is_an_error(tmp_path):
    with pytest.raises(LoadMonitorResultsError, match=r"no files \*monitor\.csv"):
        load_results(tmp_path)
    (tmp_path / "x.monitor.csv").write_bytes(bytes(2**24))  # a line, as of a terabyte of a sparse file
    tracemalloc.start()
    with pytest.raises(LoadMonitorResultsError, match="was not written by Monitor"):
        load_results(tmp_path)
    with pytest.raises(ValueError, match="Expecting value"):
        read_json(tmp_path / "x.monitor.csv")
    with pytest.raises(csv.Error, match="field limit"):
        read_csv(tmp_path / "x.monitor.csv")
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()
    (tmp_path / "x.monitor.csv").write_text("something else\n")
    with pytest.raises(LoadMonitorResultsError, match="was not written by Monitor"):
        load_results(tmp_path)
    (tmp_path / "x.monitor.csv").write_text(f'#{{"t_start": 0}}\nr,l,t\n1,1,"{"x" * 200_000}"\n')
    with pytest.raises(LoadMonitorResultsError, match="was not written by Monitor: field larger"):
        load_results(tmp_path)
    (tmp_path / "x.monitor.csv").write_text('#{"t_start": 0}\nr,l,t\n')
    (tmp_path / "y.monitor.csv").write_text('#{"t_start": 0}\nr,l,t,won\n')
    with pytest.raises(LoadMonitorResultsError, match="other files have"):
        load_results(tmp_path)
