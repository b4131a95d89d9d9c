"""The documentation site builds without warnings and works without a network."""

import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rejeu
from rejeu import sb3
from tests.tiers import exhaustive

ROOT = Path(__file__).parents[1]
LOADED = re.compile(r"<(?:script|img|iframe|source)[^>]*\ssrc=\"([^\"]+)\"|<link[^>]*\shref=\"([^\"]+)\"")


@exhaustive  # half a minute
def test_the_site_builds_without_warnings_and_needs_no_network(tmp_path):
    """It is built as ``scripts/docs`` does. The search finds HER, although English stops at the word."""
    for package in ("furo", "myst_nb", "sphinx_copybutton"):
        pytest.importorskip(package)
    command = (ROOT / "scripts" / "docs").read_text(encoding="utf-8").splitlines()[-1].split()
    options = command[command.index("sphinx") + 1 : command.index("-d")]
    command = [
        sys.executable,
        "-m",
        "sphinx",
        *options,
        "-d",
        str(tmp_path / "doctrees"),
        "docs",
        str(tmp_path / "html"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "html"
    assert (site / "index.html").exists()
    assert re.search(r'"?\bher"?:', (site / "searchindex.js").read_text(encoding="utf-8"))
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        for script, link in LOADED.findall(text):
            target = script or link
            assert not target.startswith(("http", "//")), f"{page.name} loads {target}"
            if not target.startswith("data:"):
                assert (page.parent / target.split("?")[0].split("#")[0]).exists(), f"{page.name} has no {target}"
        if page.parent == site:
            assert re.search(r"Copyright.*2026, the rejeu authors", text), page.name


def documented_names():
    """Returns the names in the API reference."""
    pages = [page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.rst")]
    found = re.findall(r"^\.\. auto\w+:: (rejeu\.[\w.]+)(?:\n   :members: (.+))?", "\n".join(pages), re.MULTILINE)
    members = {f"{name}.{member}" for name, listed in found if listed for member in listed.split(", ")}
    return {name for name, _ in found} | members


def test_the_reference_names_what_exists():
    for name in documented_names():
        pkgutil.resolve_name(name)


def test_the_reference_has_every_public_name():
    documented = documented_names()
    own = [f"sb3.{name}" for name in sb3.__all__ if name not in rejeu.__all__]
    names = {f"rejeu.{name}" for name in [*rejeu.__all__, *own]} - {"rejeu.AGENTS", "rejeu.plots"}
    assert names - documented == set()
