"""Notebook output that is updated while a cell runs and is saved with the notebook."""

from __future__ import annotations

from typing import Any


class Display:
    """An output of a cell whose text can be replaced. Mutable; for notebooks only.

    Unlike a widget it is saved with the notebook, and needs no package but IPython.
    """

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, text: str) -> None:
        """Replaces the text, which is shown in a monospaced font."""
        from IPython.display import display

        data = {"text/plain": text}
        if self._handle is None:
            self._handle = display(data, raw=True, display_id=True)
        else:
            self._handle.update(data, raw=True)
