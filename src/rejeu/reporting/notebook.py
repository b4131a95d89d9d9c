"""Output that changes while a cell of a notebook runs, and stays in the notebook and in files exported from it."""

from __future__ import annotations

from typing import Any


class Display:
    """One place in a cell's output, whose text can be replaced. Mutable; for a notebook only.

    Unlike a widget it is part of the saved notebook as it stood last, and needs no package but IPython.
    """

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, text: str) -> None:
        """Puts text, which is shown in a font of fixed width, in place of what was shown before."""
        from IPython.display import display

        data = {"text/plain": text}
        if self._handle is None:
            self._handle = display(data, raw=True, display_id=True)
        else:
            self._handle.update(data, raw=True)
