"""A matplotlib figure that a notebook shows without ``%matplotlib inline``; imports matplotlib."""

from __future__ import annotations

import io

from matplotlib.figure import Figure


class Picture(Figure):
    """A figure outside of pyplot that is its own image in a notebook.

    ``pyplot`` would draw into whatever backend is set, and keep every figure alive until it is closed.
    """

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Returns the figure as a PNG file with its width in a page, 100 pixels an inch, as IPython asks for it."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue(), {"width": round(100 * self.get_figwidth())}
