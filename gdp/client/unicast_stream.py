"""Unicast stream: a server's responses to one client, or a client's requests to one server; reliable and in order.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/design.md, section 6 ("answers return
by unicast"). It is an ordinary stream, with three differences:

- Its frames are addressed to the reader, so any switch can route them.
- A name that both ends derive from their incarnations replaces the topic in keys and reports. The header's incarnation
  is derived from that name: a later incarnation of either end shares nothing with it.
- There are no introductions. The writer knows its one reader by that reader's advertisement, and the reader expects
  number 1.
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
    """Incarnation of a connected node, and the X25519 key that its advertisement names."""

    incarnation_id: PeerIncarnation
    exchange: bytes


def private_name(service: Name, writer: PeerIncarnation, reader: PeerIncarnation) -> Name:
    """Return the name of the stream from one party to another on a service's name; the reverse is another stream."""
    ends = b"".join(name + incarnation.to_bytes(8, "big") for name, incarnation in (writer, reader))
    return Name(hashlib.sha256(b"gdp-private-1" + service + ends).digest())


def private_incarnation(name: Name) -> int:
    """Return the source incarnation in the headers of a unicast stream."""
    return int.from_bytes(hashlib.sha256(b"gdp-private-incarnation-1" + name).digest()[:8], "big")


class UnicastStream(Publisher):
    """Writer's end of a unicast stream.

    Args:
        writer: its source for all readers.
        mtu: smallest on the path; None if not known yet.
        past: of the same stream, if it was forgotten.
        paths: over how many paths each frame is sent.
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
        paths: int = 1,
    ) -> None:
        self.reader = party.incarnation_id
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
            paths=paths,
        )
        self.second_path_until_s = float("inf")  # no join tells of it; without one the first switch drops the copies
        self.tree_stands(MTU_MIN_BYTES if mtu is None else mtu)

    def mark_in_use(self, now_s: float) -> None:
        """Note that the stream is in use; a silent reader becomes active."""
        self._touched_s = now_s
        self.connect(*self.reader, self._exchange, now_s)

    def receive_acknack(self, header: Header, frame: bytes, now_s: float) -> bool:
        """Process the reader's report, which reactivates a silent reader."""
        is_taken = super().receive_acknack(header, frame, now_s)
        if is_taken:
            self.mark_in_use(now_s)
        return is_taken

    def is_idle(self, now_s: float) -> bool:
        """Return whether it may be forgotten."""
        return not self.readers and now_s - self._touched_s >= IDLE_S


class UnicastReceiver(WriterProxy):
    """Reader's end of a unicast stream.

    It is created for the first frame that arrives; frames lost before that are requested. Its messages are delivered
    once the description of its writer is known. Until then only few are accepted.

    Args:
        name: of the stream.
        public: the writer proxy of the same writer's stream to all.
        verifier: of the writer's signatures.
        ended: where the same stream ended before, in this incarnation.
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
        """Process one DATA or HEARTBEAT frame of this writer; one that is refused is requested again."""
        if self._public.state is WriterProxyState.NEW and self.delivered_bytes >= FLIGHT_START_BYTES:
            self.refuse(DropReason.MEMORY_FULL)
        else:
            super().receive(header, frame, now_s)
