"""Requests of a client to the servers of one name: one copy for all by the tree, or a copy for each, the fastest first.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/congestion-control.md, "Requests".

The first answer counts, so the fastest path governs. The tree carries a request that fits what the path to each server
may carry while it leaves. Else each server gets a copy by its own unicast stream. The next copy begins when those
before have left, or when the newest stalls or takes twice its time. Requests that are published meanwhile take the same
streams, so each server keeps their order. When a call ends, what has not left of its copies never leaves, and is not
repaired.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Final

from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPaths
from gdp.errors import LocalError
from gdp.intervals import NEVER_S
from gdp.names import Name

_PATIENCE: Final = 2.0  # of the time that a copy should take


@dataclass(slots=True, eq=False)
class _Request:
    message: bytes
    copies: list[tuple[Publisher, int]] = field(default_factory=list)  # with the sequence number
    waiting: deque[Name] = field(default_factory=deque)  # servers whose copies have not begun
    server: Name | None = None  # of the newest copy
    check_s: float = 0.0  # when its path is looked at
    next_s: float = 0.0  # when the next copy begins at the latest


class RequestStreams:
    """Requests under way to the servers of one name.

    Args:
        public: the stream to all servers.
        stream: returns the unicast stream to a server; raises ``LocalError`` if it is not connected.
        holding: of the participant, those with copies that have not begun.
    """

    def __init__(
        self,
        public: Publisher,
        stream: Callable[[Name, float], Publisher],
        paths: ReaderPaths,
        holding: dict[RequestStreams, None],
    ) -> None:
        self._public = public
        self._stream = stream
        self._paths = paths
        self._holding = holding
        self._requests: dict[Hashable, _Request] = {}
        self._apart: dict[Hashable, _Request] = {}  # of them those that no tree carries
        self._held: dict[Hashable, _Request] = {}  # ... and those with copies that have not begun

    def send_to_all(self, call: Hashable, message: bytes, now_s: float) -> None:
        """Send a request to all servers. Raises ``LocalError``: above the limits."""
        servers, fits = self._paths.fastest_first(self._public.matched.reporting(now_s), len(message), now_s)
        if len(servers) < 2 or (fits and not self._apart):
            self._public.publish(message)
            self._requests.setdefault(call, _Request(message)).copies.append(self._newest(self._public))
            return
        request = self._requests[call] = self._apart[call] = self._held[call] = _Request(message)
        self._holding[self] = None
        request.waiting.extend(map(Name, servers))
        self.release(now_s)

    def send_to(self, call: Hashable, server: Name, message: bytes, now_s: float) -> None:
        """Send a request to one server alone.

        Raises:
            LocalError: it is not connected, there are too many, or the message is above the limits.
        """
        stream = self._stream(server, now_s)
        stream.publish(message)
        self._requests.setdefault(call, _Request(message)).copies.append(self._newest(stream))

    def cancel(self, call: Hashable) -> None:
        """Cancel what is still under way of a call that has ended."""
        self._apart.pop(call, None)
        self._end_hold(call)
        request = self._requests.pop(call, None)
        for publisher, sequence in () if request is None else request.copies:
            publisher.cancel(sequence)

    def release(self, now_s: float) -> None:
        """Begin the copies that have waited for a faster one to leave."""
        for call, request in list(self._held.items()):
            while request.waiting and self._may_follow(request, now_s):
                self._begin_next(request, now_s)
            if not request.waiting:
                self._end_hold(call)

    def close(self) -> None:
        """Begin no further copy."""
        self._holding.pop(self, None)

    def _end_hold(self, call: Hashable) -> None:
        self._held.pop(call, None)
        if not self._held:
            self._holding.pop(self, None)

    def get_timer(self) -> float:
        """Return the monotonic second at which the next copy begins at the latest; infinity: none waits."""
        return min((request.check_s for request in self._held.values()), default=NEVER_S)

    def _begin_next(self, request: _Request, now_s: float) -> None:
        server = request.waiting.popleft()
        try:
            stream = self._stream(server, now_s)
        except LocalError:
            return  # it has gone: its calls learn that from the servers that are there
        stream.publish(request.message)
        request.copies.append(self._newest(stream))
        path = self._paths.path(server, now_s)
        request.server, request.check_s = server, now_s + path.stall_s
        request.next_s = now_s + _PATIENCE * path.arrival_s(len(request.message))

    def _may_follow(self, request: _Request, now_s: float) -> bool:
        """Return whether the next copy may begin: those before have left, or the newest is late."""
        if request.server is None or all(
            publisher.queue.sent_sequence > sequence for publisher, sequence in request.copies
        ):
            return True
        if now_s < request.check_s:
            return False
        path = self._paths.path(request.server, now_s)
        request.check_s = min(now_s + path.stall_s, request.next_s)
        return now_s >= request.next_s or path.has_stalled(now_s)

    @staticmethod
    def _newest(publisher: Publisher) -> tuple[Publisher, int]:
        return publisher, publisher.past.sequence
