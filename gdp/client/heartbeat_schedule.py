"""When a publisher's next status goes, and what it tells: where new readers begin, and what the messages are.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A new reader asks until it is told what the messages are. Those that read already do not know that there is news, and
nothing confirms a status: so news is said at once, before any message that it is about, and several times more, at
growing distances.
"""

from __future__ import annotations

from typing import Final

from gdp.message.heartbeat import STARTS_MAX, Heartbeat, StreamStart

__all__ = ["HeartbeatSchedule"]

_GAP_S: Final = 0.02  # between two
_BYTES_PER_S: Final = 8 << 20  # ... and longer after a large one
_PAUSES_S: Final = (0.05, 0.2, 0.8, 3.2)  # after each saying of news but the last
_NEVER: Final = float("inf")


class HeartbeatSchedule:
    """The statuses of one publisher.

    Args:
        number: of the last one, in this life.

    Attributes:
        wanted: there is something to tell.
        starts: new readers, and where they begin.
    """

    def __init__(self, description: bytes, number: int) -> None:
        self.number = number
        self.wanted = False
        self.starts: dict[bytes, StreamStart] = {}
        self._description = description
        self._said = len(_PAUSES_S) + 1  # times; it is no news
        self._again_s = _NEVER  # when the news is to be said again
        self._at_s = -_NEVER  # when the next status may go

    def describe(self, description: bytes) -> bool:
        """Take what the messages are; return whether it is news."""
        if description == self._description:
            return False
        self._description, self._said, self.wanted = description, 0, True
        self._at_s = -_NEVER
        return True

    @property
    def is_full(self) -> bool:
        """Return whether further new readers must ask again."""
        return len(self.starts) >= STARTS_MAX

    def handle_timer(self, now_s: float) -> None:
        """Want to say the news again, if it is time."""
        self.wanted |= self._again_s <= now_s

    def get_timer(self) -> float | None:
        """Return the monotonic second at which one may go or will be wanted, or None."""
        at_s = self._at_s if self.wanted else self._again_s
        return None if at_s == _NEVER else at_s

    def is_due(self, now_s: float) -> bool:
        """Return whether one is wanted and may go."""
        return self.wanted and now_s >= self._at_s

    def poll_heartbeat(self, place: Heartbeat, now_s: float) -> bytes:
        """Return the wire form of the next one, whose number is then ``number``.

        Args:
            place: what is kept, sent, moved and gone; starts and description are added.
        """
        is_news = self._said <= len(_PAUSES_S)
        about = self._description if self.starts or is_news else b""
        if is_news:
            self._again_s = now_s + _PAUSES_S[self._said] if self._said < len(_PAUSES_S) else _NEVER
            self._said += 1
        wire = place._replace(starts=dict(self.starts), description=about).to_wire()
        self.starts.clear()
        self.wanted = False
        self.number += 1
        self._at_s = now_s + max(_GAP_S, len(wire) / _BYTES_PER_S)
        return wire
