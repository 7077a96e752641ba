"""Unicast stream: a server's responses to one client, or a client's requests to one server; reliable and in order.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/design.md, section 6 ("answers return
by unicast"). It is an ordinary stream, with three differences:

- Its frames are addressed to the reader, so any switch can route them.
- A name that both ends derive from their incarnations replaces the topic in keys and reports. The header's incarnation
  is derived from that name: a later incarnation of either end shares nothing with it.
- There are no introductions. The writer knows its one reader by that reader's advertisement, and the reader expects
  number 1.

Where both ends ask for it, a session secret authenticates the stream instead of signatures
(``gdp/crypto/session_seal.py``). Such a stream has another name, so neither end takes one stream for the other.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Final, NamedTuple

from gdp.client.delivery import Ended
from gdp.client.identities import PublisherIdentity, ReaderIdentity, WriterIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPaths
from gdp.client.send_options import PublisherSettings
from gdp.client.sequence_numbers import SequenceState
from gdp.client.writer_proxy import WriterProxy, WriterProxyState
from gdp.crypto.session_seal import session_secret
from gdp.errors import DropReason
from gdp.frame.codec import Header
from gdp.intervals import FORGET_S
from gdp.limits import MTU_MIN_BYTES, PRIVATE_WAIT_BYTES
from gdp.message.reassembly import VerifiesDigest
from gdp.names import Name

# A second path by which frames of the reader came is taken to lead back to it for this time. It may be silent for long.
_SIGNED: Final = b"gdp-private-1"
_SESSION: Final = b"gdp-private-session-1"


class PeerIncarnation(NamedTuple):
    """A node from one start to the next."""

    name: Name
    incarnation: int


class Party(NamedTuple):
    """Incarnation of a connected node, and the X25519 key that its advertisement names.

    ``second_path_s``: when a frame of it last came by a second path. ``is_session``: a session secret authenticates the
    streams between it and this node.
    """

    incarnation_id: PeerIncarnation
    exchange: bytes
    second_path_s: float = float("-inf")
    is_session: bool = False


def private_name(service: Name, writer: PeerIncarnation, reader: PeerIncarnation, *, is_session: bool = False) -> Name:
    """Return the name of the stream from one party to another on a service's name; the reverse is another stream.

    Args:
        is_session: a session secret authenticates the stream; with signatures it is another stream.
    """
    ends = b"".join(name + incarnation.to_bytes(8, "big") for name, incarnation in (writer, reader))
    return Name(hashlib.sha256((_SESSION if is_session else _SIGNED) + service + ends).digest())


def private_incarnation(name: Name) -> int:
    """Return the source incarnation in the headers of a unicast stream."""
    return int.from_bytes(hashlib.sha256(b"gdp-private-incarnation-1" + name).digest()[:8], "big")


def _session_secrets(shared: bytes, secrets: Secrets, stream: Name) -> Secrets:
    return {epoch: session_secret(shared, secret, stream) for epoch, secret in secrets.items()}


class UnicastStream(Publisher):
    """Writer's end of a unicast stream.

    Args:
        writer: its source for all readers.
        mtu: smallest on the path; None if not known yet.
        past: of the same stream, if it was forgotten.
        settings: of the service.
        reader_paths: what may leave to each reader node; shared by all publishers of a participant.
    """

    def __init__(
        self,
        *,
        service: Name,
        writer: WriterIdentity,
        party: Party,
        secrets: Secrets,
        mtu: int | None,
        settings: PublisherSettings,
        past: SequenceState,
        reader_paths: ReaderPaths | None = None,
    ) -> None:
        self.reader = party.incarnation_id
        self._exchange = party.exchange
        self._touched_s = float("-inf")
        own = PeerIncarnation(writer.name, writer.incarnation)
        name = private_name(service, own, self.reader, is_session=party.is_session)
        source = replace(writer, incarnation=private_incarnation(name))
        self._shared: bytes | None = None  # with the reader, if a session secret authenticates the stream
        if party.is_session:
            self._shared = writer.control_keys.shared(party.exchange)
            source, secrets = replace(source, signer=None), _session_secrets(self._shared, secrets, name)
        super().__init__(
            topic=name,
            source=source,
            secrets=secrets,
            description=b"",
            settings=settings,
            past=past,
            address=self.reader.name,
            reader_paths=reader_paths,
        )
        self.tree_stands(MTU_MIN_BYTES if mtu is None else mtu)

    def note_second_path(self, came_s: float) -> None:
        """Note when a frame of the reader last came by a second path: copies to it go up the same tree."""
        self.governing_paths.second_until_s = came_s + FORGET_S

    def mark_in_use(self, now_s: float) -> None:
        """Note that the stream is in use; a silent reader becomes active."""
        self._touched_s = now_s
        self.acknowledgements.connect(*self.reader, self._exchange, now_s)

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Replace the service's secrets."""
        own = secrets if self._shared is None else _session_secrets(self._shared, secrets, self.topic)
        super().renew(own, now_s)

    def receive_acknack(self, header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> bool:
        """Process the reader's report, which reactivates a silent reader."""
        is_taken = super().receive_acknack(header, frame, now_s, waited_s)
        if is_taken:
            self.mark_in_use(now_s)
        return is_taken

    def is_idle(self, now_s: float) -> bool:
        """Return whether it may be forgotten."""
        return not self.readers and now_s - self._touched_s >= FORGET_S


class UnicastReceiver(WriterProxy):
    """Reader's end of a unicast stream.

    It is created for the first frame that arrives; frames lost before that are requested. Its messages are delivered
    once the description of its writer is known. Until then only few are accepted.

    Args:
        name: of the stream.
        public: the writer proxy of the same writer's stream to all.
        verifier: of the writer's signatures; None: a session secret authenticates the stream.
        secrets: of the service.
        before: where the same stream ended before, in this incarnation.
    """

    def __init__(
        self,
        *,
        name: Name,
        reader: ReaderIdentity,
        public: WriterProxy,
        verifier: VerifiesDigest | None,
        secrets: Secrets,
        now_s: float,
        before: Ended,
    ) -> None:
        self._public = public
        self._shared: bytes | None = None  # with the writer, if a session secret authenticates the stream
        if verifier is None:
            self._shared = reader.control_keys.shared(public.exchange)
            secrets = _session_secrets(self._shared, secrets, name)
        super().__init__(
            topic=name,
            reader=reader,
            publisher=PublisherIdentity(public.publisher, private_incarnation(name), verifier, public.exchange),
            secrets=secrets,
            now_s=now_s,
            before=before,
            introduces=False,
        )

    def receive(self, header: Header, frame: bytes, now_s: float, waited_s: float) -> None:
        """Process one DATA or HEARTBEAT frame of this writer; one that is refused is requested again."""
        if self._public.state is WriterProxyState.NEW and self.delivery.delivered_bytes >= PRIVATE_WAIT_BYTES:
            self._data.drops[DropReason.MEMORY_FULL] += 1
        else:
            super().receive(header, frame, now_s, waited_s)

    def renew(self, secrets: Secrets) -> None:
        """Replace the service's secrets."""
        super().renew(secrets if self._shared is None else _session_secrets(self._shared, secrets, self.topic))
