"""JSON of files: parsed strictly, converted to typed records, with errors that name the field."""

from __future__ import annotations

import pytest

from rejeu.core.records import Malformed, parse_json


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("NaN", "not valid JSON"),
        ("[1e999]", "out of range"),
        ("9" * 5000, "out of range"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * 101 + "]" * 101, "nested too deeply"),
        ("[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ("{", "not valid JSON"),
        (b"\xff", "not valid JSON"),
        (b'"\xff"', "not valid JSON"),
    ],
)
def test_json_that_is_not_strict_is_refused(text, words):
    with pytest.raises(Malformed, match=words):
        parse_json(text)
