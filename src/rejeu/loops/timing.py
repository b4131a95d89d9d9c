"""Wall time of the parts of a training loop."""

from __future__ import annotations

import time
from collections.abc import Mapping

PARTS = ("env", "replay", "update")
"""Stepping environments; storing and sampling; waiting for the device."""


def no_time() -> dict[str, float]:
    """Returns the seconds of all parts, and in total, before training."""
    return dict.fromkeys((*PARTS, "total"), 0.0)


class Timer:
    """Adds the wall time of the parts to ``seconds``: ``with timer("env"): ...``, or between calls of :meth:`lap`."""

    def __init__(self, seconds: dict[str, float]) -> None:
        """Continues to count in ``seconds``, which is mutated."""
        self.seconds = seconds
        self._last = time.perf_counter()
        self._began = self._last - seconds["total"]
        self._part: str | None = None

    def __call__(self, part: str) -> Timer:
        """Returns a context whose time counts as ``part``."""
        self._part = part
        return self

    def __enter__(self) -> None:
        self.lap()

    def __exit__(self, *error: object) -> None:
        self.lap(self._part)

    def lap(self, part: str | None = None) -> None:
        """Adds the time since the last call to ``part``, if one is given, and updates the total."""
        now = time.perf_counter()
        if part is not None:
            self.seconds[part] += now - self._last
        self._last = now
        self.seconds["total"] = now - self._began


def time_shares(seconds: Mapping[str, float]) -> dict[str, float]:
    """Returns the shares of ``seconds["total"]`` spent in ``env``, ``replay`` and ``update``, and the ``rest``.

    The rest is the loop's own bookkeeping and what runs between its turns: callbacks, evaluations, files. The shares sum
    to 1; before any time has passed all of it is rest.

    >>> time_shares({"env": 1.0, "replay": 1.0, "update": 5.0, "total": 8.0})
    {'env': 0.125, 'replay': 0.125, 'update': 0.625, 'rest': 0.125}
    """
    total = max(seconds["total"], 1e-9)
    shares = {part: seconds[part] / total for part in PARTS}
    return shares | {"rest": 1.0 - sum(shares.values())}
