"""Opener of captured frames with topic secrets: the messages in them, and why others cannot be opened.

Sans-I/O; time comes in as ``now_s`` (the capture's seconds). Source: ``gdp/frame/spec.md``, sealing.

It serves displays, never delivery or trust: it verifies no signature, no advertisement and no right, and it reads
replays. What it keeps grows with the distinct frames of the capture.

An AckNack's key, and that of a stream with a session secret, are derived from X25519 keys of both ends. These exist in
the memory of their processes alone, so no file can open such frames.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, NamedTuple

from gdp.client.key_epochs import Openers
from gdp.client.unicast_stream import PeerIncarnation, private_incarnation, private_name
from gdp.crypto.cbor import decode as decode_cbor
from gdp.crypto.control_seal import ControlOpener, topic_of
from gdp.crypto.envelope import salt_of, seal_key
from gdp.errors import DropReason, EnvelopeError, FrameError, GdpError, RemoteError
from gdp.frame.codec import Flag, Header, Kind, decode
from gdp.limits import SEQUENCE_BYTES
from gdp.message.bundle import unpack
from gdp.message.frame_recovery import FrameRecovery
from gdp.message.heartbeat import Heartbeat
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.names import Name
from gdp.trust.grants import topic_secret

_DESCRIPTION_MAX_BYTES: Final = 4 << 20
_SEALED: Final = frozenset({Kind.DATA, Kind.HEARTBEAT, Kind.ACKNACK, Kind.INTRODUCTION, Kind.PARITY})
_NOTES: Final = frozenset({Kind.ACKNACK, Kind.INTRODUCTION})


class Outcome(Enum):
    """What became of a captured frame; the value is for people and for JSON."""

    OPENED = "opened"
    REPEATED = "repeated"  # the same part was captured before
    NOT_SEALED = "not sealed"
    MALFORMED = "malformed"
    NO_KEY = "no key of this name"
    NO_EPOCH = "no secret of its epoch"
    BAD_TAG = "altered, or sealed under another key"
    SESSION = "its key is in the memory of both ends (session secret)"
    ACK_NACK = "its key is in the memory of both ends (AckNack)"
    NO_INCARNATION = "no frame shows the incarnation of its destination"
    INCOMPLETE = "opened, but other parts of its message were not captured"

    @property
    def is_failure(self) -> bool:
        """Return whether a sealed frame gives no message for this reason."""
        return self not in (Outcome.OPENED, Outcome.REPEATED, Outcome.NOT_SEALED)


@dataclass(frozen=True, slots=True)
class CaptureKeys:
    """What opens frames.

    Args:
        secrets: of names, by epoch.
        masters: of owners; they give the secret of each epoch of each of their names.
    """

    secrets: Mapping[Name, Mapping[int, bytes]] = field(default_factory=dict, repr=False)
    masters: tuple[bytes, ...] = field(default=(), repr=False)

    def secrets_of(self, name: Name, epoch: int) -> Iterator[bytes]:
        """Yield each secret that may be that of a name's epoch."""
        known = self.secrets.get(name, {}).get(epoch)
        if known is not None:
            yield known
        for master in self.masters:
            yield topic_secret(master, name, epoch)


class OpenedMessage(NamedTuple):
    """One opened message, Heartbeat, introduction or parity body.

    Attributes:
        header: of its last captured part.
        topic: the name whose secret opened it; of a private stream that of its service.
        sequence: of a message, its sequence number; else 0.
        restored: parts that were not captured, and were restored from parity.
        encoding: of ROS messages, as their publisher describes them; "" where that is not known.
    """

    header: Header
    topic: Name
    sequence: int
    restored: int
    encoding: str
    body: bytes


class _Stream(NamedTuple):
    topic: Name  # whose secret it is
    bound: bytes  # the destination in its keys: the topic, or the name of a private stream


@dataclass(slots=True, kw_only=True)
class _Unfinished:
    parts: int
    salt: bytes
    topic: Name
    plain: dict[int, bytes] = field(default_factory=dict)
    restored: int = 0


_Place = tuple[int, bytes, int, bytes, int]  # kind, source, incarnation, destination, number


