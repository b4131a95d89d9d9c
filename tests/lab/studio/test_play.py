"""The page on which environments are played and agents watched: in headless Chromium, and its games without a page."""

import queue
import re
from functools import partial
from urllib.parse import quote

import pytest

from rejeu.demonstrations import read
from rejeu.lab.cli import main, studio as command
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.studio.games import HostedGame, asked_game
from rejeu.lab.studio.state import Studio
from rejeu.teaching.play import opened as game_opened
from tests.helpers import error_of
from tests.lab.studio.conftest import HOSTILE, check_widths, opened
from tests.playing import LEVER, Pull

pytest.importorskip("pygame")
PICTURE = "() => [...document.querySelectorAll('.screen canvas')].map((canvas) => canvas.toDataURL())"


def pictures(page):
    return page.evaluate(PICTURE)


def test_a_game_is_played_by_keys_recorded_and_read_again(browser, common):
    with opened(browser, common, "/play?env=FrozenLake-v1&seed=1") as page:
        page.wait_for_selector("text=press a key to begin")
        page.get_by_text("Environment and players").click()
        page.get_by_role("switch", name="record").click()
        page.evaluate("document.querySelector('.screen').id = 'before'")
        page.get_by_role("button", name="Start").click()
        page.wait_for_selector("#before", state="detached")  # that game has made way for another
        page.wait_for_selector("text=press a key to begin")
        before = pictures(page)
        for i, key in enumerate(("ArrowRight", "d", "ArrowDown")):
            page.keyboard.press(key)
            page.wait_for_selector(f".screen[data-presses='{i + 1}']")
        assert "step 3" in page.locator(".screen").inner_text()
        assert pictures(page) != before
        page.get_by_role("button", name="q", exact=True).click()
        page.wait_for_selector("text=1 episode for MINARI_DATASETS_PATH")
        page.get_by_role("button", name="again").wait_for()
    (recorded,) = (common.folder / "played").iterdir()
    (episode,) = read(recorded).episodes
    assert episode.actions.tolist() == [2, 2, 1]  # right, right, down


def test_an_environment_that_was_typed_is_played_without_enter(browser, common):
    with opened(browser, common, "/play") as page:
        page.get_by_role("combobox", name="environment").click()
        page.keyboard.type("frozenlake-")
        page.get_by_role("button", name="Start").click()
        page.wait_for_selector("text=press a key to begin")
        assert page.url.endswith("/play?env=FrozenLake-v1")


def test_two_agents_are_shown_side_by_side_from_the_same_start(browser, common):
    query = f"agent=anna.safetensors&agent={quote(f'group/{HOSTILE}')}.safetensors&watch=1&seed=3"
    with opened(browser, common, f"/play?{query}") as page:
        page.wait_for_selector(".screen canvas >> nth=1")
        before = pictures(page)
        assert len(before) == 2
        page.wait_for_function(f"(before) => ({PICTURE})().every((one, i) => one !== before[i])", arg=before)
        names = page.locator(".screen b").all_inner_texts()
        assert names == ["anna.safetensors", f"group/{HOSTILE}.safetensors"]
        check_widths(page)
        page.keyboard.press("p")
        page.wait_for_selector("text=pause >> nth=0")
        page.get_by_text("Environment and players").click()
        page.get_by_role("switch", name="I play").click()
        page.get_by_role("button", name="Start").click()
        page.wait_for_url("**/play?env=CartPole-v1&agent=anna.safetensors&agent=*&seed=3")  # a reload keeps the game


VISIBLE = """() => [...document.querySelectorAll(".keys .key, .screen p")].every((element) => {
    const { top, bottom, right } = element.getBoundingClientRect();
    return top > 0 && bottom <= innerHeight && right <= innerWidth; })"""
AZERTY = "navigator.keyboard.getLayoutMap = async () => new Map([['KeyA', 'q'], ['KeyQ', 'a'], ['KeyD', 'd']])"


def test_a_game_fits_a_telephone_and_its_keys_are_those_of_the_keyboard(browser, common):
    """The keys are where they are on a US keyboard: left is where A is there, which is Q on a French one."""
    with opened(browser, common, "/play", 360, 640, has_touch=True) as page:
        page.add_init_script(AZERTY)
        page.goto(common.at("/play?env=FrozenLake-v1&seed=1"))
        page.wait_for_selector("text=press a key to begin")
        page.get_by_role("button", name="a", exact=True).wait_for()  # quits
        for width, height in ((360, 640), (640, 360), (1280, 800)):
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_function("document.documentElement.scrollHeight <= innerHeight")
            page.wait_for_function(VISIBLE)
            assert page.locator(".screen canvas").bounding_box()["height"] > 60
        page.get_by_role("button", name="d", exact=True).tap()
        page.wait_for_selector(".screen[data-presses='1']")
        page.keyboard.press("q")  # the key of a US keyboard there, which says A here
        page.get_by_role("button", name="again").tap()
        page.wait_for_selector("text=press a key to begin")


