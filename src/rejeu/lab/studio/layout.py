"""Elements of all pages: the frame with the navigation, and elements that are refreshed.

Texts of runs go into ``ui.label``, ``ui.table``, ``ui.select`` and the like, which show them as text. Nothing of a run goes
into ``ui.html``, ``ui.markdown``, ``ui.code``, the slots of a table as HTML, or a script.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from urllib.parse import urlencode

from nicegui import ui

from rejeu.lab.studio import figures
from rejeu.lab.studio.state import Studio

EVERY = 1.0
"""Seconds between two looks whether what a page shows has changed."""
STYLE = """
body { font-family: system-ui, sans-serif; }
.nicegui-content { padding: 0; }
.page { width: 100%; max-width: 1400px; margin: 0 auto; padding: 16px; gap: 12px; }
.header { background: var(--bar, #1d4f91); min-height: 48px; padding: 4px 12px; }
.q-table td, .q-table th { padding: 4px 8px; }
.q-table td { max-width: 22rem; overflow: hidden; text-overflow: ellipsis; }
.quiet { color: var(--muted); }
.picture { width: 84px; height: 48px; object-fit: cover; border-radius: 4px; display: block; }
.notes { max-width: 16rem; white-space: normal; }
a.run { color: var(--line); overflow-wrap: anywhere; }
.card { background: var(--card); border-color: var(--rule); padding: 10px 12px; gap: 4px; min-width: 0; box-shadow: none; }
.tile { flex: 1 1 200px; gap: 0; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 12px; }
.mono { font-family: ui-monospace, monospace; font-size: 12px; }
.warning { background: var(--mark); color: var(--mark-ink); border-radius: 8px; padding: 4px 10px; width: 100%; }
.text { white-space: pre-wrap; overflow-wrap: anywhere; }
.body--dark { --bar: #16263d; }
@media (max-width: 600px) { .page { padding: 8px; } }
"""
MODES = {None: "brightness_auto", False: "light_mode", True: "dark_mode"}
"""Symbols of the colors of a page: those of the system, light and dark."""


@contextmanager
def frame(title: str, path: str, links: Sequence[tuple[str, str]]) -> Iterator[None]:
    """Context whose elements are the content of a page.

    Args:
        title: of the page.
        path: of the page.
        links: path and title of each page in the navigation.
    """
    figures.add_scripts()
    ui.add_css(STYLE)
    ui.colors(primary="#2f6db5")
    dark = ui.dark_mode(None)
    with ui.header().classes("header items-center gap-1 no-wrap"):
        ui.label("rejeu").classes("text-subtitle1 text-weight-bold q-mr-sm gt-xs")
        with ui.row().classes("gap-0 no-wrap").style("overflow-x: auto"):
            for target, name in links:
                line = "text-decoration: underline; text-underline-offset: 6px" if target == path else ""
                ui.link(name, target).classes("text-white q-px-sm no-underline").style(line)
        ui.space()
        ui.button(icon=MODES[None], on_click=lambda event: next_mode(event.sender, dark)).props(
            "flat round dense color=white aria-label='light or dark'"
        )
    with ui.column().classes("page"):
        yield


def next_mode(button: ui.button, dark: ui.dark_mode) -> None:
    """Changes the colors of a page: those of the system, light, dark."""
    modes = [*MODES]
    dark.value = modes[(modes.index(dark.value) + 1) % len(modes)]
    button.props(f"icon={MODES[dark.value]}")


def action(text: str, icon: str | None, on_click: Callable[..., object]) -> ui.button:
    """Makes a small button."""
    return ui.button(text, icon=icon, on_click=on_click).props("outline dense no-caps padding='2px 10px'")


def follow(studio: Studio, show: Callable[[], object], every: float = EVERY) -> None:
    """Calls a function now, and again whenever the rows of the studio have changed, as long as the page is open."""
    version = -1

    def look() -> None:
        nonlocal version
        if version != studio.version:
            version = studio.version
            show()

    look()
    ui.timer(every, look)


def address(path: str, **query: str | Sequence[str]) -> str:
    """Returns the address of a page with query parameters, which may hold anything.

    >>> address("/run", run="a b/<c>")
    '/run?run=a+b%2F%3Cc%3E'
    """
    return f"{path}?{urlencode(query, doseq=True, errors='surrogateescape')}" if query else path
