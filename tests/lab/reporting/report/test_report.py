"""Pages about runs: their content, and everything that can be wrong with a run folder. No browser; see test_browser.py."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import rejeu
from rejeu.lab.cli import main
from rejeu.lab.reporting.report import page, record, sections, write_report
from rejeu.lab.runs import read as runs
from rejeu.logs import charts
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.tables import EMPTY, Table
from rejeu.training.run import Episode
from tests.lab.reporting.report.folders import CONFIG, EVIL, MP4, write, write_hostile


@pytest.fixture(autouse=True)
def small_script(monkeypatch):
    """Pages without the two megabytes of Plotly."""
    monkeypatch.setattr(page, "plotly_script", lambda: "plotly")


def text_of(*folders, **options):
    return write_report([*folders], **options).read_text(encoding="utf-8")


def data_of(text):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])


def test_page_of_a_run(tmp_path):
    folder = write(tmp_path / "run")
    text = text_of(folder)
    assert (folder / "report.html").is_file()
    assert "CartPole-v1" in text
    assert ">finished<" in text
    assert "Best evaluation, step 2,000" in text
    assert "50.0 %" in text
    assert "return 160.00 (155.68 to 164.32)" in text  # 160 +- 2.093 * 9 / sqrt(19)
    assert "Final evaluation, step 3,000" in text
    assert "rejeu train CartPole-v1 --algo DQN --steps 3000 --envs 2 --backend gymnasium --seed 3" in text
    assert "default 0.99" in text
    assert "linear: start 0.001, end 0.0" in text
    data = data_of(text)
    assert {"run0-return", "run0-success", "run0-length", "run0-time"} < set(data["charts"])
    assert sum(data["histograms"]["run0-episodes"]["counts"]) == 60


def test_the_last_evaluation_of_a_running_run_is_not_called_final(tmp_path):
    run = dataclasses.replace(runs.read_run(write(tmp_path / "run")), state="running")
    assert [(tile.title, tile.step) for tile in sections.tiles(run)][:2] == [
        ("Best evaluation", "2,000"),
        ("Newest evaluation", "3,000"),
    ]


def test_the_return_comes_first_until_an_evaluation_has_a_success(tmp_path):
    run = runs.read_run(write(tmp_path / "run"))
    best, final, *_ = sections.tiles(run)
    assert (best.value, best.note[:7], best.more) == ("50.0 %", "success", "return 160.00 (155.68 to 164.32)")
    table = run.evaluations
    never = dataclasses.replace(run, evaluations=Table({**table.columns, "success_rate": np.zeros(3)}))
    best, final, *_ = sections.tiles(never)
    assert (best.value, best.note, best.more) == ("160.00", "return, 95 % interval 155.68 to 164.32", "success 0.0 %")
    assert final.value == "150.00"


def test_several_runs_share_a_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_report([write(tmp_path / "a"), write(tmp_path / "b", videos=False)])
    text = path.read_text(encoding="utf-8")
    assert path.name == "report.html"
    assert "2 runs" in text
    assert {"run0-return", "run1-return"} < set(data_of(text)["charts"])


def test_hostile_text_is_escaped_everywhere(tmp_path):
    text = text_of(write_hostile(tmp_path))
    assert text.count("<script") == 3  # data, Plotly and the page's own
    assert EVIL not in text
    assert "<img" not in text
    assert "notevaluated" not in text
    assert "{{ &#39;not&#39; + &#39;evaluated&#39; }}{% raw %}" in text
    assert "secret" not in text
    assert "video.mp4 is no mp4 video" in text
    assert "incomplete" in text
    assert data_of(text)


@pytest.mark.parametrize(
    "missing", ["config.json", "episodes.csv", "metrics.csv", "evaluations.csv", "agent.safetensors", "videos"]
)
def test_page_is_complete_without_a_file(tmp_path, missing):
    folder = write(tmp_path / "run")
    path = folder / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    text = text_of(folder)
    assert text.rstrip().endswith("</html>")
    assert "<h2>Configuration</h2>" in text


def test_run_that_crashed_before_the_first_evaluation(tmp_path):
    folder = write(tmp_path / "run", episodes=0, videos=False)
    for name in ("evaluations.csv", "metrics.csv", "agent.safetensors"):
        (folder / name).unlink()
    (folder / "warnings.txt").write_text("BadEnvironmentError: reward is NaN\n", encoding="utf-8")
    text = text_of(folder)
    assert "none yet" in text
    assert "There is no evaluation yet." in text
    assert "BadEnvironmentError: reward is NaN" in text
    assert data_of(text) == {"charts": {}, "histograms": {}}


def test_videos_are_embedded_within_the_budget_and_else_linked(tmp_path, monkeypatch):
    folder = write(tmp_path / "run")
    (folder / "video.mp4").write_bytes(MP4)
    monkeypatch.setattr("rejeu.lab.reporting.report.sections.BUDGET", len(MP4) * 2 + 10)
    text = text_of(folder)
    assert text.count('src="data:video/mp4;base64,') == 2  # of the best model and the last
    assert 'href="./videos/step_000001000.mp4"' in text
    assert re.findall(r"<h3>((?:First|Last|Best).*?)</h3>", text) == [
        "First (step 1,000)",
        "Last (step 3,000)",
        "Best model",
    ]


def test_policy_of_the_page_allows_its_own_scripts_and_no_network(tmp_path):
    first, second = text_of(write(tmp_path / "a")), text_of(write(tmp_path / "b"))
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', first)[1].replace("&#39;", "'")
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    nonce = re.search(r"'nonce-([\w-]{20,})'", policy)[1]
    assert f'<script nonce="{nonce}">' in first
    assert nonce not in second


def test_million_episodes_are_binned(tmp_path):
    n = 1_000_000
    returns = np.sin(np.arange(n) / n)
    episodes = Table({"step": np.arange(n) * 10.0, "return": returns, "seconds": np.arange(n) / 1e4})
    curve = charts.smooth(episodes, returns)
    assert len(curve.step) == charts.MAX_POINTS
    np.testing.assert_allclose(curve.mean[0], returns[:2500].mean())
    histogram = charts.histogram(returns, {"episode": np.arange(n)})
    assert sum(histogram["counts"]) == n
    assert max(map(len, histogram["rows"])) == charts.LISTED


def test_commands_of_a_page_make_the_environment_again(tmp_path):
    made = {"env_argument": "my_env.py", "env_kwargs": {"slope": 0.2}, "wrappers": ["my_env:Shaped"]}
    folder = write(tmp_path / "run", {**CONFIG, **made})
    (folder / "replays.csv").write_text("seed,return,length,success\n0,5.0,5,nan\n", encoding="utf-8")
    command = data_of(text_of(folder))["histograms"]["run0-replays"]["command"]
    assert command.endswith(
        "--which last --seed N --episodes 1 --env my_env.py --env-kwargs slope=0.2 --wrapper my_env:Shaped"
    )


def test_moving_average_and_its_interval():
    values = np.array([1.0, 3.0, 2.0, 6.0, np.nan, 4.0])
    episodes = Table({"step": np.arange(6.0), "seconds": 60.0 * np.arange(6)})
    curve = charts.smooth(episodes, values)  # a window of 3
    np.testing.assert_allclose(curve.mean, [1, 2, 2, 11 / 3, 4])
    deviation = np.std([2.0, 6.0, 4.0], ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(curve.high[-1] - curve.mean[-1], 1.959964 * deviation)
    np.testing.assert_allclose(curve.low[-1] + curve.high[-1], 2 * curve.mean[-1])
    np.testing.assert_array_equal(curve.step, [0, 1, 2, 3, 5])
    np.testing.assert_array_equal(curve.minutes, [0, 1, 2, 3, 5])


def test_charts_have_minutes_and_the_range_of_each_bin(tmp_path):
    run = runs.read_run(write(tmp_path / "run"))  # a step takes 0.01 s
    found = [charts.time_chart(run.metrics), *charts.metric_charts(run.metrics).values()]
    found += [charts.episode_chart(run.episodes, run.evaluations, column) for column in ("return", "success", "length")]
    drawn = [one for chart in found for one in chart["series"]]
    assert {one["kind"] for one in drawn} == {"area", "line", "points", "dots", "band"}
    for one in drawn:
        np.testing.assert_allclose(one["t"], np.array(one["x"]) / 100 / 60, rtol=1e-5)
    assert [one["name"] for one in found[0]["series"]] == ["environment", "replay buffer", "update", "rest"]
    assert [one["y"][0] for one in found[0]["series"]] == [0.2, 0.1, 0.6, 0.1]
    rates = next(one for one in found[4]["series"] if one["kind"] == "points")
    assert rates["y"] == [0.25, 0.5, 0.45]
    assert all(low < rate < high for low, rate, high in zip(rates["low"], rates["y"], rates["high"], strict=True))
    n = 2 * charts.MAX_POINTS  # each bin has two values
    step = np.arange(n) * 1.0
    table = Table({"step": step, "time/time_elapsed": 60 * step, "train/loss": np.where(step % 2, 5.0, step)})
    band, mean = charts.metric_charts(table)["train/loss"]["series"]
    assert (band["x"][:2], band["t"][:2]) == ([1, 3], [1, 3])
    assert (band["low"][4:6], mean["y"][4:6], band["high"][4:6]) == ([5, 5], [6.5, 7.5], [8, 10])


def test_interval_of_a_single_episode_is_unknown_and_large_returns_keep_their_deviation():
    values = 1e9 + np.array([0.0, 1.0, 0.0, 1.0])
    curve = charts.smooth(Table({"step": np.arange(4.0)}), values)
    assert np.isnan(curve.low[0])
    np.testing.assert_allclose(
        (curve.high - curve.mean)[2], 1.959964 * np.std([0, 1, 0], ddof=1) / np.sqrt(3), rtol=1e-5
    )


def test_episodes_behind_a_bar_have_their_exact_steps():
    histogram = charts.histogram(np.array([0.5]), {"episode": np.array([1.0]), "step": np.array([12_345_678.0])})
    (row,) = [row for rows in histogram["rows"] for row in rows]
    assert row == [1, 12_345_678]


def test_command_writes_where_asked(tmp_path, capsys):
    folder = write(tmp_path / "run")
    assert main(["report", str(folder), "--out", str(tmp_path / "page.html")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'page.html'}\n"
    assert (tmp_path / "page.html").is_file()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["report"], "rejeu report needs RUN"),
        (["report", "nowhere"], "there is no run folder nowhere"),
        (["report", ".", "--out", "x.pdf"], "--out x.pdf must end in .html or .htm"),
        (["report", "seeds"], "is no run folder: it holds no config.json; the newest of the 1 in it is"),
        (["report", "file"], "file is no folder"),
        (["status", "seeds"], "the newest of the 1 in it is"),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tmp_path)
    write(Path("seeds") / "seed_0", videos=False)
    Path("file").write_text("", encoding="utf-8")
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_page_of_an_agent_without_a_run_folder(tmp_path):
    agent = rejeu.PPO("MlpPolicy", "CartPole-v1", n_steps=64, gamma=0.9, seed=4)
    assert "0 episodes" in agent.report(tmp_path / "new.html").read_text(encoding="utf-8")
    for step in (20, 50):
        agent.history.append(Episode(step, 0, step / 2, 20, np.nan, step / 100))
    evaluation = Evaluation(np.array([30.0, 32.0]), np.array([30, 32]), np.array([np.nan, np.nan]))
    text = agent.report(tmp_path / "agent.html", [(50, evaluation)]).read_text(encoding="utf-8")
    assert "Best evaluation, step 50" in text
    assert "31.00" in text
    assert "default 0.99" in text
    assert sum(data_of(text)["histograms"]["run0-episodes"]["counts"]) == 2
    assert "rejeu train" not in text  # the run is not repeated by a command


def test_goals_of_replayed_episodes_are_a_map(tmp_path):
    folder = write(tmp_path / "run")
    rows = "0,5,5,1,1.0,2.0\n1,5,5,0,3.0,4.0\n2,5,5,1,-1.0,0.5\n3,5,5,nan,9,9\n4,5,5,1,nan,9\n"
    (folder / "replays.csv").write_text(f"seed,return,length,success,goal_0,goal_1\n{rows}", encoding="utf-8")
    chart = data_of(text_of(folder))["charts"]["run0-goals"]
    assert [
        (one["name"], one["color"], one["symbol"], {*zip(one["x"], one["y"], strict=True)}) for one in chart["series"]
    ] == [
        ("always reached (2)", "good", "circle", {(1, 2), (-1, 0.5)}),
        ("never (1)", "bad", "x", {(3, 4)}),
    ]
    assert chart["note"] == "67 % of 3 episodes reached the goal"


def test_one_failure_does_not_hide_the_successes_at_its_place():
    goals = np.array([[0.0, 0.0]] * 5 + [[10.0, 0.0]] * 2)
    success = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    columns = {"seed": np.arange(7.0), "success": success, "goal_0": goals[:, 0], "goal_1": goals[:, 1]}
    chart = charts.goal_chart(Table(columns))
    assert [(one["symbol"], one["x"], one["text"]) for one in chart["series"]] == [
        ("diamond", [0], ["80 % of 5 episodes"]),
        ("x", [10], ["0 % of 2 episodes"]),
    ]
    assert [chart["places"][one["places"][0]]["seeds"] for one in chart["series"]] == [[0, 1, 2, 3, 4], [5, 6]]


def test_neighboring_spots_of_a_lot_are_places_of_their_own_and_neighbors_in_a_cell_of_a_maze_are_not():
    spots = np.stack([np.repeat(np.arange(14) * 4.0 - 26, 2), np.tile([-14.0, 14.0], 14)], axis=1)
    assert len(charts.goal_places(spots, np.ones(28))) == 28
    cells = np.array([[0, 0], [0.05, 0.05], [0, 2], [2, 2], [2.5, 2.5]])
    assert sorted(place.rows.tolist() for place in charts.goal_places(cells, np.ones(5))) == [[0, 1], [2], [3], [4]]


def test_goals_of_the_newest_evaluations_are_a_map_too(tmp_path):
    folder = write(tmp_path / "run")
    (folder / "goals.csv").write_text(
        "step,success,goal_0,goal_1,goal_2\n8000,1,1,2,5\n9000,0,3,4,6\n", encoding="utf-8"
    )
    chart = data_of(text_of(folder))["charts"]["run0-evaluated_goals"]
    assert chart["note"] == "50 % of 2 episodes reached the goal, evaluated from step 8,000 to step 9,000"
    assert sorted(place["goal"] for place in chart["places"]) == [[1, 2, 5], [3, 4, 6]]


def test_a_map_is_drawn_on_a_picture_if_a_goal_is_in_it():
    columns = {"success": np.ones(2), "goal_0": np.array([0.0, 9.0]), "goal_1": np.array([0.0, 9.0])}
    chart = charts.goal_chart(Table(columns))
    at = {tuple(place["goal"]): i for i, place in enumerate(chart["places"])}
    pixels = np.zeros((2, 2))
    pixels[at[0.0, 0.0]], pixels[at[9.0, 9.0]] = (30, 40), (np.nan, np.nan)
    drawn = charts.on_picture(chart, pixels, "data:,", (60, 50))
    assert (drawn["picture"], drawn["x_range"], drawn["range"]) == ("data:,", [0, 60], [50, 0])
    (series,) = drawn["series"]
    assert {*zip(series["x"], series["y"], strict=True)} == {(30, 40), (None, None)}
    assert charts.on_picture(chart, pixels + 60, "data:,", (60, 50)) == chart


def test_value_of_an_episode_is_drawn_beside_what_followed():
    values, to_go = np.array([3.0, 2.0]), np.array([1.75, 1.0])
    both = charts.value_chart(values, to_go)["series"]
    assert [(one["name"], one["x"], one["y"]) for one in both] == [
        ("discounted return from here on", [0, 1], [1.75, 1]),
        ("what the critic expects", [0, 1], [3, 2]),
    ]
    (one,) = charts.value_chart(values, np.zeros(0))["series"]
    assert one["name"] == "what the critic expects"


@pytest.mark.parametrize(("given", "changed"), [({}, False), ({"net_arch": [8]}, True)])
def test_widths_that_follow_from_the_observations_are_no_change(given, changed):
    agent = rejeu.PPO("MlpPolicy", "CartPole-v1", policy_kwargs=given)
    assert any("net_arch" in name for name in record(agent, Path("agent"), []).changed) is changed


def test_the_interval_of_mean_lengths_stays_between_them():
    length = np.array([50.0, 50, 4, 50, 50, 50, 3, 50])
    episodes = Table({"step": np.arange(8.0), "length": length})
    band = next(
        one for one in charts.episode_chart(episodes, EMPTY, "length")["series"] if one["name"] == "95 % interval"
    )
    assert max(high for high in band["high"] if high is not None) == 50
    assert min(low for low in band["low"] if low is not None) >= 3
