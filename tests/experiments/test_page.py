"""The page about a study: what it says, and that nothing in a study folder becomes a script."""

import html
import json
import re

import pytest

from rejeu import presets
from rejeu.errors import MissingExtra
from rejeu.experiments import page, search, study as studies, study_plan as plans, tune as tuning
from rejeu.experiments.study import StudyFolder
from rejeu.reporting.report import page as pages
from rejeu.runs.config import RunConfig
from rejeu.tuning import Choice, LogUniform, NearOne

pytest.importorskip("optuna")
pytest.importorskip("plotly")
EVIL = "</script><script>window.hacked=1</script>"
SPACE = {
    "learning_rate": LogUniform(1e-5, 1e-2),
    "gamma": NearOne(0.9, 0.999),
    "policy_kwargs.net_arch": Choice(([8], [16])),
}


@pytest.fixture(autouse=True)
def small_script(monkeypatch):
    """Leaves Plotly's five megabytes out."""
    monkeypatch.setattr(pages, "plotly_script", lambda: "plotly")


@pytest.fixture
def study(tmp_path):
    """A study of ten trials without trainings: one failed, one was pruned."""
    plan = plans.make("Pendulum-v1", "SAC", search=SPACE, only=tuple(SPACE), trials=10, steps=100, final_seeds=0)
    opened = tuning.open_study(plan, tmp_path / "study")
    for i in range(10):
        trial, index, _ = opened.take()
        for step in (10, 20):
            opened.report(trial, step, -100.0 * i + step)
        state = {3: "failed", 4: "pruned"}.get(i, "complete")
        opened.finish(trial, index, state, 5 - 100.0 * i, EVIL if i == 3 else "")
    return opened


def data_of(text):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])


def test_the_page_shows_every_trial_and_every_hyperparameter(study):
    text = page.write(study, study.outcomes(), None).read_text(encoding="utf-8")
    charts = data_of(text)["charts"]
    assert charts.keys() == {"history", "curves", "slice0", "slice1", "slice2"}
    by_name = {one["name"]: one for one in charts["history"]["series"]}
    assert by_name["complete"]["x"] == [0, 1, 2, 5, 6, 7, 8, 9]
    assert by_name["pruned"]["x"] == [4]
    assert set(by_name["best so far"]["y"]) == {5}
    assert (charts["slice0"]["log"], charts["slice1"]["x"]) == (True, "1 - gamma")
    assert charts["slice2"]["labels"] == ["[8]", "[16]"]
    assert "10 trials" in text
    assert "The best trial, with a return of 5 in its last evaluation" in text
    assert text.count("<tr><td>") + text.count('<tr class="best"><td>') == 10
    assert "PED-ANOVA" in text


def test_texts_of_a_study_are_escaped_and_the_policy_allows_no_network(study):
    text = page.render(study, study.outcomes(), None)
    assert text.count("<script") == 3  # data, Plotly and the page's own
    assert "window.hacked=1" in text
    assert "default-src 'none'" in html.unescape(text)
    assert "connect-src 'none'" in html.unescape(text)


def test_the_page_says_what_the_comparison_found(study):
    compared = search.Final("no difference found", (1.0, -2.0, 4.0), None, ("default, seed 1: the loss is NaN",))
    text = page.render(study, study.outcomes(), compared)
    assert "On fresh seeds the winner is not shown to be better than the default" in text
    assert "default, seed 1: the loss is NaN" in text


def test_a_study_that_has_just_begun_has_a_page(tmp_path):
    plan = plans.make("Pendulum-v1", "SAC", steps=100)
    study = tuning.open_study(plan, tmp_path / "study")
    text = page.render(study, study.outcomes(), None)
    assert "No trial is complete" in text
    assert data_of(text)["charts"]["history"]["series"] == []


def test_a_missing_package_is_a_note(study, monkeypatch):
    def missing(*_):
        raise MissingExtra("a report", "plotly", "report")

    monkeypatch.setattr(page, "render", missing)
    with pytest.raises(MissingExtra, match="a report needs plotly"):
        page.write(study, study.outcomes(), None)
    opened = studies.join(StudyFolder(study.folder.path))
    result = tuning.run(opened, RunConfig(env="Pendulum-v1"), 1, tuning.Interrupt(), print, print)
    assert result.notes == (
        'no study.html: a report needs plotly, which is not installed; run: pip install "rejeu[report]"',
    )
    assert presets.read(study.folder.preset).env_id == "Pendulum-v1"
