"""Unicast streams of one node on one name: one for each peer, and the choice of those to forget."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final

from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPaths
from gdp.client.send_options import RELIABLE, PublisherSettings
from gdp.client.sequence_numbers import SequenceRegistry
from gdp.client.unicast_stream import Party, PeerIncarnation, UnicastStream, private_name
from gdp.errors import DropReason, LocalError
from gdp.intervals import FORGET_S
from gdp.message.loss import LossReason
from gdp.names import Name

STREAMS_MAX: Final = 1_024


class UnicastStreams:
    """A server's streams to its clients, or a client's to its servers.

    Args:
        sequence_registry: last numbers of forgotten streams; shared by all publishers of this incarnation.
        published: called with each stream that has frames to send.
        settings: of each stream.
        reader_paths: what may leave to each reader node; shared by all publishers of a participant.
    """

    def __init__(
        self,
        *,
        service: Name,
        writer: WriterIdentity,
        secrets: Secrets,
        sequence_registry: SequenceRegistry,
        published: Callable[[Publisher], None],
        settings: PublisherSettings = RELIABLE,
        reader_paths: ReaderPaths | None = None,
    ) -> None:
        self._service = service
        self._reader_paths = reader_paths
        self._writer = writer
        self._secrets = secrets
        self._sequence_registry = sequence_registry
        self._published = published
        self._settings = settings
        self._streams: dict[Name, UnicastStream] = {}  # by reader
        self._look_at_s = 0.0  # no stream is idle for long enough before
        self._drops: Counter[DropReason] = Counter()  # of closed streams
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
        """Return how many messages a reader did not get, as far as known here, by reason."""
        return sum((stream.losses.counts for stream in self), self._losses)

    def is_about(self, stream: bytes, party: Party) -> bool:
        """Return whether this is the name of the stream to a reader, existing or not."""
        known = self._streams.get(party.incarnation_id.name)
        return stream == (known.topic if known is not None else self._name_of(party))

    def get(self, reader: PeerIncarnation) -> UnicastStream | None:
        """Return the stream to an incarnation of a reader, or None."""
        stream = self._streams.get(reader.name)
        return stream if stream is not None and stream.reader == reader else None

    def stream(self, party: Party, mtu: int | None, now_s: float) -> UnicastStream:
        """Return the stream to a reader, created if there is none.

        Args:
            party: the reader, one that is connected.
            mtu: smallest on the path to all of them; None if not known yet.

        Raises:
            LocalError: there are too many, all of them in use.
        """
        reader = party.incarnation_id
        stream = self._streams.get(reader.name)
        if stream is None:
            self._free_space()
            past = self._sequence_registry.of(self._name_of(party))
            stream = self._streams[reader.name] = UnicastStream(
                service=self._service,
                writer=self._writer,
                party=party,
                secrets=self._secrets,
                mtu=mtu,
                settings=self._settings,
                reader_paths=self._reader_paths,
                past=past,
            )
            stream.published = self._published
        stream.note_second_path(party.second_path_s)
        stream.mark_in_use(now_s)
        return stream

    def forget(self, reader: PeerIncarnation) -> None:
        """Drop the stream to a reader, if any; a later one to the same incarnation continues above its numbers."""
        stream = self._streams.get(reader.name)
        if stream is not None and stream.reader == reader:
            del self._streams[reader.name]
            self._sequence_registry.put(stream.topic, stream.past)
            stream.close()
            self._drops += stream.drops
            self._losses += stream.losses.counts

    def forget_idle(self, now_s: float) -> None:
        """Drop streams that had neither a reader nor a message for ``FORGET_S``."""
        if now_s >= self._look_at_s:
            self._look_at_s = now_s + FORGET_S / 4
            for reader in [stream.reader for stream in self if stream.is_idle(now_s)]:
                self.forget(reader)

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Replace the service's secrets."""
        self._secrets = secrets
        for stream in self:
            stream.renew(secrets, now_s)

    def close(self) -> None:
        """Close all streams."""
        for reader in [stream.reader for stream in self]:
            self.forget(reader)

    def _name_of(self, party: Party) -> Name:
        own = PeerIncarnation(self._writer.name, self._writer.incarnation)
        return private_name(self._service, own, party.incarnation_id, is_session=party.is_session)

    def _free_space(self) -> None:
        if len(self._streams) < STREAMS_MAX:
            return
        silent = next((stream.reader for stream in self if not stream.readers), None)
        if silent is None:
            raise LocalError(f"{STREAMS_MAX} private streams of {self._service.short} are in use: no more at once")
        self.forget(silent)
