"""Pages of policies in headless Chromium: they act as ``predict``, a person plays against them, and nothing is asked for.

With ``SCREENSHOTS=FOLDER`` each page is photographed while both play.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from rejeu.agents import exporting
from rejeu.export import check
from tests.export.test_web import CASES, agent_for
from tests.tiers import only

ACTING = """(rows) => {
  const agent = makeAgent();
  return rows.map(([observations, start]) => Array.from(agent(observations, start)));
}"""


def until(page, expression):
    """Waits; not by ``wait_for_function``, which the page's policy of security forbids."""
    while not page.evaluate(expression):
        page.wait_for_timeout(20)


@pytest.mark.parametrize("width", only([390], [1200, 390]))
@pytest.mark.parametrize("env_id", only(["CartPole-v1"], CASES))
def test_a_page_acts_as_predict_and_is_played_by_keys(env_id, width, browser, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "OBSERVATIONS", 100)
    agent = agent_for(env_id)
    path, one = agent.export(tmp_path / "page.html").path, exporting.policy_for(agent, False, 1)
    recording, *_ = exporting.record(agent, one, None)
    page, messages, requests = browser.new_page(viewport={"width": width, "height": 800}), [], []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    names = [port.name for port in one.of("observation")]
    rows = [([recording.inputs[name][i].ravel().tolist() for name in names], i == 0) for i in range(100)]
    found = np.array(page.evaluate(ACTING, rows)).reshape(recording.actions.shape)
    if recording.actions.dtype.kind == "f":
        np.testing.assert_allclose(found, recording.actions, atol=1e-5)
    else:
        np.testing.assert_array_equal(found, recording.actions)
    until(page, "policyEpisode.steps > 0")
    assert page.text_content("#person-score") == "Press an arrow key to play."
    page.keyboard.down("ArrowRight")
    page.keyboard.down("ArrowUp")
    until(page, "personEpisode.steps >= 8 || personEpisode.isOver")
    assert page.text_content("#person-score").startswith("Return")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.click("#pause")
    steps = page.evaluate("[policyEpisode.steps, personEpisode.steps]")
    page.wait_for_timeout(300)
    assert page.evaluate("[policyEpisode.steps, personEpisode.steps]") == steps
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"{env_id.replace('/', '-')}-{width}.png", full_page=True)
    page.close()
    assert messages == []
    assert requests == [path.as_uri()]
