"""Upload of a capsule: one bounded batch of records at a time, from where the holder's head is.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). The holder confirms what is on its disk, or later, when it is
in its bucket; until then it is asked. A head that goes back, or is ahead of all records, is a lie or a loss, and is
reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import BATCH_BYTES, Ask, HolderAnswer, HolderRequest
from gdp.capsule.windows import Windows
from gdp.errors import RemoteError
from gdp.intervals import MINUTE_S, NEVER_S, POLL_S, RETRY_S
from gdp.names import Name
from gdp.requests import Backoff

_FAILED: Final = Backoff(RETRY_S, MINUTE_S)
_LEAST_BYTES: Final = 16 << 10  # of a request, where live traffic leaves little of the path within its time limit
_FAULTS_MAX: Final = 15  # of those that nothing has read


@dataclass(frozen=True, slots=True)
class Span:
    """Bytes of records that are to be read from the disk here."""

    offset: int
    size: int


class Uploader:
    """Upload of one capsule to one holder.

    Attributes:
        confirmed: behind the last byte that the holder has confirmed.
        is_refused: the latest request failed.
        missing_bytes: that were dropped here before the holder had them.
    """

    def __init__(self, name: Name, descriptor: Descriptor) -> None:
        self._name = name
        self._descriptor = descriptor
        self._head: int | None = None  # None: it is to be asked for
        self._held = 0  # as the holder answered; ``_head`` leaves out what it shall not get
        self._is_under_way = False
        self._retry_s = -NEVER_S
        self._failures = 0  # in a row
        self._is_chosen = True
        self._most_bytes = BATCH_BYTES  # of one request
        self.confirmed = 0
        self.is_refused = False
        self.missing_bytes = 0
        self._faults: list[str] = []

    def next_step(
        self,
        begin: int,
        end: int,
        now_s: float,
        windows: Windows | None = None,
        *,
        is_chosen: bool = True,
    ) -> HolderRequest | Span | None:
        """Return a request to send, or what to read for the next one, or None.

        Args:
            begin: offset of the first byte here.
            end: behind the last byte on the disk here.
            windows: what stands in none of them is left out; None: everything is uploaded.
            is_chosen: records go to this holder; another one fetches them from it, and is asked what it has.
        """
        if self._is_under_way or now_s < self._retry_s:
            return None
        self._is_chosen = is_chosen
        if not is_chosen:
            if self.confirmed == end or (windows is not None and windows.next(self.confirmed, end) is None):
                return None
            self._head = None
        if self._head is None:
            self._is_under_way = True
            return HolderRequest(ask=Ask.HEAD, capsule=self._name)
        span = (self._head, end) if windows is None else windows.next(self._head, end)
        if span is None or self._head >= end:
            if self.confirmed < self._held:
                self._head, self._retry_s = None, now_s + POLL_S
            return None
        self._head, end = span
        if self._head < begin:
            self._note(f"the holder never had bytes {self._head} to {begin}: the ring here was full")
            self.missing_bytes += begin - self._head
            self._head = begin
        if self._head >= end:
            return None
        self._is_under_way = True
        return Span(self._head, min(end - self._head, self._most_bytes))

    def append(self, offset: int, data: bytes) -> HolderRequest:
        """Return the request with records that were read."""
        descriptor, gap = None if self.confirmed else self._descriptor, max(offset - self._held, 0)
        return HolderRequest(
            ask=Ask.APPEND, capsule=self._name, offset=offset, data=data, gap=gap, descriptor=descriptor
        )

    def handle_response(self, wire: bytes, end: int, now_s: float) -> None:
        """Process an answer."""
        try:
            answer = HolderAnswer.from_cbor(wire)
        except RemoteError as error:
            self.handle_failure(f"an answer that cannot be read: {error}", now_s)
            return
        self._is_under_way, self.is_refused, self._failures, head = False, False, 0, answer.head
        if head < self.confirmed:
            self._note(f"the holder has rolled back: {self.confirmed} bytes were confirmed, now it has {head}")
        elif head > end:
            self._note(f"the holder has {head} bytes, which is more than the {end} that were written here")
            self._retry_s = now_s + RETRY_S
            self._head = None
            return
        self.confirmed, self._held = head, max(head, answer.offset)
        self._head = self._held
        self._most_bytes = min(2 * self._most_bytes, BATCH_BYTES)
        if not self._is_chosen:
            self._retry_s = now_s + POLL_S

    def handle_failure(self, reason: str, now_s: float, *, is_silent: bool = False) -> None:
        """Note that a request failed: the holder is asked for its head again after a while.

        Args:
            is_silent: no answer came. A path comes back at any time, so the pauses do not grow.
        """
        self._note(reason)
        self.is_refused = True
        self._most_bytes = max(self._most_bytes // 2, _LEAST_BYTES)
        self._failures = 0 if is_silent else self._failures + 1
        self._is_under_way, self._head, self._retry_s = False, None, now_s + _FAILED.pause_s(self._failures)

    def poll_faults(self) -> list[str]:
        """Return, once, what the holder did wrong, refused or never had, as texts; the latest last."""
        faults, self._faults = self._faults, []
        return faults

    def _note(self, reason: str) -> None:
        self._faults = [*self._faults[-_FAULTS_MAX:], reason]