class CaptureOpener:
    """Opens the frames of one capture, which is read twice: ``observe`` each frame first, then ``handle`` each.

    Attributes:
        outcomes: how many frames had each outcome, by name.
    """

    def __init__(self, keys: CaptureKeys) -> None:
        self._keys = keys
        self._incarnations: defaultdict[bytes, set[int]] = defaultdict(set)
        self._topics = set(keys.secrets)
        self._streams: dict[tuple[bytes, int, bytes], _Stream | Outcome] = {}
        self._openers: dict[tuple[bytes, int, bytes, int, bytes], Openers] = {}
        self._quota = ReassemblyQuota()
        self._recoveries: dict[tuple[bytes, int, bytes], FrameRecovery] = {}
        self._seen: set[tuple[_Place, int]] = set()
        self._unfinished: dict[_Place, _Unfinished] = {}
        self._encodings: dict[tuple[bytes, bytes], str] = {}  # by source and topic
        self.outcomes: defaultdict[Name, Counter[Outcome]] = defaultdict(Counter)

    def observe(self, frame: bytes) -> None:
        """Note the incarnations that a frame (from the header on) shows: keys of private streams need them."""
        try:
            header = decode(frame)
        except FrameError:
            return
        if header.kind in _NOTES or header.kind in (Kind.DATA, Kind.HEARTBEAT):
            self._incarnations[header.source].add(header.incarnation)
        if header.kind in (Kind.DATA, Kind.HEARTBEAT) and self._keys.masters:
            self._topics.add(Name(header.destination))

    def handle(self, frame: bytes, now_s: float) -> list[OpenedMessage]:
        """Return what a frame (from the header on) completes; its outcome is counted."""
        try:
            header = decode(frame)
        except FrameError:
            self.outcomes[_name_of(frame)][Outcome.MALFORMED] += 1
            return []
        opened: list[OpenedMessage] = []
        name, outcome = self._open(header, frame, now_s, opened)
        self.outcomes[name][outcome] += 1
        return opened

    def count_unfinished(self) -> None:
        """Count the frames of unfinished messages as such, after the last frame."""
        for each in self._unfinished.values():
            count = len(each.plain) - each.restored
            self.outcomes[each.topic][Outcome.OPENED] -= count
            self.outcomes[each.topic][Outcome.INCOMPLETE] += count

    def forget_frames(self) -> None:
        """Begin the capture again, with what is known of publishers."""
        self._seen.clear()
        self._unfinished.clear()
        self._recoveries.clear()
        self._quota = ReassemblyQuota()
        self.outcomes.clear()

    def _open(self, header: Header, frame: bytes, now_s: float, opened: list[OpenedMessage]) -> tuple[Name, Outcome]:
        """Open one frame; return the name that it is about, and the outcome."""
        if header.kind not in _SEALED:
            return Name(header.destination), Outcome.NOT_SEALED
        if header.kind in _NOTES:
            return self._open_note(header, frame, opened)
        place = header.kind, header.source, header.incarnation, header.destination, header.number
        stream = self._stream(header)
        if isinstance(stream, Outcome):
            return Name(header.destination), stream
        if (place, header.part) in self._seen:
            return stream.topic, Outcome.REPEATED
        outcome = Outcome.NO_EPOCH if stream.topic in self._keys.secrets else Outcome.NO_KEY
        for secret in self._keys.secrets_of(stream.topic, header.epoch):
            try:
                if header.kind == Kind.PARITY:
                    opened += self._open_parity(header, frame, stream, secret, now_s)
                else:
                    opened += self._open_part(header, frame, stream, secret, now_s)
            except EnvelopeError as error:
                if error.reason is not DropReason.BAD_TAG:
                    return stream.topic, Outcome.MALFORMED
                if stream.topic in self._keys.secrets:
                    outcome = Outcome.BAD_TAG
                continue
            self._seen.add((place, header.part))
            return stream.topic, Outcome.OPENED
        return stream.topic, outcome

    def _stream(self, header: Header) -> _Stream | Outcome:
        """Return the stream of a frame of a message, or why none is known."""
        key = header.source, header.incarnation, header.destination
        found = self._streams.get(key)
        if found is None:
            found = self._streams[key] = self._find_stream(header)
        return found

    def _find_stream(self, header: Header) -> _Stream | Outcome:
        destination = Name(header.destination)
        if destination in self._keys.secrets:
            return _Stream(destination, destination)
        for service in self._topics:
            for writer in self._incarnations[header.source]:
                for reader in self._incarnations[header.destination]:
                    ends = PeerIncarnation(Name(header.source), writer), PeerIncarnation(destination, reader)
                    signed = private_name(service, *ends)
                    if private_incarnation(signed) == header.incarnation:
                        return _Stream(service, signed)
                    session = private_name(service, *ends, is_session=True)
                    if private_incarnation(session) == header.incarnation:
                        return Outcome.SESSION
        return _Stream(destination, destination) if self._keys.masters else Outcome.NO_KEY

    def _open_note(self, header: Header, frame: bytes, opened: list[OpenedMessage]) -> tuple[Name, Outcome]:
        try:
            topic = Name(topic_of(header, frame))
        except EnvelopeError:
            return Name(header.destination), Outcome.MALFORMED
        if header.kind == Kind.ACKNACK:
            return topic, Outcome.ACK_NACK
        outcome = Outcome.NO_EPOCH if topic in self._keys.secrets else Outcome.NO_KEY
        for secret in self._keys.secrets_of(topic, header.epoch):
            key = seal_key(secret, Kind.INTRODUCTION, header.source, header.incarnation, header.destination)
            incarnations = self._incarnations[header.destination]
            for incarnation in incarnations:
                try:
                    body = ControlOpener(key, topic, incarnation).open(header, frame)
                except EnvelopeError:
                    continue
                opened.append(OpenedMessage(header, topic, 0, 0, "", body))
                return topic, Outcome.OPENED
            if topic in self._keys.secrets:
                outcome = Outcome.BAD_TAG if incarnations else Outcome.NO_INCARNATION
        return topic, outcome

    def _open_parity(
        self, header: Header, frame: bytes, stream: _Stream, secret: bytes, now_s: float
    ) -> list[OpenedMessage]:
        """Return the body of a parity frame, and the messages that it completes."""
        body = self._openers_of(header, stream, secret).parity(header.epoch).open(header, frame)
        opened = [OpenedMessage(header, stream.topic, 0, 0, "", body)]
        try:
            restored = self._recovery(header).add_parity(header, body, now_s)
        except RemoteError:  # nothing lacks it, or what lacks it was not captured: the body is shown all the same
            return opened
        for each in restored:
            again = decode(each)
            place = again.kind, again.source, again.incarnation, again.destination, again.number
            if (place, again.part) in self._seen:
                continue
            try:
                opened += self._open_part(again, each, stream, secret, now_s, is_restored=True)
            except EnvelopeError:  # parity of an altered frame
                continue
            self._seen.add((place, again.part))
        return opened

    def _openers_of(self, header: Header, stream: _Stream, secret: bytes) -> Openers:
        key = header.source, header.incarnation, stream.bound, header.epoch, secret
        found = self._openers.get(key)
        if found is None:
            secrets, ends = {header.epoch: secret}, (Name(header.source), header.incarnation, Name(stream.bound))
            found = self._openers[key] = Openers(secrets, *ends, is_signed=True)
        return found

    def _recovery(self, header: Header) -> FrameRecovery:
        key = header.source, header.incarnation, header.destination
        found = self._recoveries.get(key)
        if found is None:
            found = self._recoveries[key] = FrameRecovery(header.source, self._quota)
        return found

    def _open_part(
        self, header: Header, frame: bytes, stream: _Stream, secret: bytes, now_s: float, *, is_restored: bool = False
    ) -> list[OpenedMessage]:
        """Open a part; return the messages that it completes."""
        openers = self._openers_of(header, stream, secret)
        plain, _, _ = openers.opener(Kind(header.kind), header.epoch).open(header, frame)
        place = header.kind, header.source, header.incarnation, header.destination, header.number
        salt, message = salt_of(frame), self._unfinished.get(place)
        if message is None or (message.parts, message.salt) != (header.parts, salt):
            message = self._unfinished[place] = _Unfinished(parts=header.parts, salt=salt, topic=stream.topic)
        message.plain[header.part] = plain
        message.restored += is_restored
        if len(message.plain) < message.parts:
            if header.kind == Kind.DATA:
                self._recovery(header).keep(header, frame, now_s)
            return []
        del self._unfinished[place]
        if header.kind == Kind.DATA:
            self._recovery(header).forget(header.number)
        whole = b"".join(message.plain[part] for part in range(message.parts))
        return self._messages(header, stream.topic, message.restored, whole)

    def _messages(self, header: Header, topic: Name, restored: int, whole: bytes) -> list[OpenedMessage]:
        publisher = header.source, bytes(topic)
        if header.kind == Kind.HEARTBEAT:
            encoding = _encoding_of(whole)
            if encoding:
                self._encodings[publisher] = encoding
            return [OpenedMessage(header, topic, 0, restored, "", whole)]
        encoding = self._encodings.get(publisher, "")
        sequence = int.from_bytes(whole[:SEQUENCE_BYTES], "big")
        bodies: Sequence[bytes] = [whole[SEQUENCE_BYTES:]]
        if header.flags & Flag.BUNDLE:
            try:
                bodies = unpack(bodies[0])
            except FrameError as error:
                raise EnvelopeError(error.reason, "bundle") from error
        return [OpenedMessage(header, topic, sequence + at, restored, encoding, body) for at, body in enumerate(bodies)]


def _encoding_of(heartbeat: bytes) -> str:
    """Return the encoding in the description of a Heartbeat; "" where it has none that says so."""
    try:
        description = Heartbeat.from_wire(heartbeat).description
        value = decode_cbor(description, _DESCRIPTION_MAX_BYTES) if description else None
    except GdpError:  # the description of a program that does not carry ROS messages
        return ""
    encoding = value.get("e") if isinstance(value, dict) else None
    return encoding if isinstance(encoding, str) else ""


def _name_of(frame: bytes) -> Name:
    """Return the destination of a malformed frame; zeros where it is too short for one."""
    return Name(frame[32:64] if len(frame) >= 64 else bytes(32))
