"""Window of a local server: how many requests it may have that it has not answered.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A ROS 2 server has a queue of ten requests by default, and
drops the oldest ones of more. After a stall of a path or a machine, many requests come at once. A server that works on
one request at a time therefore gets no more than its queue holds, and the next with each answer.

A server may also work on many requests at a time; nothing says so but its answers. So the window has exceptions:

- A request that a later one has overtaken does not count. Such a server answers in any order, or has lost it.
- Where the server answers nothing for a while, the window grows by one, after the next such while by two, then four.
- Where requests have waited for long although the server answers, the window doubles, and soon again.
"""

from __future__ import annotations

from typing import Final

from gdp.intervals import NEVER_S

_STALL_S: Final = 0.5  # without any answer
_PATIENCE_S: Final = 2.0  # of requests that wait, while others are answered
_AGAIN_S: Final = 0.25  # until the window doubles again


class ServerWindow:
    """Window of one local server; ``size``: requests that its queue holds."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._given: dict[int, None] = {}  # not overtaken, the oldest first
        self._extra = 0
        self._grant = 1  # growth at the next stall
        self._stall_at_s = NEVER_S  # when the server has answered nothing for too long
        self._double_at_s = NEVER_S  # when requests have waited for too long

    @property
    def is_open(self) -> bool:
        """Return whether the server may have another request."""
        return len(self._given) < self._size + self._extra

    def give(self, number: int) -> None:
        """Record that the server has a request."""
        self._given[number] = None

    def answered(self, number: int) -> None:
        """Record an answer."""
        self._stall_at_s, self._grant = NEVER_S, 1
        if number in self._given:
            for earlier in list(self._given):
                del self._given[earlier]
                if earlier == number:
                    break
        if not self._given:
            self._extra = 0

    def drop(self, number: int) -> None:
        """Forget a request for which no client waits any more."""
        self._given.pop(number, None)

    def clear(self) -> None:
        """Forget all requests."""
        self._given.clear()
        self._extra, self._grant = 0, 1
        self._stall_at_s = self._double_at_s = NEVER_S

    def handle_waiting(self, now_s: float, *, waits: bool) -> None:
        """Note whether requests wait now for the window; it grows where they have waited for too long."""
        if not waits:
            self._stall_at_s = self._double_at_s = NEVER_S
        elif not self.is_open:
            if now_s >= self._stall_at_s:
                self._extra += self._grant
                self._grant *= 2
                self._stall_at_s = NEVER_S
            if now_s >= self._double_at_s:
                self._extra += self._size + self._extra
                self._double_at_s = now_s + _AGAIN_S
            self._stall_at_s = min(self._stall_at_s, now_s + _STALL_S)
            self._double_at_s = min(self._double_at_s, now_s + _PATIENCE_S)

    def get_timer(self) -> float | None:
        """Return the monotonic second at which the window grows, or None."""
        due_s = min(self._stall_at_s, self._double_at_s)
        return None if due_s == NEVER_S else due_s
