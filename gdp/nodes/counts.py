"""Counts by reason in the form that metrics take.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Mapping

from gdp.errors import DropReason

__all__ = ["count_list"]


def count_list(counts: Mapping[DropReason, int]) -> list[int]:
    """Return counts by reason as a list in the order of the reasons."""
    return [counts.get(reason, 0) for reason in DropReason]
