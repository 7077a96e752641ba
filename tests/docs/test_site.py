"""Documentation site: it builds without a broken link, its drawings are shown, and each page is found."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import KINDS, ROOT, links

_NEEDED = ("mkdocs", "material", "mkdocstrings")
_MISSING = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
_PICTURES = ("trust-chain", "message-sealing", "name-resolution", "multicast-tree", "hedged-call")
_CITATION = re.compile(r"docs/explanation/design\.md, sections? (\d+)(?: and (\d+))?")


def _linked_from(page: Path) -> set[Path]:
    """Return the files below ``docs`` that a page links to."""
    return {(page.parent / link.partition("#")[0]).resolve() for link in links(page) if not link.startswith("http")}


@pytest.mark.skipif(bool(_MISSING), reason=f"not installed: {', '.join(_MISSING)} (the extra docs)")
@pytest.mark.nightly
def test_the_site_builds_in_strict_mode(tmp_path: Path) -> None:
    """A change is built by ``scripts/docs.sh``, which ``.ci/run`` runs after the tests."""
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, check=False, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site/index.html").is_file()


def test_every_drawing_is_shown_on_a_page() -> None:
    shown = {target.name for page in (ROOT / "docs").rglob("*.md") for target in _linked_from(page)}
    assert {f"{name}.svg" for name in _PICTURES} <= shown


def test_the_index_leads_to_every_page() -> None:
    pages = {page.resolve() for kind in KINDS for page in (ROOT / "docs" / kind).glob("*.md")}
    assert pages - _linked_from(ROOT / "docs/index.md") == set()


@pytest.mark.parametrize("folder", ["benchmarks", "experiments"])
def test_an_index_of_measurements_leads_to_every_page(folder: str) -> None:
    page = ROOT / "docs" / folder / "README.md"
    pages = {each.resolve() for each in page.parent.glob("*.md")} - {page.resolve()}
    assert pages - _linked_from(page) == set()


def test_sections_of_the_design_that_the_code_cites_exist() -> None:
    stated = set(re.findall(r"^## (\d+)\.", (ROOT / "docs/explanation/design.md").read_text(), re.MULTILINE))
    sources = [path for package in ("gdp", "proxy", "fog", "gdp_extensions") for path in (ROOT / package).rglob("*.py")]
    cited = {number for path in sources for pair in _CITATION.findall(path.read_text()) for number in pair if number}
    assert cited
    assert cited <= stated
