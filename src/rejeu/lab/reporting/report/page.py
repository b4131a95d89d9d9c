"""HTML pages in one file: templates, styles, scripts and data. Shared by reports and comparisons."""

from __future__ import annotations

import base64
import secrets
import zlib
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rejeu.core.errors import MissingExtra, requires

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).parent / "templates"


class ChartEntry(NamedTuple):
    """A chart on a page."""

    id: str
    """Key of its data."""
    title: str
    note: str = ""


def render(template: str, data: object, **context: object) -> str:
    """Returns a page that extends ``base.html``.

    Args:
        template: name of the template.
        data: JSON data for the script: ``{"charts": {id: chart}, "histograms": {id: histogram}, ...}``.
        context: variables of the template.

    Raises:
        MissingExtra: if plotly or jinja2 is not installed.
        ValueError: if the data contains NaN or an infinity.
    """
    page = environment().get_template(template)  # first, so that a missing jinja2 is named
    from markupsafe import Markup

    nonce = secrets.token_urlsafe(18)
    policy = (
        f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'unsafe-inline'; img-src data: blob:; media-src data:; "
        "connect-src 'none'; base-uri 'none'; form-action 'none'"
    )
    files = ("charts.css", "page.css", "charts.js", "page.js")
    charts_style, style, charts, script = (Markup((TEMPLATES / name).read_text(encoding="utf-8")) for name in files)
    return page.render(
        nonce=nonce,
        policy=policy,
        data=data,
        style=charts_style + style,
        charts=charts,
        script=script,
        plotly=Markup(plotly_script()),
        **context,
    )


@cache
def environment() -> Environment:
    """Returns the templates, which escape everything."""
    with requires("a report", "jinja2", "report"):
        import jinja2
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@cache
def plotly_script() -> str:
    """Returns Plotly's script, compressed and in base64: two megabytes instead of five. The page unpacks it.

    Raises:
        MissingExtra: if plotly is not installed.
    """
    try:
        script = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    except (ImportError, OSError):
        raise MissingExtra("a report", "plotly", "report") from None
    return base64.b64encode(zlib.compress(script, 6)).decode("ascii")
