"""The examples of Stable-Baselines3's documentation run, or fail for the stated reason."""

import importlib.util

import pytest

from tests.sb3.examples import EXAMPLES

QUICK = ("train_save_load_and_evaluate",)
"""Those that run without ``--slow``."""


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "one",
    [
        pytest.param(one, id=one.run.__name__, marks=[] if one.run.__name__ in QUICK else pytest.mark.slow)
        for one in EXAMPLES
    ],
)
def test_example(one, tmp_path, monkeypatch):
    if one.needs and importlib.util.find_spec(one.needs) is None:
        pytest.skip(f"needs {one.needs}")
    monkeypatch.chdir(tmp_path)
    if one.fails:
        with pytest.raises((AttributeError, ImportError)):
            one.run()
    else:
        one.run()
