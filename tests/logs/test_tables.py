"""Tables of numbers in CSV files."""

import csv
import math

import numpy as np
import pytest

from rejeu.logs.tables import read_table

ODD = "0 -0 1 -1.5 12.25 123456789012345 1234567890123456789 0.1 -0.001 99999999.99999999 1e5 nan inf - 1. +3 .5 1.2.3 12a "
ODD += "--1 1-2 88888888 123456789 0.123456789012345 -0.00000000000000001 1e-300 1e400 0x10 \xe9"


def expected(word):
    try:
        return float(word)
    except ValueError:
        return math.nan


def test_numbers_equal_those_of_python(tmp_path):
    rng = np.random.default_rng(0)
    words = [*ODD.split(), "", *map(repr, rng.normal(size=300).tolist()), *map(str, rng.integers(-(10**9), 10**9, 300))]
    words += [repr(round(float(value), i % 9)) for i, value in enumerate(rng.normal(0, 1e4, 300))]
    (tmp_path / "a.csv").write_bytes("".join(f"{i},{word}\r\n" for i, word in enumerate(["value", *words])).encode())
    found = read_table(tmp_path / "a.csv").columns["value"]
    correct = np.array([expected(word) for word in words])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(correct))
    np.testing.assert_array_equal(found, correct)


def test_only_some_columns(tmp_path):
    (tmp_path / "a.csv").write_text("a,b,c\n1,2,3\n4,5,6\n", encoding="utf-8")
    table = read_table(tmp_path / "a.csv", only=("a", "c"))
    assert {name: values.tolist() for name, values in table.columns.items()} == {"a": [1, 4], "c": [3, 6]}
    assert np.isnan(table.column("b")).all()


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (b"", "a.csv is empty"),
        (b"a,a\n1,2\n", "a.csv has 2 columns, expected up to 512 of different names"),
        (b"a,b\n1,2\n3\n4,5\n", "left out of a.csv: 1 damaged row"),
        (b"a,b\n1,2\n3,", "the last row of a.csv is incomplete and was left out"),
        (b"a,b\r1,2\r3,4\n", "the header of a.csv is damaged"),
        (b"a" * 200_000 + b"\n1\n", "the header of a.csv is damaged"),
        (b'a,b\n1,"' + b"x" * 200_000 + b'"\n4,5\n', "left out of a.csv: 1 damaged row"),
    ],
)
def test_damage_is_noted(tmp_path, content, note):
    (tmp_path / "a.csv").write_bytes(content)
    assert read_table(tmp_path / "a.csv").notes == (note,)


def test_cells_may_hold_commas_quotes_and_lines(tmp_path):
    cells = ["two, words", 'say "yes", no', "two\nlines", "{'a': 1, 'b': 2}", "True"]
    with (tmp_path / "a.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["a", "text", "b"], *([i, cell, -i] for i, cell in enumerate(cells))])
    table = read_table(tmp_path / "a.csv")
    assert table.notes == ()
    assert (table.column("a").tolist(), table.column("b").tolist()) == ([0, 1, 2, 3, 4], [0, -1, -2, -3, -4])
    np.testing.assert_array_equal(table.column("text"), [np.nan, np.nan, np.nan, np.nan, 1.0])


@pytest.mark.parametrize("row", [b"1,2\n", b"1,\n"])
def test_a_table_is_read_up_to_a_number_of_cells(tmp_path, monkeypatch, row):
    monkeypatch.setattr("rejeu.logs.tables.MAX_CELLS", 8)
    (tmp_path / "a.csv").write_bytes(b"a,b\n" + 4 * row)
    assert read_table(tmp_path / "a.csv").notes == ()
    (tmp_path / "a.csv").write_bytes(b"a,b\n" + 5 * row)
    table = read_table(tmp_path / "a.csv")
    assert (len(table), table.notes) == (4, ("only the first 4 lines of a.csv were read",))


def test_a_line_without_an_end_is_read_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr("rejeu.logs.tables.MAX_LINE", 8)
    (tmp_path / "a.csv").write_bytes(b'a,b\n1,2\n3,"' + 3 * b"abcdefgh" + b'"\n5,6\n')
    assert read_table(tmp_path / "a.csv").column("a").tolist() == [1, 3, 5]


def test_file_of_a_spreadsheet_has_a_mark_before_the_header(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfstep,b\r\n1,2\r\n")
    assert [*read_table(tmp_path / "a.csv").columns] == ["step", "b"]
