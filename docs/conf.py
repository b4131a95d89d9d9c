"""Configuration of Sphinx; ``scripts/docs`` builds the site. The pages are plain Markdown, which GitHub shows too."""

from __future__ import annotations

import inspect
import os
import pkgutil
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.search.en import SearchEnglish
from sphinx.util import logging

os.environ.setdefault("JAX_PLATFORMS", "cpu")
DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent / "src"), str(DOCS.parent / "scripts")]

import source_links  # noqa: E402

import rejeu  # noqa: E402

project, author, release = "rejeu", "the rejeu authors", rejeu.__version__
copyright = f"2026, {author}"  # noqa: A001
html_title = f"rejeu {release}"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.linkcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_*"]

nb_execution_mode = "off"  # tests/test_docs.py runs the code of the pages
myst_heading_anchors = 4
highlight_language = "none"
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"

autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
napoleon_numpy_docstring = False
toc_object_entries_show_parents = "hide"
suppress_warnings = ["ref.python"]  # two classes are called Episode: of training, and of demonstrations
nitpick_ignore_regex = [("py:.*", r"(?!rejeu\b).*"), ("py:class", r".*\.[A-Z]")]  # other libraries, type variables

html_theme = "furo"
html_static_path = ["_static"]
html_extra_path = ["../llms.txt"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {"source_repository": source_links.base(), "source_branch": "main", "source_directory": "docs/"}
linkcheck_ignore = [re.escape(source_links.base()) + "/(blob|tree)/.*"]  # resolved from the files here

logger = logging.getLogger(__name__)


class English(SearchEnglish):
    """The search of the site, which finds HER too: "her" is a stop word of English."""

    stopwords = SearchEnglish.stopwords - {"her"}


def contents(index: str) -> str:
    """Returns the hidden tables of contents of the home page, one for each of its sections with lists of links."""
    sections: dict[str, list[str]] = {}
    for part in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        items = [line for line in part.splitlines() if line.startswith("- ")]
        if pages := re.findall(r"\]\(([\w/-]+)\.md\)", "\n".join(items)):
            sections[part.splitlines()[0]] = pages
    sections["API reference"] = ["api/index"]
    linked = {page for pages in sections.values() for page in pages} | {"index"}
    paths = [path.relative_to(DOCS).with_suffix("").as_posix() for path in sorted(DOCS.rglob("*.md"))]
    if missing := [page for page in paths if page not in linked and not page.startswith("_")]:
        logger.warning("no list of the home page has a link to: %s", ", ".join(missing))
    tables = [
        f"```{{toctree}}\n:hidden:\n:caption: {name}\n\n" + "\n".join(pages) + "\n```\n"
        for name, pages in sections.items()
    ]
    return "\n".join(["", *tables])


def read_page(app: Sphinx, name: str, source: list[str]) -> None:
    """Prepares a page before it is parsed: links to the repository, the contents of the home page, the changes."""
    path = Path(app.env.doc2path(name))
    if path.suffix != ".md":
        return
    text, folder = source[0], path.parent
    if name == "changelog":
        text, folder = (DOCS.parent / "CHANGELOG.md").read_text(encoding="utf-8"), DOCS.parent
    source[0] = source_links.resolved(text, folder, path.parent, lambda error: logger.warning(error, location=name))
    if name == "index":
        source[0] += contents(text)


def source_of(found: Any) -> str | None:
    """Returns the address of the lines that define an object, None if it has none."""
    try:
        found = inspect.unwrap(found.fget if isinstance(found, property) else found)
        code, first = inspect.getsourcelines(found)
        address = source_links.url(Path(inspect.getsourcefile(found) or ""))
    except (TypeError, OSError, ValueError):
        return None
    return address if inspect.ismodule(found) else f"{address}#L{first}-L{first + len(code) - 1}"


def linkcode_resolve(domain: str, info: dict[str, str]) -> str | None:
    """Returns the address of the source of a documented object."""
    try:
        return source_of(pkgutil.resolve_name(f"{info['module']}.{info['fullname']}"))
    except (ImportError, AttributeError):
        return None


def link_to_source(app: Sphinx, env: Any, node: addnodes.pending_xref, child: nodes.Element) -> nodes.Element | None:
    """Returns a link to the source for the name of an object that is not in the reference; None if there is none."""
    try:
        found = pkgutil.resolve_name(node.get("reftarget", "")) if node["refdomain"] == "py" else None
    except (ImportError, AttributeError, ValueError):
        return None
    address = (
        source_of(found) if getattr(found, "__module__", getattr(found, "__name__", "")).startswith("rejeu") else None
    )
    return address and nodes.reference("", "", child, refuri=address, internal=False)


def keep_attribute(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Keeps the docstring of an attribute, of which Napoleon reads what precedes a colon as the type."""
    if what in ("attribute", "data", "property"):
        app.env.temp_data["docstring"] = list(lines)


def restore_attribute(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Restores it."""
    if what in ("attribute", "data", "property"):
        lines[:] = app.env.temp_data.pop("docstring")


def setup(app: Sphinx) -> None:
    """Connects what is defined above."""
    app.add_search_language(English)
    app.connect("autodoc-process-docstring", keep_attribute, priority=400)
    app.connect("autodoc-process-docstring", restore_attribute, priority=600)  # Napoleon has 500
    app.connect("source-read", read_page)
    app.connect("missing-reference", link_to_source)
