"""The examples in docstrings run, and say what they say they print."""

import doctest
import importlib
import pkgutil

import pytest

import rejeu
from tests.tiers import only

MODULES = [
    "rejeu",
    *sorted(m.name for m in pkgutil.walk_packages(rejeu.__path__, "rejeu.") if "__main__" not in m.name),
]

SLOW = ("rejeu.agents.together", "rejeu.agents.policy", "rejeu.agents.on_policy", "rejeu.callbacks.checkpoint")
"""Of seconds, which the exhaustive tier has."""


@pytest.mark.parametrize("name", only({*MODULES} - {*SLOW}, MODULES))
def test_the_examples_of_a_module_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert result.failed == 0


def test_there_are_examples():
    finder = doctest.DocTestFinder()
    found = {m for m in MODULES for test in finder.find(importlib.import_module(m)) if test.examples}
    assert {"rejeu", "rejeu.core.schedules", "rejeu.envs.make", "rejeu.exploration.noise"} <= found
