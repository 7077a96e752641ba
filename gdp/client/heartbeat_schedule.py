"""Schedule of a publisher's Heartbeats: when the next one is due, and which starts and description it carries.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A new reader repeats its request until a Heartbeat brings the description. Present readers cannot know of a new
description, and no reader acknowledges a Heartbeat. So a new description is sent at once, before any message that it
describes, and repeated several times at growing intervals.

A Heartbeat that repeats what a reader seems not to know is a reminder. There is one within a round trip: the reader's
answer to the one before cannot have come earlier. Else a slow link would fill with reminders of its own slowness
(RFC 8085, section 3.1.3).
"""

from __future__ import annotations

from typing import Final

from gdp.intervals import NEVER_S, READER
from gdp.limits import REPORT_DELAY_S
from gdp.message.heartbeat import STARTS_MAX, Heartbeat, StreamStart

_BYTES_PER_S: Final = 8 << 20  # ... and longer after a large one
_PAUSES_S: Final = (0.05, 0.2, 0.8, 3.2)  # after each sending of a new description but the last


class HeartbeatSchedule:
    """Heartbeats of one publisher.

    Args:
        number: of the last one, in this incarnation.

    Attributes:
        wanted: a Heartbeat has to be sent.
        is_reminder_wanted: ... once a round trip has passed since the last one.
        starts: new readers, and where they begin.
        again_s: monotonic second at which the description is sent again; infinity: never.
    """

    def __init__(self, description: bytes, number: int) -> None:
        self.number = number
        self.wanted = self.is_reminder_wanted = False
        self.starts: dict[bytes, StreamStart] = {}
        self._description = description
        self._said = len(_PAUSES_S) + 1  # times that the description was sent; beyond the last it is not new
        self.again_s = NEVER_S
        self._at_s = self._remind_s = -NEVER_S  # when the next Heartbeat, and the next reminder, may be sent

    def describe(self, description: bytes) -> bool:
        """Set the description; return whether it is new."""
        if description == self._description:
            return False
        self._description, self._said, self.wanted = description, 0, True
        self._at_s = -NEVER_S
        return True

    @property
    def is_full(self) -> bool:
        """Return whether further new readers must repeat their request."""
        return len(self.starts) >= STARTS_MAX

    def handle_timer(self, now_s: float) -> None:
        """Request another Heartbeat if the description is to be repeated now."""
        self.wanted |= self.again_s <= now_s

    def get_timer(self) -> float:
        """Return the monotonic second at which a Heartbeat may be sent or will be wanted; infinity: never."""
        at_s = self._at_s if self.wanted else self.again_s
        return min(at_s, self._remind_s) if self.is_reminder_wanted else at_s

    def is_due(self, now_s: float) -> bool:
        """Return whether a Heartbeat is wanted and may be sent."""
        return (self.wanted and now_s >= self._at_s) or (self.is_reminder_wanted and now_s >= self._remind_s)

    def poll_heartbeat(self, place: Heartbeat, now_s: float, trip_s: float = 0.0) -> bytes:
        """Return the wire form of the next one, whose number is then ``number``.

        Args:
            place: what is cached, sent, renumbered and gone; starts and description are added.
            trip_s: how long a reader's answer to it may take.
        """
        is_news = self._said <= len(_PAUSES_S)
        about = self._description if self.starts or is_news else b""
        if is_news:
            self.again_s = now_s + _PAUSES_S[self._said] if self._said < len(_PAUSES_S) else NEVER_S
            self._said += 1
        wire = place._replace(starts=dict(self.starts), description=about).to_wire()
        self.starts.clear()
        self.wanted = self.is_reminder_wanted = False
        self.number += 1
        self._at_s = now_s + max(REPORT_DELAY_S, len(wire) / _BYTES_PER_S)
        self._remind_s = max(self._at_s, now_s + min(trip_s, READER.refresh_s))
        return wire

    def describe_apart(self, place: Heartbeat) -> tuple[int, bytes]:
        """Return number and wire form of one that is for no reader, with the description; nothing else changes."""
        self.number += 1
        return self.number, place._replace(description=self._description).to_wire()
