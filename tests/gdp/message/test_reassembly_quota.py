"""Reassembly quota of unfinished messages."""

from __future__ import annotations

import pytest

from gdp.errors import LocalError
from gdp.message.reassembly_quota import ReassemblyQuota


def test_one_source_gets_no_more_than_its_bound() -> None:
    budget = ReassemblyQuota(100, 60)
    assert budget.reserve(b"a", 60)
    assert not budget.reserve(b"a", 1)
    assert budget.reserve(b"b", 40)


def test_all_sources_together_get_no_more_than_the_total() -> None:
    budget = ReassemblyQuota(100, 60)
    assert budget.reserve(b"a", 60)
    assert not budget.reserve(b"b", 41)
    assert budget.held_bytes == 60


def test_a_refusal_takes_nothing_and_a_release_frees_quota() -> None:
    budget = ReassemblyQuota(100, 60)
    assert not budget.reserve(b"a", 61)
    assert budget.held_bytes == 0
    assert budget.reserve(b"a", 60)
    budget.release(b"a", 60)
    assert budget.held_bytes == 0
    assert budget.reserve(b"a", 60)


def test_more_than_was_taken_cannot_be_given_back() -> None:
    with pytest.raises(LocalError):
        ReassemblyQuota().release(b"a", 1)
