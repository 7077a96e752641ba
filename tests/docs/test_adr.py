"""Architectural decision records: their form, their index, and the references to them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.pages import ROOT

_FOLDER = ROOT / "docs/adr"
_RECORDS = sorted(_FOLDER.glob("[0-9]*.md"))
_FORM = re.compile(
    r"# (?P<number>\d+)\. (?P<title>[^\n]+)\n\n(?P<body>\*\*Context\.\*\* .+?"
    r"\n\n\*\*Decision\.\*\* .+?\n\n\*\*Consequence\.\*\* .+)",
    re.DOTALL,
)
_WORDS_MAX = 100
_REFERENCE = re.compile(r"\b(?:ADR|[Dd]ecision) (\d+)\b")
_SOURCES = ("gdp", "proxy", "fog", "gdp_extensions", "scripts", "tests", "netns_tests", "docs")


def _form(record: Path) -> re.Match[str]:
    match = _FORM.fullmatch(record.read_text())
    assert match, f"{record.name}: not a title, Context, Decision and Consequence"
    return match


@pytest.mark.parametrize("record", _RECORDS, ids=lambda record: record.stem)
def test_a_record_fits_one_screen(record: Path) -> None:
    assert len(_form(record)["body"].split()) <= _WORDS_MAX


@pytest.mark.parametrize("record", _RECORDS, ids=lambda record: record.stem)
def test_a_record_is_named_by_its_number_and_title(record: Path) -> None:
    match = _form(record)
    title = match["title"].lower().replace("'s", "s")
    words = re.sub(r"[^a-z0-9]+", "-", title).strip("-")
    assert record.stem == f"{int(match['number']):03}-{words}"


def test_the_index_lists_each_record_once_with_number_and_title() -> None:
    listed = re.findall(r"\[(\d+) ([^]]+)\]\((\d+-[^)]+\.md)\)", (_FOLDER / "README.md").read_text())
    stated = [(match["number"], match["title"], record.name) for record in _RECORDS for match in [_form(record)]]
    assert sorted(listed) == sorted(stated)


def test_a_reference_by_number_names_a_record() -> None:
    numbers = {int(record.name.partition("-")[0]) for record in _RECORDS}
    files = (path for folder in _SOURCES for ext in ("py", "md") for path in (ROOT / folder).rglob(f"*.{ext}"))
    cited = {(path, int(number)) for path in files for number in _REFERENCE.findall(path.read_text())}
    assert {(path, number) for path, number in cited if number not in numbers} == set()
