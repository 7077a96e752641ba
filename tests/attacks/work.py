"""Work bounds for tests: lines of Python that a block may run, independent of other programs on the machine."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

__all__ = ["TooMuchWorkError", "lines_run"]


class TooMuchWorkError(BaseException):
    """Raised when more lines ran than a test allows; no handler of the tested code catches it."""


@contextlib.contextmanager
def lines_run(limit: int) -> Iterator[None]:
    """Fail where a block runs more than ``limit`` lines of Python, calls and returns counted."""
    left = limit

    def trace(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise TooMuchWorkError(f"more than {limit} lines")
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)
