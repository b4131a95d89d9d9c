"""A matplotlib figure that notebooks display without ``%matplotlib inline``. Imports matplotlib."""

from __future__ import annotations

import io

from matplotlib.figure import Figure


class Picture(Figure):
    """A figure that a notebook displays as a PNG.

    It does not use ``pyplot``, which depends on a global backend and keeps every figure until it is closed.
    """

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Returns the figure as PNG and its display width, for IPython."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue(), {"width": round(100 * self.get_figwidth())}
