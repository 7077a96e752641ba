"""Late join: what a holder has of a topic comes before the live messages, in order, and nothing twice.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Live messages of a publisher wait until those before them were
read. Where the holder does not have the last of them yet, it is asked again for a while.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.opening import Kept
from gdp.capsule.reading import CapsuleReader, given
from gdp.client.delivery import Delivered
from gdp.client.participant import Message, Topic
from gdp.intervals import NEVER_S, RETRY_S, TICK_S
from gdp.limits import WINDOW_BYTES

_FIRST_NS: Final = 1_000_000_000  # read from so long before now on, then from eight times as long, until it suffices
_GROWTH: Final = 8


@dataclass(slots=True)
class _Writer:
    span_ns: int
    descriptors: list[Descriptor] = field(default_factory=list)
    readers: deque[CapsuleReader] = field(default_factory=deque)
    past: deque[Kept] = field(default_factory=deque)
    live: deque[Message] = field(default_factory=deque)  # what waits
    last: tuple[int, int] = 0, 0  # incarnation and sequence number of what was read or delivered last
    again_s: float = 0.0
    until_s: float = NEVER_S  # patience with the holder, from the first gap on
    is_read: bool = False
    is_live: bool = False  # a live message was delivered, so no gap is filled any more


class LateJoin:
    """What the late joiner of one topic gets.

    Args:
        unix_s: now.
        age_s: of the oldest message; None: any.
        messages: most, of each publisher's past; ``most_bytes``: most bytes of them.
    """

    def __init__(self, topic: Topic, unix_s: float, age_s: float | None, messages: int, most_bytes: int) -> None:
        self._topic = topic
        self._now_ns = int(unix_s * 1e9)
        self._age_ns = int((unix_s if age_s is None else age_s) * 1e9)
        self._most = messages, most_bytes
        self._writers: dict[bytes, _Writer] = {}
        self._is_listed = False
        self._asked: _Writer | None = None

    @property
    def is_done(self) -> bool:
        """Return whether the holder has nothing to answer any more, as far as is known."""
        return self._is_listed and all(each.is_read for each in self._writers.values())

    def next_request(self, now_s: float) -> HolderRequest | None:
        """Return what to ask the holder now."""
        if not self._is_listed:
            return HolderRequest(ask=Ask.LIST, topic=self._topic.name)
        unread = [each for each in self._writers.values() if not each.is_read and now_s >= each.again_s]
        self._asked = unread[0] if unread else None
        return self._asked.readers[0].next_request() if self._asked is not None else None

    def handle_response(self, answer: HolderAnswer, now_s: float) -> None:
        """Process the answer to the latest request."""
        writer = self._asked
        if not self._is_listed:
            self._begin(given(answer.descriptors), now_s)
        if writer is None:
            return
        reader, (messages, most_bytes) = writer.readers[0], self._most
        for kept in reader.handle_response(answer):
            if kept.incarnation != writer.last[0] or kept.sequence > writer.last[1]:
                writer.past.append(kept)
                writer.last = kept.incarnation, kept.sequence
        held_bytes = sum(len(each.message) for each in writer.past)
        while len(writer.past) > messages or held_bytes > most_bytes:
            held_bytes -= len(writer.past.popleft().message)
        if reader.is_done and len(writer.readers) > 1:
            writer.readers.popleft()
        elif reader.is_done and len(writer.past) < messages and writer.span_ns < self._age_ns and not writer.again_s:
            self._read(writer, writer.span_ns * _GROWTH)
        elif reader.is_done:
            self._end(writer, now_s)

    def give_up(self) -> None:
        """Wait for the holder no more."""
        self._is_listed = True
        for writer in self._writers.values():
            writer.until_s, writer.is_read = -NEVER_S, True

    def receive_live(self, message: Message, now_s: float) -> None:
        """Take in a live message."""
        publisher = message.delivered.publisher
        writer = self._writers.setdefault(publisher, _Writer(_FIRST_NS, is_read=self._is_listed))
        writer.live.append(message)
        if writer.is_read and not writer.is_live:
            self._end(writer, now_s)
        if sum(len(each.delivered.message) for each in writer.live) > WINDOW_BYTES:
            writer.until_s, writer.is_read = -NEVER_S, self._is_listed

    def poll_messages(self) -> list[Message]:
        """Return, once, what is to be delivered now."""
        found = list[Message]()
        for publisher, writer in self._writers.items():
            if writer.is_read:
                found += self._released(publisher, writer)
        return found

    def _begin(self, descriptors: Iterable[Descriptor], now_s: float) -> None:
        self._is_listed = True
        for each in sorted(descriptors, key=lambda each: each.begun_ms):
            self._writers.setdefault(each.writer.name, _Writer(_FIRST_NS)).descriptors.append(each)
        for writer in self._writers.values():
            if writer.descriptors:
                self._read(writer, _FIRST_NS)
            else:
                self._end(writer, now_s)

    def _read(self, writer: _Writer, span_ns: int) -> None:
        """Read all from some time before now on."""
        writer.span_ns, writer.last = min(span_ns, self._age_ns), (0, 0)
        begin, secrets = max(self._now_ns - writer.span_ns, 1), {self._topic.name: self._topic.secrets}
        writer.readers = deque(CapsuleReader(each, secrets, from_ns=begin) for each in writer.descriptors)
        writer.past.clear()

    def _end(self, writer: _Writer, now_s: float) -> None:
        """End reading, unless something is between the past and the first live message, and may come soon."""
        first = writer.live[0].delivered if writer.live else None
        has_gap = first is not None and first.incarnation == writer.last[0] and first.sequence > writer.last[1] + 1
        writer.is_read = not has_gap or now_s >= writer.until_s
        if not writer.is_read:
            writer.until_s, writer.again_s = min(writer.until_s, now_s + RETRY_S), now_s + TICK_S
            writer.readers[0].is_done = False

    def _released(self, publisher: bytes, writer: _Writer) -> list[Message]:
        if writer.live:
            first, writer.is_live = writer.live[0].delivered, True
            if writer.past and first.incarnation == writer.last[0]:
                writer.last = first.incarnation, min(writer.last[1], first.sequence - 1)
        found = list[Message]()
        for at, kept in enumerate(writer.past):
            if kept.incarnation != writer.last[0] or kept.sequence <= writer.last[1]:
                delivered = Delivered(publisher, kept.incarnation, 0, kept.message, 1, 0, at, kept.sequence)
                found.append(Message(self._topic.name, delivered, kept.description))
        for message in writer.live:
            incarnation, sequence = message.delivered.incarnation, message.delivered.sequence
            if incarnation != writer.last[0] or sequence > writer.last[1]:
                found.append(message)
                writer.last = incarnation, sequence
        writer.past.clear()
        writer.live.clear()
        return found
