"""The page of a class: in headless Chromium, and its leaderboard without a page."""

import shutil
import time
from dataclasses import replace

import rejeu
from rejeu.lab.reporting.rows import nothing
from rejeu.lab.studio import judging as module
from rejeu.lab.studio.classroom import lines
from rejeu.lab.studio.judging import Judging
from rejeu.lab.studio.state import Studio
from tests.lab.studio.conftest import HOSTILE, check_widths, opened


def test_a_class_in_french_is_evaluated_followed_and_watched(browser, common):
    with opened(browser, common, "/class?language=fr") as page:
        page.wait_for_selector("text=Classement : CartPole-v1")
        for name in ("anna", f"group/{HOSTILE}"):
            page.locator("tr", has_text=name).wait_for()
        page.wait_for_selector("text=cut : le fichier est endommagé")
        assert page.locator("thead").inner_text().split("\t")[:2] == ["place", "modèle"]
        shutil.copyfile(common.folder / "anna.safetensors", common.folder / "zoé.safetensors")
        page.wait_for_selector("text=Le même fichier : anna, zoé")
        page.get_by_role("link", name=HOSTILE).click()
        page.wait_for_selector(".screen canvas")
        assert page.locator(".screen b").all_inner_texts() == [f"group/{HOSTILE}.safetensors"]


def test_a_projector_gets_large_letters(browser, common):
    with opened(browser, common, "/class") as page:
        page.locator("tr", has_text="anna").wait_for()
        page.get_by_role("link", name="projector").click()
        page.locator(".projector tr", has_text="anna").wait_for()
        size = "parseFloat(getComputedStyle(document.querySelector('td.name')).fontSize)"
        page.wait_for_function(f"{size} >= 30")
        assert not page.locator(".header").is_visible()
        check_widths(page)


def test_models_are_evaluated_again_when_they_change_while_somebody_looks(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "AGAIN", 0.0)
    monkeypatch.setattr(module, "EPISODES", 2)
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    judging = Judging(studio := Studio(tmp_path))

    def until(condition):
        judging.look()
        end = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < end
            time.sleep(0.05)

    until(lambda: "no .safetensors or .zip files" in judging.problem.replace("holds ", ""))
    path = agent.save(tmp_path / "run")
    until(lambda: judging.board("en").rows)
    before = judging.board("en").rows[0]
    rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=7).save(path)
    until(lambda: [row.seed for row in judging.board("en").rows] == [7])
    assert before.seed == 0
    running = replace(nothing(path, "unread"), state="running", steps=3, steps_asked=10)
    studio.rows = [replace(running, run="run"), replace(running, run="new")]
    first, second = lines(studio, judging, judging.board("fr"))
    assert (first["name"], first["training"]) == ("run", "s'entraîne : 30\N{NARROW NO-BREAK SPACE}%")
    assert first["link"] == "/play?agent=run.safetensors&watch=1"
    assert second == {"name": "new", "training": first["training"]}
    path.unlink()
    until(lambda: not judging.board("en").rows)
