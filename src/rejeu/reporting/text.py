"""Formatting of counts."""

from __future__ import annotations


def counted(n: int, noun: str) -> str:
    """Returns a count with its noun in singular or plural.

    >>> counted(1, "episode"), counted(1200, "episode")
    ('1 episode', '1,200 episodes')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"
