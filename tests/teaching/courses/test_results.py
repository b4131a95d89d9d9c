"""What course 1 says about its results, on several seeds."""

import json
import sys

import pytest

from rejeu.teaching import courses
from trials.provenance import ROOT, in_process

FULL = "best weights, no noise"


def train(seed, folder):
    script = str(ROOT / "benchmarks" / "course.py")
    found = in_process(sys.executable, script, "--seeds", str(seed), "--out", str(folder / "course.json"))
    assert "error" not in found, found
    return found


def test_the_shares_in_the_text_are_those_of_five_seeds():
    found = json.loads((ROOT / "benchmarks" / "results" / "course.json").read_text(encoding="utf-8"))["runs"]
    assert [run["seed"] for run in found] == [0, 1, 2, 3, 4]
    text = " ".join(courses.sources()[0].read_text(encoding="utf-8").split())
    for game, row, english, french in (
        ("car", "greedy, new episodes", "the last weights succeeded in", "les derniers poids ont réussi dans"),
        ("car", "the same, best weights", "the best ones in", "les meilleurs dans"),
        ("lander", FULL, "the best weights landed in", "les meilleurs poids se sont posés dans"),
    ):
        shares = [round(100 * run[game][row]["success"]) for run in found]
        assert f"{english} {min(shares)}% to {max(shares)}%" in text
        assert f"{french} {min(shares)} % à {max(shares)} %" in text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.timeout(1800)
def test_the_best_weights_of_course_1_are_good_and_its_lander_lands(seed, tmp_path):
    found = train(seed, tmp_path)
    car, lander = found["car"], found["lander"]
    best = car["the same, best weights"]
    assert best["success"] >= 0.8
    assert best["return"] >= car["greedy, new episodes"]["return"] - 5
    assert best["return"] > car["random"]["return"] + 30
    assert lander[FULL]["success"] >= 0.7
    assert lander[FULL]["return"] > lander["training, last 100"]["return"]


@pytest.mark.exhaustive
def test_every_row_of_the_tables_of_course_1_is_found(monkeypatch, tmp_path):
    monkeypatch.setenv("REJEU_COURSE_SPEED", "10000")
    found = train(3, tmp_path)
    assert {*found["car"]} >= {"random", "greedy, new episodes", "the same, best weights"}
    assert {*found["lander"]} >= {"random", FULL}
