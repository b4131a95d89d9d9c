"""Playing by hand in a notebook, with and without a display."""

from types import SimpleNamespace

import pytest

from rejeu.core.errors import MissingExtra
from rejeu.teaching import courses
from rejeu.teaching.courses import checks


@pytest.mark.parametrize("error", [OSError("no display"), MissingExtra("playing", "pygame-ce", "play")])
def test_a_notebook_goes_on_without_a_window_and_says_so_in_its_language(error, monkeypatch, capsys):
    def play(*_, **__):
        raise error

    monkeypatch.setattr("rejeu.teaching.play.play", play)
    assert courses.by_hand("Mountain", episodes=3) == []
    assert capsys.readouterr().out == f"{error}\n"
    error = OSError("cannot open a window")
    monkeypatch.setenv("REJEU_LANGUAGE", "en")  # restored at the end
    checks.speak("fr")
    assert courses.by_hand("Mountain", episodes=3) == []
    assert "Impossible d'ouvrir une fenêtre" in capsys.readouterr().out


def test_the_scores_are_yours_and_those_of_the_agent_are_printed(monkeypatch, capsys):
    players = [SimpleNamespace(name="you", scores=[-150.0]), SimpleNamespace(name="DQN", scores=[-110.0])]
    monkeypatch.setattr("rejeu.teaching.play.play", lambda *_, **__: SimpleNamespace(players=players))
    assert courses.by_hand("Mountain", episodes=1, against=object()) == [-150.0]
    assert capsys.readouterr().out == "DQN [-110.0]\n"


def test_numbers_of_steps_are_divided_for_a_quick_look(monkeypatch):
    monkeypatch.setenv("REJEU_COURSE_SPEED", "100")
    assert (courses.steps(450), courses.steps(20)) == (4, 1)
