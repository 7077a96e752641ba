"""Object that closes itself at the end of a ``with`` block."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import TypeVar

_C = TypeVar("_C")


class ClosedOnExit(ABC):
    """Context manager that closes itself."""

    @abstractmethod
    def close(self) -> None:
        """Close the object."""

    def __enter__(self: _C) -> _C:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
