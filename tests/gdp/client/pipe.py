"""Publisher and its readers, joined by a pipe that loses, doubles and reorders frames, under a clock that jumps."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from random import Random

from gdp.client.delivery import Delivered
from gdp.client.identities import PublisherIdentity, ReaderIdentity, WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.publisher import Publisher
from gdp.client.send_options import DEFAULT_OPTIONS, PublisherSettings, SendOptions
from gdp.client.writer_proxy import WriterProxy
from gdp.crypto.keys import SigningKey
from gdp.frame.codec import Kind, decode
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.names import Name
from tests.gdp.client.incarnation_ids import reader_of, source_of

TOPIC = Name(b"t" * 32)
WRITER = SigningKey.generate()
SECRETS: Secrets = {1: b"1" * 32}
DELAY_S = 0.002


def sequenced(sequence: int, body: bytes) -> bytes:
    """Return the plaintext that a publisher seals: a message or a bundle behind its sequence number."""
    return sequence.to_bytes(8, "big") + body


def publisher_of(
    *,
    incarnation: int = 1,
    secrets: Secrets = SECRETS,
    reliable: bool = True,
    urgent: bool = False,
    depth: int = 0,
    options: SendOptions = DEFAULT_OPTIONS,
) -> Publisher:
    source = source_of(Name(b"p" * 32), incarnation, WRITER)
    publisher = Publisher(
        topic=TOPIC,
        source=source,
        secrets=secrets,
        description=b"what it is",
        settings=PublisherSettings(reliable=reliable, urgent=urgent, depth=depth, options=options),
    )
    publisher.tree_stands(1500)
    return publisher


@dataclass
class End:
    """Reader at the end of the pipe."""

    reader: ReaderIdentity
    writer_proxy: WriterProxy
    budget: ReassemblyQuota
    loss: float = 0.0
    mtu: int = 65_535  # capacity of the link to it
    deaf: bool = False  # receives nothing
    mute: bool = False  # sends nothing
    delivered: list[Delivered] = field(default_factory=list)

    @property
    def numbers(self) -> list[int]:
        return [each.number for each in self.delivered]

    @property
    def messages(self) -> list[bytes]:
        return [each.message for each in self.delivered]


class Pipe:
    """One publisher, any number of readers."""

    def __init__(self, publisher: Publisher, *, incarnation: int = 1, seed: int = 1) -> None:
        self.publisher = publisher
        self.incarnation = incarnation
        self.random = Random(seed)
        self.now_s = 100.0
        self.delay_s = DELAY_S
        self.jitter_s = 0.0
        self.doubled = 0.0
        self.batch_bytes = 1 << 30  # of frames that leave at once
        self.pause_s = 0.0  # ... and how long after that the next ones leave
        self.ends: dict[bytes, End] = {}
        self.seen: list[bytes] = []  # every frame that went over the pipe
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._paused_until_s = 0.0

    @property
    def source(self) -> WriterIdentity:
        return self.publisher._keys._writer

    def join(self, name: bytes, *, incarnation: int = 7, loss: float = 0.0, secrets: Secrets = SECRETS) -> End:
        return self.attach(reader_of(name, incarnation), loss=loss, secrets=secrets)

    def attach(self, reader: ReaderIdentity, *, loss: float = 0.0, secrets: Secrets = SECRETS) -> End:
        reader = replace(reader, budget=ReassemblyQuota())
        writer_proxy = WriterProxy(
            topic=TOPIC,
            reader=reader,
            publisher=PublisherIdentity(
                Name(b"p" * 32), self.incarnation, WRITER.public, self.source.control_keys.public
            ),
            secrets=secrets,
            now_s=self.now_s,
        )
        end = self.ends[reader.name] = End(reader, writer_proxy, reader.budget, loss)
        return end

    def publish(self, messages: Sequence[bytes]) -> None:
        for message in messages:
            self.publisher.publish(message)
            self._flush()

    def run(self, for_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Advance time; return whether ``until`` came true."""
        end_s = self.now_s + for_s
        turns = 0
        while not until():
            turns += 1
            assert turns < 500_000, "busy without getting anywhere"
            self._flush()
            at_s = min(self._next_s(), end_s)
            if at_s >= end_s:
                self.now_s = end_s
                return until()
            self.now_s = max(self.now_s, at_s)
            while self._events and self._events[0][0] <= self.now_s:
                heapq.heappop(self._events)[2]()
            self.publisher.handle_timer(self.now_s)
            for each in self.ends.values():
                each.writer_proxy.handle_timer(self.now_s)
                each.delivered += each.writer_proxy.delivery.poll()
        return True

    def _next_s(self) -> float:
        times = [self.publisher.get_timer(), *(end.writer_proxy.get_timer() for end in self.ends.values())]
        return min([*times, self._events[0][0]]) if self._events else min(times)

    def _flush(self) -> None:
        for frame in self._polled():
            self.seen.append(frame)
            for end in self.ends.values():
                if not end.deaf and len(frame) <= end.mtu:
                    self._send(frame, end, self._to_reader(end, frame))
        for end in self.ends.values():
            notes = end.writer_proxy.control_to_send(self.now_s)
            for note in [] if end.mute else notes:
                self.seen.append(note)
                self._send(note, end, partial(self.tell, note))

    def _polled(self) -> list[bytes]:
        if self.now_s < self._paused_until_s:
            return self.publisher.poll_frames(self.now_s, 0)  # Heartbeats leave in any case
        frames = self.publisher.poll_frames(self.now_s, self.batch_bytes)
        if frames and self.pause_s:
            self._paused_until_s = self.now_s + self.pause_s
            heapq.heappush(self._events, (self._paused_until_s, next(self._order), lambda: None))
        return frames

    def _send(self, frame: bytes, end: End, arrive: Callable[[], None]) -> None:
        for _ in range(2 if self.random.random() < self.doubled else 1):
            if self.random.random() >= end.loss:
                due_s = self.now_s + self.delay_s + self.random.random() * self.jitter_s
                heapq.heappush(self._events, (due_s, next(self._order), arrive))

    def _to_reader(self, end: End, frame: bytes) -> Callable[[], None]:
        def arrive() -> None:
            header = decode(frame)
            assert header.kind in (Kind.DATA, Kind.HEARTBEAT, Kind.PARITY)
            end.writer_proxy.receive(header, frame, self.now_s, 0.0)
            end.delivered += end.writer_proxy.delivery.poll()

        return arrive

    def tell(self, *notes: bytes) -> None:
        """Give control datagrams to the publisher."""
        for note in notes:
            header = decode(note)
            if header.kind == Kind.INTRODUCTION:
                self.publisher.receive_introduction(header, note)
            else:
                self.publisher.receive_acknack(header, note, self.now_s)
