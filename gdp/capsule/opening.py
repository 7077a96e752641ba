"""Opening of a capsule's records: the writer's signature is verified without, the content is read with the topic's
secret.

Sans-I/O. The code that opens live messages opens these: the bytes are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from gdp.burst.cipher import BODY_AT
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.record import Record, RecordType
from gdp.capsule.windows import Mark
from gdp.client.key_epochs import Openers, Secrets
from gdp.crypto.envelope import SIGNATURE_BYTES, digest_of
from gdp.crypto.keys import PublicKey
from gdp.errors import DropReason, RemoteError
from gdp.frame.codec import HEADER_BYTES, Flag, Header, Kind, decode
from gdp.limits import SEQUENCE_BYTES
from gdp.message.bundle import unpack
from gdp.message.heartbeat import Heartbeat
from gdp.names import Name


class Kept(NamedTuple):
    """One message of a capsule, opened.

    Attributes:
        incarnation: of the writer's process; each topic's sequence numbers begin again with it.
        time_ns: when it was appended.
        description: what its publisher said of its messages.
    """

    topic: Name
    incarnation: int
    sequence: int
    time_ns: int
    message: bytes
    description: bytes


def verify_frames(frames: Sequence[bytes], key: PublicKey) -> Header:
    """Return the header of a message's last frame if all frames are there, and the writer signed them.

    Raises:
        RemoteError: BAD_PARTS, MALFORMED or BAD_SIGNATURE.
    """
    if not frames:
        raise RemoteError(DropReason.BAD_PARTS, "a message without frames")
    running = digest_of(frames[0])
    shared = running.digest()  # of what all frames state alike
    for part, frame in enumerate(frames):
        header = decode(frame)
        is_last = part == len(frames) - 1
        place = header.part, header.parts, HEADER_BYTES + header.length
        if place != (part, len(frames), len(frame)) or digest_of(frame).digest() != shared:
            raise RemoteError(DropReason.BAD_PARTS, "frames of another message")
        running.update(frame[BODY_AT : len(frame) - SIGNATURE_BYTES if is_last else len(frame)])
    key.verify_digest(frames[-1][-SIGNATURE_BYTES:], running.digest())
    return header


class NamedMark(NamedTuple):
    """A mark, opened: when it was made, what it is called, and its window."""

    time_ns: int
    name: str
    window: Mark


class CapsuleOpener:
    """Opens the records of one capsule, in order.

    Args:
        secrets: of the topics that are read, by epoch.

    Attributes:
        closed: records of epochs without a secret here, by epoch.
        descriptions: the latest, by topic.
        marks: those that were opened.
    """

    def __init__(self, descriptor: Descriptor, secrets: Mapping[Name, Secrets]) -> None:
        self._topics, self._writer, self._key = set(descriptor.topics), descriptor.writer.name, descriptor.key
        self._secrets = secrets
        self._openers: dict[tuple[Name, int], Openers] = {}  # by topic and incarnation
        self.closed: dict[int, int] = {}
        self.descriptions: dict[Name, bytes] = {}
        self.marks: list[NamedMark] = []

    def open(self, record: Record) -> list[Kept]:
        """Return the messages of a record; none of another kind or topic, or without the epoch's secret.

        Raises:
            RemoteError: it is not the writer's, of a topic that is not the capsule's, or altered.
        """
        if record.type is RecordType.CHECKPOINT:
            return []
        return [each for frames in record.sealed for each in self._open(record, frames)]

    def _open(self, record: Record, frames: Sequence[bytes]) -> list[Kept]:
        header = verify_frames(frames, self._key)
        topic = Name(header.destination)
        if header.source != self._writer or topic not in self._topics:
            raise RemoteError(DropReason.WRONG_NAME, "a message of another topic or writer")
        secrets = self._secrets.get(topic)
        if secrets is None:
            return []
        if header.epoch not in secrets:
            self.closed[header.epoch] = self.closed.get(header.epoch, 0) + 1
            return []
        openers = self._openers.get((topic, header.incarnation))
        if openers is None:
            ends = self._writer, header.incarnation, topic
            openers = self._openers[topic, header.incarnation] = Openers(secrets, *ends, is_signed=True)
        is_description = record.type is RecordType.DESCRIPTION
        opener = openers.opener(Kind.HEARTBEAT if is_description else Kind.DATA, header.epoch)
        plain = b"".join([opener.open(decode(frame), frame)[0] for frame in frames])
        if is_description:
            self.descriptions[topic] = Heartbeat.from_wire(plain).description
            return []
        if record.type is RecordType.MARK:
            name = plain[SEQUENCE_BYTES:].decode(errors="replace")
            mark = NamedMark(int.from_bytes(plain[:SEQUENCE_BYTES], "big"), name, Mark.from_record(record))
            if mark not in self.marks[-1:]:  # as another topic has it
                self.marks.append(mark)
            return []
        sequence, body = int.from_bytes(plain[:SEQUENCE_BYTES], "big"), plain[SEQUENCE_BYTES:]
        messages = unpack(body) if header.flags & Flag.BUNDLE else [body]
        return [
            Kept(topic, header.incarnation, sequence + at, record.time_ns, message, self.descriptions.get(topic, b""))
            for at, message in enumerate(messages)
        ]
