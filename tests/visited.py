"""Files of the product whose functions a call runs: how many places one must know to follow it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Final, TypeVar

import gdp

__all__ = ["visited"]

_PRODUCT: Final = Path(gdp.__file__).parent
_T = TypeVar("_T")


def visited(package: str, seen: set[str], act: Callable[[], _T]) -> _T:
    """Return what a call returns; add to ``seen`` the files of a package of ``gdp`` whose functions it runs."""
    folder = f"{_PRODUCT / package}/"

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and (path := frame.f_code.co_filename).startswith(folder):
            seen.add(path.removeprefix(folder))

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        return act()
    finally:
        sys.setprofile(before)