def test_an_error_is_one_line_on_the_page(browser, common):
    with opened(browser, common, f"/play?env={quote(HOSTILE)}&agent={quote(HOSTILE)}&seed={HOSTILE}") as page:
        page.wait_for_selector(f"text=there is no run folder or model file {common.folder / HOSTILE}")


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (("evil:Env-v0", (), True, None, False), "names the environment 'evil:Env-v0', and no file may name"),
        (("evil.py", (), True, None, False), "names the environment 'evil.py', and no file may name"),
        (("", ("../anna.safetensors",), True, None, False), "is not in the folder of the studio"),
        (("", ("/etc/passwd",), True, None, False), "is not in the folder of the studio"),
        (("Pendulum-v1", ("anna.safetensors",), True, None, False), "plays CartPole-v1, not Pendulum-v1"),
        (("Pendulum-v1", (), False, None, False), "nobody plays"),
        (("", (), True, None, False), "choose an environment"),
    ],
)
def test_an_address_names_no_code_and_no_file_elsewhere(common, wanted, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        asked_game(Studio(common.folder), *wanted)


def test_an_environment_that_the_command_line_names_is_played(tmp_path):
    studio = Studio(tmp_path)
    studio.trust(RunConfig(env=f"tests.playing:{LEVER}"))
    with asked_game(studio, f"tests.playing:{LEVER}", (), True, 3, False) as made:
        assert (made.env_id, made.game.seed) == (LEVER, 3)


class Shown:
    """What a game shows, and a game that is entered in its thread."""

    def __init__(self, **settings):
        self.seen = queue.SimpleQueue()
        start = partial(
            game_opened, LEVER, settings.pop("agents", {}), settings.pop("by_hand", True), seed=4, **settings
        )
        self.playing = HostedGame(start, lambda *what: self.seen.put(what))

    def next(self):
        return self.seen.get(timeout=20)

    def until(self, message):
        while True:
            images, captions, presses = self.next()
            if captions[0]["message"].startswith(message):
                return images, captions, presses

    def press(self, *keys):
        self.playing.handle_all("press", keys)


def test_a_game_in_a_thread_takes_keys_and_compares_scores():
    shown = Shown(agents={"pull": Pull()}, fps=200.0)
    images, captions, presses = shown.next()
    assert [image.shape for image in images] == [(300, 400, 3)] * 2
    assert [one["name"] for one in captions] == ["you", "pull"]
    assert (captions[0]["message"], presses) == ("press a key to begin", 0)
    shown.press("d")
    _, captions, presses = shown.until("success")
    assert [one["score"] for one in captions] == ["score 10 · step 5"] * 2
    assert (captions[1]["won"], presses) == (True, 1)
    shown.press("q")
    while not shown.playing.ended:
        shown.next() if not shown.seen.empty() else None
    assert shown.playing.said == ""


def test_a_slow_game_acts_at_once_when_a_key_is_pressed():
    shown = Shown(fps=0.01)  # a step in 100 seconds
    shown.next()
    for i in range(4):
        shown.press("d")
        _, captions, _ = shown.next()
        assert captions[0]["score"].endswith(f"step {i + 1}")
    shown.press("q")


def test_an_error_of_a_game_is_what_it_says():
    playing = HostedGame(partial(game_opened, "rejeu-play-test/Dark-v0", {}), lambda *what: None)
    while not playing.ended:
        pass
    assert "cannot be rendered to arrays" in playing.said


def test_watch_of_two_opens_the_studio_with_both(common, monkeypatch, capsys):
    folder = common.folder
    calls = []
    monkeypatch.setattr(command, "open_studio", lambda *_, **settings: calls.append(settings))
    names = [str(folder / "anna"), str(folder / "group" / f"{HOSTILE}.safetensors")]
    assert main(["watch", *names, "--seed", "5"]) == 0
    (call,) = calls
    assert call["page"] == ("/play", [("agent", names[0]), ("agent", names[1]), ("watch", "1"), ("seed", "5")])
    assert [(model.name, made.env_id) for model, made in call["guests"].values()] == [
        ("anna.safetensors", "CartPole-v1"),
        (f"{HOSTILE}.safetensors", "CartPole-v1"),
    ]
    with asked_game(Studio(folder, call["guests"]), "", names, False, 5, False) as made:
        assert [player.name for player in made.game.players] == names
    assert "one or two different agents" in error_of(capsys, "watch", *names, names[0])
    assert "one or two different agents" in error_of(capsys, "watch", names[0], names[0])
    assert "--fps and --episodes are for one agent" in error_of(capsys, "watch", *names, "--fps", "5")
