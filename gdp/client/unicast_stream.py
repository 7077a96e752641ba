"""A private stream: what a server answers to one client, or a client asks one server; by unicast, reliable, in order.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
Source: docs/explanation/design.md, section 6
("answers return by unicast"). It is an ordinary stream, but for three things:

- its frames are addressed to the reader, so any switch finds their way;
- a name that both ends derive from who they are, in this life, stands for the topic in keys and notes, and the header's
  incarnation is derived from that: a later life of either end shares nothing with it;
- nobody introduces himself. The writer knows its one reader by that one's claim, and the reader expects number 1.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Final, NamedTuple

from gdp.client.identities import ReaderIdentity, WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.publisher import Publisher
from gdp.client.sequence_numbers import SequenceState
from gdp.client.writer_proxy import Ended, WriterProxy, WriterProxyState
from gdp.errors import DropReason
from gdp.frame.codec import Header
from gdp.limits import FLIGHT_START_BYTES, MTU_MIN_BYTES
from gdp.message.reassembly import VerifiesDigest
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.names import Name

__all__ = [
    "IDLE_S",
    "Party",
    "PeerIncarnation",
    "UnicastReceiver",
    "UnicastStream",
    "private_incarnation",
    "private_name",
]

IDLE_S: Final = 60.0  # without a reader and a message, after which a stream is forgotten


class PeerIncarnation(NamedTuple):
    """A node from one start to the next."""

    name: Name
    incarnation: int


class Party(NamedTuple):
    """A life of a node that is heard, and the X25519 key that its claim names."""

    life: PeerIncarnation
    exchange: bytes


def private_name(service: Name, writer: PeerIncarnation, reader: PeerIncarnation) -> Name:
    """Return the name of what one says to another on a service's name; the other way is another stream."""
    ends = b"".join(name + incarnation.to_bytes(8, "big") for name, incarnation in (writer, reader))
    return Name(hashlib.sha256(b"gdp-private-1" + service + ends).digest())


def private_incarnation(name: Name) -> int:
    """Return what stands as the source's incarnation in a private stream's headers."""
    return int.from_bytes(hashlib.sha256(b"gdp-private-incarnation-1" + name).digest()[:8], "big")


class UnicastStream(Publisher):
    """The writer's end.

    Args:
        writer: its source for all readers.
        mtu: smallest on the way; None where that is not known yet.
        past: of the same stream, if it was forgotten.
    """

    def __init__(
        self,
        *,
        service: Name,
        writer: WriterIdentity,
        party: Party,
        secrets: Secrets,
        mtu: int | None,
        urgent: bool,
        past: SequenceState,
        now_s: float,
    ) -> None:
        self.reader = party.life
        self._exchange = party.exchange
        self._touched_s = now_s
        name = private_name(service, PeerIncarnation(writer.name, writer.incarnation), self.reader)
        source = replace(writer, incarnation=private_incarnation(name))
        super().__init__(
            topic=name,
            source=source,
            secrets=secrets,
            description=b"",
            reliable=True,
            urgent=urgent,
            past=past,
            address=self.reader.name,
        )
        self.tree_stands(MTU_MIN_BYTES if mtu is None else mtu)

    def touch(self, now_s: float) -> None:
        """Note that the stream is in use; a silent reader becomes active."""
        self._touched_s = now_s
        self.connect(*self.reader, self._exchange, now_s)

    def receive_acknack(self, header: Header, frame: bytes, now_s: float) -> bool:
        """Take the reader's report; a silent one is a reader again by that."""
        is_taken = super().receive_acknack(header, frame, now_s)
        if is_taken:
            self.touch(now_s)
        return is_taken

    def is_idle(self, now_s: float) -> bool:
        """Return whether it may be forgotten."""
        return not self.readers and now_s - self._touched_s >= IDLE_S


class UnicastReceiver(WriterProxy):
    """The reader's end.

    It is made for the first frame that comes, lost ones before that are asked for. What it brings is handed on when it
    is known what its writer's messages are, and until then not much is taken.

    Args:
        name: of the stream.
        public: what the same writer says to all.
        verifier: of the writer's signatures.
        ended: where the same stream ended before, in this life.
    """

    def __init__(
        self,
        *,
        name: Name,
        reader: ReaderIdentity,
        public: WriterProxy,
        verifier: VerifiesDigest,
        secrets: Secrets,
        budget: ReassemblyQuota,
        now_s: float,
        ended: Ended,
    ) -> None:
        self._public = public
        super().__init__(
            topic=name,
            reader=reader,
            publisher=public.publisher,
            incarnation=private_incarnation(name),
            writer=verifier,
            exchange=public.exchange,
            secrets=secrets,
            budget=budget,
            now_s=now_s,
            ended=ended,
            introduces=False,
        )

    def receive(self, header: Header, frame: bytes, now_s: float) -> None:
        """Process one DATA or STATUS frame of this writer; one that is refused is requested again."""
        if self._public.state is WriterProxyState.NEW and self.delivered_bytes >= FLIGHT_START_BYTES:
            self.refuse(DropReason.MEMORY_FULL)
        else:
            super().receive(header, frame, now_s)
