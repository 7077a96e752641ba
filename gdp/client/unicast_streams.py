"""What one node says on one name to each of the others alone: which streams there are, and which it may forget.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final

from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.publisher import Publisher
from gdp.client.sequence_numbers import SequenceRegistry
from gdp.client.unicast_stream import IDLE_S, Party, PeerIncarnation, UnicastStream, private_name
from gdp.errors import DropReason, LocalError
from gdp.message.loss import LossReason
from gdp.names import Name

__all__ = ["STREAMS_MAX", "UnicastStreams"]

STREAMS_MAX: Final = 1_024


class UnicastStreams:
    """A server's streams to its clients, or a client's to its servers.

    Args:
        urgent: whether what they carry goes before what is not.
        pasts: of what was forgotten; shared by all that this life publishes.
        published: told of each stream that has something to send.
    """

    def __init__(
        self,
        *,
        service: Name,
        writer: WriterIdentity,
        secrets: Secrets,
        sequence_registry: SequenceRegistry,
        published: Callable[[Publisher], None],
        urgent: bool,
    ) -> None:
        self._service = service
        self._writer = writer
        self._secrets = secrets
        self._sequence_registry = sequence_registry
        self._published = published
        self._urgent = urgent
        self._streams: dict[Name, UnicastStream] = {}  # by reader
        self._look_at_s = 0.0  # no stream is idle for long enough before
        self._drops: Counter[DropReason] = Counter()  # of streams that are gone
        self._losses: Counter[LossReason] = Counter()

    def __iter__(self) -> Iterator[UnicastStream]:
        return iter(self._streams.values())

    def __len__(self) -> int:
        return len(self._streams)

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        return sum((stream.drops for stream in self), self._drops)

    @property
    def losses(self) -> Counter[LossReason]:
        """Return how many messages a reader did not get, as far as it is known here, by reason."""
        return sum((stream.losses.counts for stream in self), self._losses)

    def is_about(self, stream: bytes, reader: PeerIncarnation) -> bool:
        """Return whether this is the name of the stream to a reader, whether there is one or not."""
        known = self._streams.get(reader.name)
        return stream == (known.topic if known is not None else self._name_of(reader))

    def get(self, reader: PeerIncarnation) -> UnicastStream | None:
        """Return the stream to a life of a reader, or None."""
        stream = self._streams.get(reader.name)
        return stream if stream is not None and stream.reader == reader else None

    def stream(self, party: Party, mtu: int | None, now_s: float) -> UnicastStream:
        """Return the stream to a reader, made if it is not there.

        Args:
            party: the reader, one that is heard.
            mtu: smallest on the way to all of them; None where that is not known yet.

        Raises:
            LocalError: there are too many, all of them in use.
        """
        reader = party.life
        stream = self._streams.get(reader.name)
        if stream is None:
            self._make_room()
            past = self._sequence_registry.of(self._name_of(reader))
            stream = self._streams[reader.name] = UnicastStream(
                service=self._service,
                writer=self._writer,
                party=party,
                secrets=self._secrets,
                mtu=mtu,
                urgent=self._urgent,
                past=past,
                now_s=now_s,
            )
            stream.published = self._published
        stream.touch(now_s)
        return stream

    def forget(self, reader: PeerIncarnation) -> None:
        """Let go of the stream to a reader, if there is one; another to the same life goes on above its numbers."""
        stream = self._streams.get(reader.name)
        if stream is not None and stream.reader == reader:
            del self._streams[reader.name]
            self._sequence_registry.put(stream.topic, stream.past)
            stream.close()
            self._drops += stream.drops
            self._losses += stream.losses.counts

    def forget_idle(self, now_s: float) -> None:
        """Let go of streams that nobody has read or written for long."""
        if now_s >= self._look_at_s:
            self._look_at_s = now_s + IDLE_S / 4
            for reader in [stream.reader for stream in self if stream.is_idle(now_s)]:
                self.forget(reader)

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Take the service's secrets anew."""
        self._secrets = secrets
        for stream in self:
            stream.renew(secrets, now_s)

    def close(self) -> None:
        """Say nothing any more."""
        for reader in [stream.reader for stream in self]:
            self.forget(reader)

    def _name_of(self, reader: PeerIncarnation) -> Name:
        return private_name(self._service, PeerIncarnation(self._writer.name, self._writer.incarnation), reader)

    def _make_room(self) -> None:
        if len(self._streams) < STREAMS_MAX:
            return
        silent = next((stream.reader for stream in self if not stream.readers), None)
        if silent is None:
            raise LocalError(f"{STREAMS_MAX} private streams of {self._service.short} are in use: no more at once")
        self.forget(silent)
