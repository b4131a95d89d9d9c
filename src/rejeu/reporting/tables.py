"""Tables of numbers in CSV files, read with NumPy. The files are untrusted: sizes are bounded, damaged rows are left out."""

from __future__ import annotations

import csv
import os
import stat
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejeu.io.records import shown
from rejeu.reporting.text import counted

MAX_BYTES = 2**28
"""Upper limit on what is read of one table, in bytes; four million episodes fit."""
MAX_COLUMNS = 512
MAX_CELL = 64
"""Upper limit on the length of a number, in characters."""
COMMA, NEWLINE, RETURN, POINT, MINUS = b",\n\r.-"
DIGITS = 18
POWERS = 10 ** np.arange(DIGITS + 1, dtype=np.int64)
ZEROS = np.uint64(0x3030303030303030)
"""Eight times the character 0."""
SIX = np.uint64(0x0606060606060606)
HIGH_NIBBLES = np.uint64(0xF0F0F0F0F0F0F0F0)


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of numbers of the same length, and what was wrong with the file."""

    columns: dict[str, np.ndarray]
    """``float64 (n_rows,)`` by name; NaN where a cell is empty or not a number."""
    notes: tuple[str, ...] = ()
    """One line for each thing that was missing or damaged."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def column(self, name: str) -> np.ndarray:
        """Returns a column, NaN everywhere if the file lacks it."""
        return self.columns[name] if name in self.columns else np.full(len(self), np.nan)


EMPTY = Table({})


def read_bytes(path: Path, limit: int) -> bytes:
    """Returns up to ``limit`` bytes of a regular file; never follows a symbolic link and never waits.

    Raises:
        OSError: if it cannot be read, or is something else than a regular file.
    """
    if not stat.S_ISREG(path.lstat().st_mode):
        raise OSError(f"{path.name} is not a regular file")
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with os.fdopen(os.open(path, flags), "rb") as file:
        return file.read(limit)


def read_table(path: Path, only: Collection[str] | None = None, skip_lines: int = 0) -> Table:
    """Returns the columns of a CSV file with a header line; an empty table, with a note, if there is none.

    Args:
        path: path of the file.
        only: names of the columns to read; None for all.
        skip_lines: lines before the header.
    """
    name = path.name
    try:
        data = read_bytes(path, MAX_BYTES + 1)
    except FileNotFoundError:
        return Table({}, (f"there is no {name}",))
    except OSError as error:
        return Table({}, (f"{name} cannot be read: {shown(error.strerror or error)}",))
    notes = []
    if len(data) > MAX_BYTES:
        data = data[: data.rfind(b"\n", 0, MAX_BYTES) + 1]
        notes.append(f"only the first {MAX_BYTES >> 20} MiB of {name} were read")
    for _ in range(skip_lines):
        data = data[data.find(b"\n") + 1 :]
    header, _, body = data.partition(b"\n")
    if not header.strip():
        return Table({}, (*notes, f"{name} is empty"))
    try:
        names = next(csv.reader([header.decode("utf-8-sig", "replace").strip("\r")]), [])
    except csv.Error:  # a carriage return, or a name of 100,000 characters
        return Table({}, (*notes, f"the header of {name} is damaged"))
    if len(names) > MAX_COLUMNS or len({*names}) < len(names):
        return Table({}, (*notes, f"{name} has {len(names)} columns, expected up to {MAX_COLUMNS} of different names"))
    if body and not body.endswith(b"\n"):
        body = body[: body.rfind(b"\n") + 1]
        notes.append(f"the last row of {name} is incomplete and was left out")
    text, ends, n_bad = whole_rows(body, len(names))
    if n_bad:
        notes.append(f"left out of {name}: {counted(n_bad, 'damaged row')}")
    wanted = [i for i, one in enumerate(names) if only is None or one in only]
    return Table(dict(zip([names[i] for i in wanted], cells(text, ends, wanted), strict=True)), tuple(notes))


