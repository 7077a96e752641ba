"""Queue of one WebSocket client: bounded, and it drops the oldest whole message of the largest subscription.

Sans-I/O. Control messages (advertisements, status, responses) go first and are never dropped. A client that lets them
pile up is to be disconnected.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

DATA_MAX_BYTES: Final = 16 << 20
DATA_MAX_MESSAGES: Final = 1_024
CONTROL_MAX_BYTES: Final = 64 << 20


@dataclass(frozen=True, slots=True)
class Pending:
    """One message of a subscription, which is encoded when it is sent: clients share the bytes until then."""

    key: int
    stamp_ns: int
    raw: bytes
    order: int


@dataclass(slots=True)
class _Lane:
    messages: deque[Pending] = field(default_factory=deque)
    held_bytes: int = 0


class ClientQueue:
    """Messages that wait for one client.

    Args:
        data_max_bytes: bound of all messages of subscriptions; the newest one is kept even if it alone is larger.
        data_max_messages: bound of their number.

    Attributes:
        dropped: messages dropped so far.
        is_overrun: the control messages exceed their bound, or the queues of all clients do and this one has most.
        held_bytes: the bytes of the messages of subscriptions.
    """

    def __init__(self, data_max_bytes: int = DATA_MAX_BYTES, data_max_messages: int = DATA_MAX_MESSAGES) -> None:
        self._max_bytes = data_max_bytes
        self._max_messages = data_max_messages
        self._control: deque[str | bytes] = deque()
        self._control_bytes = 0
        self._lanes: dict[int, _Lane] = {}
        self._order = 0
        self._count = 0
        self.held_bytes = 0
        self.dropped = 0
        self.is_overrun = False

    @property
    def waiting_bytes(self) -> int:
        """Return the bytes of everything that waits."""
        return self.held_bytes + self._control_bytes

    def put_control(self, payload: str | bytes) -> None:
        """Add a message that must arrive."""
        self._control.append(payload)
        self._control_bytes += len(payload)
        self.is_overrun |= self._control_bytes > CONTROL_MAX_BYTES

    def put(self, key: int, stamp_ns: int, raw: bytes, depth: int = 0) -> None:
        """Add a message of a subscription; drop the oldest ones that exceed a bound.

        Args:
            depth: most messages of this subscription that may wait; 0: no bound of its own.
        """
        self._order += 1
        lane = self._lanes.setdefault(key, _Lane())
        lane.messages.append(Pending(key, stamp_ns, raw, self._order))
        lane.held_bytes += len(raw)
        self.held_bytes += len(raw)
        self._count += 1
        while depth and len(lane.messages) > depth:
            self._drop_oldest(key)
        while self._count > 1 and (self.held_bytes > self._max_bytes or self._count > self._max_messages):
            self._drop_oldest(self._largest(key))

    def forget(self, key: int) -> Sequence[Pending]:
        """Remove and return the messages of a subscription that has ended; they do not count as dropped."""
        lane = self._lanes.pop(key, None) or _Lane()
        self._count -= len(lane.messages)
        self.held_bytes -= lane.held_bytes
        return lane.messages

    def pop(self) -> str | bytes | Pending | None:
        """Return the next message to send: a control message, or the oldest one of any subscription."""
        if self._control:
            payload = self._control.popleft()
            self._control_bytes -= len(payload)
            return payload
        key = min(self._lanes, key=lambda each: self._lanes[each].messages[0].order, default=None)
        return None if key is None else self._take(key)

    def _largest(self, newest: int) -> int:
        """Return the subscription with most bytes, other than that of the newest message if it is its only one."""
        sizes = {key: lane.held_bytes for key, lane in self._lanes.items() if key != newest or len(lane.messages) > 1}
        return max(sizes, key=sizes.__getitem__)

    def _drop_oldest(self, key: int) -> None:
        self._take(key)
        self.dropped += 1

    def _take(self, key: int) -> Pending:
        lane = self._lanes[key]
        message = lane.messages.popleft()
        lane.held_bytes -= len(message.raw)
        self.held_bytes -= len(message.raw)
        self._count -= 1
        if not lane.messages:
            del self._lanes[key]
        return message
