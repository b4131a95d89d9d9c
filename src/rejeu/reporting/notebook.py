"""Output in notebooks: what is updated while a cell runs, and what the commands of a cell print."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


def console(**settings: Any) -> Console:
    """Returns a console of Rich for standard output that is a terminal only if standard output is one.

    Notebooks set ``FORCE_COLOR`` for the commands of their cells. Rich would then animate bars and tables there, and every
    frame would be saved with the notebook.
    """
    from rich.console import Console

    is_terminal = getattr(sys.stdout, "isatty", bool)()
    return Console(force_terminal=None if is_terminal else False, **settings)


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
