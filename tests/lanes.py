"""Cases that only the nightly lane runs, because the change lane has others of the same promise."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import pytest
from _pytest.mark.structures import ParameterSet
from hypothesis import example

from tests.draws import IS_LONG

__all__ = ["long_example", "nightly"]

T = TypeVar("T")


def nightly(*cases: object) -> list[ParameterSet]:
    """Return cases of a parametrisation for the nightly lane alone; a tuple is one case of several values."""
    return [pytest.param(*(each if isinstance(each, tuple) else (each,)), marks=pytest.mark.nightly) for each in cases]


def long_example(case: object) -> Callable[[T], T]:
    """Return an example of a test that draws its cases, for runs alone that draw more than the usual ones."""
    return cast("Callable[[T], T]", example(case)) if IS_LONG else _as_is


def _as_is(test: T) -> T:
    return test