def whole_rows(body: bytes, n_columns: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns the rows with ``n_columns`` cells of at most ``MAX_CELL`` characters.

    Returns:
        The text as ``uint8``, with eight bytes before and ``MAX_CELL`` after it; the ends of the cells, ``(n_rows,
        n_columns)``; and the number of other rows.
    """
    text = np.concatenate([np.zeros(8, np.uint8), np.frombuffer(body, np.uint8), np.zeros(MAX_CELL + 1, np.uint8)])
    ends = np.flatnonzero((text == COMMA) | (text == NEWLINE))
    if len(ends) % n_columns == 0:
        rows = (text[ends] == NEWLINE).reshape(-1, n_columns)
        is_long = (ends[1:] - ends[:-1]).max(initial=ends[0] - 8 if len(ends) else 0) > MAX_CELL + 1
        if rows[:, -1].all() and np.count_nonzero(rows) == len(rows) and not is_long:
            return text, ends.reshape(-1, n_columns), 0
    lines = body.split(b"\n")[:-1]
    good = [one for one in lines if one.count(b",") == n_columns - 1 and max(map(len, one.split(b","))) <= MAX_CELL]
    text, ends, _ = whole_rows(b"".join(one + b"\n" for one in good), n_columns)
    return text, ends, len(lines) - len(good)


def cells(text: np.ndarray, ends: np.ndarray, wanted: list[int]) -> list[np.ndarray]:
    """Returns the numbers in some columns of the rows that :func:`whole_rows` returned."""
    points = np.append(np.flatnonzero(text == POINT), len(text))
    found = []
    for i in wanted:
        first = np.full(len(ends[:1]), 7)
        starts = 1 + (ends[:, i - 1] if i else np.concatenate([first, ends[:-1, -1]]))
        is_last = i == ends.shape[1] - 1
        stops = ends[:, i] - (text[ends[:, i] - 1] == RETURN) if is_last else np.ascontiguousarray(ends[:, i])
        found.append(numbers(text, starts, stops, points))
    return found


def numbers(text: np.ndarray, starts: np.ndarray, ends: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns the numbers between positions of a text, whose points are at ``points``; NaN for what is not a number."""
    values, is_plain = plain_numbers(text, starts, ends, points)
    rest = np.flatnonzero(~is_plain)
    if not len(rest):
        return values
    starts, ends = starts[rest], ends[rest]
    width = max(int((ends - starts).max()), 3)
    letters = np.lib.stride_tricks.sliding_window_view(text, width)[starts]
    letters[np.arange(width) >= (ends - starts)[:, None]] = 0
    words = np.ascontiguousarray(letters).view(f"S{width}").ravel()
    words[starts == ends] = b"nan"
    try:
        values[rest] = words.astype(np.float64)
    except ValueError:
        values[rest] = [number(word) for word in words.tolist()]
    return values


def plain_numbers(
    text: np.ndarray, starts: np.ndarray, ends: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns numbers such as ``-12.5``, with up to 18 digits, and which of them were so written.

    All digits together are an integer of 64 bits, which is divided by a power of ten. With up to 15 digits that rounds as a
    parser does; with more the last bit may differ. Eight digits are read at a time, as one 64-bit integer.
    """
    is_negative = text[starts] == MINUS
    first = starts + is_negative
    point = np.minimum(points[np.searchsorted(points, first)], ends)
    n_whole, n_parts = point - first, np.maximum(ends - point - 1, 0)
    is_plain = (n_whole >= 1) & (n_whole + n_parts <= DIGITS) & ((point == ends) | (n_parts >= 1))
    words = np.ndarray(len(text) - 7, "<u8", text.data, strides=(1,))
    total = np.zeros(len(starts), np.int64)
    for end, count in ((point, n_whole), (ends, n_parts)):
        value = np.zeros(len(starts), np.int64)
        for place in range(0, int(min(count.max(initial=0), DIGITS)), 8):
            size = np.clip(count - place, 0, 8)
            group, is_digits = eight_digits(words[np.maximum(end - place - 8, 0)], size)
            is_plain &= is_digits & (end - place >= 8)
            value += group.astype(np.int64) * 10**place
        total = total * POWERS[np.clip(count, 0, DIGITS)] + value
    values = (total.astype(np.longdouble) / POWERS[np.clip(n_parts, 0, DIGITS)]).astype(np.float64)
    return np.where(is_negative, -values, values), is_plain


def eight_digits(words: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the numbers that the last ``size`` of eight characters write, and whether they are digits.

    Args:
        words: eight characters each, as little-endian integers; the last character is in the highest byte.
        size: how many of them count, 0 to 8.
    """
    shift = (64 - 8 * size).astype(np.uint64)
    digits = np.where(size > 0, (words ^ ZEROS) >> (shift & np.uint64(63)) << (shift & np.uint64(63)), np.uint64(0))
    is_digits = ((digits | (digits + SIX)) & HIGH_NIBBLES) == 0
    pairs = (digits * np.uint64(10) + (digits >> np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    fours = (pairs * np.uint64(100) + (pairs >> np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    return (fours * np.uint64(10_000) + (fours >> np.uint64(32))) & np.uint64(0xFFFFFFFF), is_digits


def number(word: bytes) -> float:
    """Returns a number, NaN for what is none."""
    try:
        return float(word)
    except ValueError:
        return float("nan")
