"""Charts and histograms of :mod:`rejeu.logs.charts` on a page, drawn by the same script as those of a report."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import resources

from nicegui import app, ui
from nicegui.element import Element

from rejeu.lab.reporting.report.page import TEMPLATES
from rejeu.lab.studio.speech import say
from rejeu.logs.charts import Chart

TEXTS = ("environment steps", "minutes of training", "return", "episodes", "to")
"""Texts that the script writes itself."""
SCRIPTS = ("/plotly.min.js", "/charts.js")


class Figure(Element, component="chart.js"):
    """A chart or a histogram. Mutable: ``show`` replaces it.

    Args:
        name: title, which a picture of it has too.
        chart: as the functions of :mod:`rejeu.logs.charts` return it; None draws nothing yet.
        height: in CSS.
        choose: called with the number of the bar of a histogram, or of the place of a map, that was clicked.
    """

    def __init__(
        self,
        name: str,
        chart: Chart | None = None,
        height: str = "240px",
        choose: Callable[[int], object] | None = None,
    ) -> None:
        super().__init__()
        self.props.update(chart=in_language(chart), name=name, axis="x", height=height)
        self.classes("w-full")
        if choose is not None:
            self.on("choose", lambda event: choose(int(event.args)))

    def show(self, chart: Chart | None = None, **props: object) -> None:
        """Draws another chart, or the same over another ``axis`` ("x" are steps, "t" minutes), or with a ``chosen`` bar."""
        changed = props if chart is None else {"chart": in_language(chart), **props}
        if any(self.props.get(name) != value for name, value in changed.items()):
            self.props.update(changed)
            self.update()


def in_language(chart: Chart | None) -> Chart | None:
    """Returns a chart with its texts in the language of the page, as far as that has them."""
    if chart is None:
        return chart
    axes: dict[str, str] = {name: say(chart[name]) for name in ("x", "y") if name in chart}
    names = {text: say(text) for text in TEXTS}
    series = [
        {**entry, "name": say(entry["name"])} | ({"text": [*map(say, entry["text"])]} if "text" in entry else {})
        for entry in chart.get("series", ())
    ]
    return {**chart, **axes, "names": names, **({"series": series} if series else {})}


def serve_scripts() -> None:
    """Serves the scripts that draw; they are those of the report, and Plotly's package."""
    plotly = resources.files("plotly").joinpath("package_data", "plotly.min.js")
    for url, file in zip(SCRIPTS, (plotly, TEMPLATES / "charts.js"), strict=True):
        app.add_static_file(local_file=str(file), url_path=url)


def add_scripts() -> None:
    """Adds the scripts to the page that is built. They are large: others are shown sooner without them."""
    ui.add_head_html("".join(f'<script src="{url}"></script>' for url in SCRIPTS))


def add_colors() -> None:
    """Adds the colors of charts to the page that is built."""
    css = (TEMPLATES / "charts.css").read_text(encoding="utf-8")
    ui.add_css(re.sub(r"@media [^{]+\{\s*:root (\{.*?\})\s*\}", r".body--dark \1", css, flags=re.DOTALL))
