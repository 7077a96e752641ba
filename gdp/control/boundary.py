"""Error boundary around a peer's input: an error of our own ends the statement, never the node.

Sans-I/O. Such an error is a fault of this program. It is counted as ``INTERNAL`` and logged once for each location in
the code. A neighbour that provokes it repeatedly in one signer's name is quarantined for a while.
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from types import TracebackType
from typing import ClassVar, Final

from gdp.errors import DropReason, FrameError, RemoteError
from gdp.requests import Backoff

_FAULTS_BEFORE: Final = 3  # in one name, over one neighbour, until that is quarantined
_QUARANTINES: Final = Backoff(10.0, 300.0)
_FORGIVEN_S: Final = 600.0  # after the last fault
_OFFENDERS_MAX: Final = 256
_PLACES_MAX: Final = 64  # locations in the code that are logged


@dataclass(slots=True)
class _Offender:
    faults: int
    last_s: float
    until_s: float = float("-inf")


class ErrorBoundary:
    """Containment of errors of our own that a peer's bytes provoke.

    Attributes:
        reraises: lets errors through instead, so that tests see them.
        count: errors contained.
    """

    reraises: ClassVar[bool] = False

    def __init__(self) -> None:
        self.count = 0
        self._texts: list[str] = []
        self._places: set[str] = set()
        self._offenders: dict[bytes, _Offender] = {}

    def guard(self, origin: bytes, now_s: float) -> _Guard:
        """Return a context that turns an error of our own into ``FrameError`` (INTERNAL).

        Args:
            origin: neighbour and signer. Entering raises ``FrameError`` (QUARANTINED) while they are quarantined.
        """
        return _Guard(self, origin, now_s)

    def record(self, error: Exception) -> None:
        """Count an error; its text is logged the first time.

        Raises:
            Exception: the error itself, if ``reraises`` is set.
        """
        if self.reraises:
            raise error
        self.count += 1
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{type(error).__name__} {frame.filename}:{frame.lineno}"
        if place not in self._places and len(self._places) < _PLACES_MAX:
            self._places.add(place)
            self._texts.append("".join(traceback.format_exception(error)).rstrip())

    def poll_tracebacks(self) -> list[str]:
        """Return, once, the tracebacks that are to be logged."""
        texts, self._texts = self._texts, []
        return texts

    def is_quarantined(self, origin: bytes, now_s: float) -> bool:
        """Return whether statements of this origin are refused at present."""
        offender = self._offenders.get(origin)
        return offender is not None and now_s < offender.until_s

    def offend(self, origin: bytes, now_s: float) -> None:
        """Note that an origin provoked an error; from the third on it is quarantined, each time for twice as long."""
        offender = self._offenders.pop(origin, None)
        if offender is None or now_s - offender.last_s > _FORGIVEN_S:
            offender = _Offender(0, now_s)
        offender.faults, offender.last_s = offender.faults + 1, now_s
        if offender.faults >= _FAULTS_BEFORE:
            offender.until_s = now_s + _QUARANTINES.pause_s(offender.faults - _FAULTS_BEFORE + 1)
        self._offenders[origin] = offender
        if len(self._offenders) > _OFFENDERS_MAX:
            del self._offenders[next(iter(self._offenders))]


class _Guard:
    """One statement's passage through the boundary."""

    __slots__ = ("_boundary", "_now_s", "_origin")

    def __init__(self, boundary: ErrorBoundary, origin: bytes, now_s: float) -> None:
        self._boundary = boundary
        self._origin = origin
        self._now_s = now_s

    def __enter__(self) -> None:
        if self._boundary.is_quarantined(self._origin, self._now_s):
            raise FrameError(DropReason.QUARANTINED, "a sender whose statements drew errors")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not isinstance(error, Exception) or isinstance(error, RemoteError | BrokenPipeError):
            return  # a pipe that breaks is the reader of our own output, which has ended
        self._boundary.record(error)
        self._boundary.offend(self._origin, self._now_s)
        raise FrameError(DropReason.INTERNAL, type(error).__name__) from error
