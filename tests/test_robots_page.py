"""Statements without commands of the page on robots; ``netns_tests/test_robots_page.py`` runs its commands."""

from __future__ import annotations

from proxy.bridge.faults import Fault
from tests.pages import ROOT, rows

PAGE = ROOT / "docs/tutorials/robots.md"
WARNINGS = ROOT / "docs/reference/warnings.md"


def test_every_fault_is_explained() -> None:
    explained = WARNINGS.read_text().partition("## What a warning means")[2].partition("\n## ")[0]
    assert [name for name, _ in rows(explained)] == [fault.value for fault in Fault]


def test_it_can_be_read_in_ten_minutes() -> None:
    assert len(PAGE.read_text().splitlines()) <= 250
