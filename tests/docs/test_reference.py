"""Tables of the reference pages: they are what ``scripts/docs_reference.py`` writes, and leave nothing out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from pydantic import Field

import docs_reference
from fog.site import SiteConfig
from gdp.config.config import RibConfig, SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.config.schema import Section
from gdp.crypto.statements import StatementType
from gdp.enrolment.domain_files import DomainConfig
from proxy.config.config import ProxyConfig
from tests.pages import ROOT, rows

REFERENCE = ROOT / "docs/reference"
FILES: tuple[type[Section], ...] = (SwitchConfig, RelayConfig, RibConfig, ProxyConfig, DomainConfig, SiteConfig)


class _Inner(Section):
    """Section of a section, and of itself."""

    inner: tuple[_Inner, ...] = Field(default=(), description="More of them.")


class _Example(Section):
    """Keys of each kind."""

    needed: bool = Field(description="Must be there.")
    rate_hz: float = Field(default=2.5, gt=0, le=10, description="How often.")
    mode: str | None = Field(default=None, description="How | when.")
    deep: _Inner = _Inner()


def _sections(annotation: object) -> Iterator[type[Section]]:
    """Yield the sections within a type."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for each in get_args(annotation):
        yield from _sections(each)


def _keys(model: type[Section], seen: tuple[type[Section], ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield the last word of each key of a model and of the sections in it, with its description."""
    for name, field in model.model_fields.items():
        inner = [each for each in _sections(field.annotation) if each not in (*seen, model)]
        is_flat = isinstance(field.annotation, type) and issubclass(field.annotation, Section)
        if not is_flat:
            yield field.alias or name, field.description or ""
        for each in inner:
            yield from _keys(each, (*seen, model))


def test_the_tables_of_every_page_are_what_their_sources_say() -> None:
    assert docs_reference.main(["--check"]) == 0


def test_a_page_whose_table_differs_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs/a.md"
    page.write_text(f"# A\n\n<!-- keys {__name__}:_Inner -->\n<!-- end -->\n")
    monkeypatch.setattr(docs_reference, "ROOT", tmp_path)
    assert docs_reference.main(["--check"]) == 1
    assert "docs/a.md: " in capsys.readouterr().out
    assert docs_reference.main([]) == 0
    assert docs_reference.main(["--check"]) == 0
    assert "| `inner` | [map] | More of them. |" in page.read_text()


def test_a_row_has_the_default_the_bounds_and_the_description_of_its_key() -> None:
    written = docs_reference.written(f"<!-- keys {__name__}:_Example -->\n<!-- end -->")
    assert re.findall(r"^\| `.*", written, re.MULTILINE) == [
        "| `needed` | bool, required | Must be there. |",
        "| `rate_hz` | `2.5` (>0,≤10) | How often. |",
        "| `mode` | text? | How \\| when. |",
        "| `deep.inner` | [map] | More of them. |",
    ]


def test_every_key_of_a_file_has_a_description() -> None:
    keys = [(model.__name__, *each) for model in FILES for each in _keys(model)]
    assert len(keys) > 200
    assert [each for each in keys if not each[2]] == []


def test_every_key_of_a_file_stands_in_a_table() -> None:
    pages = ("configuration.md", "fog-yaml.md", "providers.md")
    stated = {re.split(r"\.", key)[-1] for page in pages for key, _ in rows((REFERENCE / page).read_text())}
    missing = {key for model in FILES for key, _ in _keys(model)} - {key.removesuffix("[]") for key in stated}
    assert missing == {"expose", "import"}  # lists of the rules, which have a table of their own


def test_every_key_of_a_body_stands_in_the_lists_of_its_statement() -> None:
    found: dict[str, set[str]] = {}
    for section in docs_reference.SECTION.finditer((REFERENCE / "statements.md").read_text()):
        for type_ in section[1].split(", "):
            heads = [line.partition(" (")[0].partition(": ")[0] for line in section[2].splitlines()]
            keys = {key for head in heads if head.startswith("- ") for key in re.findall("`([^`]+)`", head)}
            subject = {"digest", "owner"} if any("subject" in head for head in heads) else set()
            found.setdefault(type_, {"c"}).update(keys | subject)
    known = docs_reference.bodies()
    assert len(known) == len(StatementType) + 1  # the entry of a batch
    missing = {
        (type_, key.key)
        for type_, kinds in known.items()
        for kind in kinds
        for key in kind.declared()
        if key.key not in found[type_]
    }
    assert missing == set()


def test_the_form_of_a_key_is_as_declared() -> None:
    page = "**query**\n\n- `n`, `w` (text): who advertises it\n- `v`: free\n"
    assert docs_reference.statements(page) == page.replace("(text)", "(name; number 0–3,600)")


def test_every_type_of_statement_is_listed_and_no_other() -> None:
    part = (REFERENCE / "statements.md").read_text().partition("\nTypes with their frame kinds")[2]
    found = re.findall(r"^- ([a-z, -]+) \(.*\) by ", part.partition("\nA switch")[0], re.MULTILINE)
    listed = [name for names in found for name in names.split(", ")]
    assert sorted(listed) == sorted(each.value for each in StatementType)
