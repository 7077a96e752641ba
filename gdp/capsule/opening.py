"""Opening of a capsule's records: the writer's signature is verified without, the content is read with the topic's
secret.

Sans-I/O. The code that opens live messages opens these: the bytes are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from gdp.burst.cipher import BODY_AT
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
        incarnation: of the writer's process; sequence numbers begin again with each.
        time_ns: when it was appended.
        description: what its publisher said of its messages.
    """

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
        secrets: of the topic, by epoch.
        key: the writer's.

    Attributes:
        closed: records of epochs without a secret here, by epoch.
        description: the latest.
        marks: those that were opened.
    """

    def __init__(self, topic: Name, writer: Name, secrets: Secrets, key: PublicKey) -> None:
        self._topic, self._writer, self._key = topic, writer, key
        self._secrets = secrets
        self._openers: dict[int, Openers] = {}  # by incarnation
        self.closed: dict[int, int] = {}
        self.description = b""
        self.marks: list[NamedMark] = []

    def open(self, record: Record) -> list[Kept]:
        """Return the messages of a record; none of another kind, or without the epoch's secret.

        Raises:
            RemoteError: it is not the writer's, of another topic, or altered.
        """
        if record.type is RecordType.CHECKPOINT:
            return []
        frames = record.sealed
        header = verify_frames(frames, self._key)
        if header.source != self._writer or header.destination != self._topic:
            raise RemoteError(DropReason.WRONG_NAME, "a message of another topic or writer")
        if header.epoch not in self._secrets:
            self.closed[header.epoch] = self.closed.get(header.epoch, 0) + 1
            return []
        openers = self._openers.get(header.incarnation)
        if openers is None:
            ends = self._writer, header.incarnation, self._topic
            openers = self._openers[header.incarnation] = Openers(self._secrets, *ends, is_signed=True)
        is_description = record.type is RecordType.DESCRIPTION
        opener = openers.opener(Kind.HEARTBEAT if is_description else Kind.DATA, header.epoch)
        plain = b"".join([opener.open(decode(frame), frame)[0] for frame in frames])
        if is_description:
            self.description = Heartbeat.from_wire(plain).description
            return []
        if record.type is RecordType.MARK:
            name = plain[SEQUENCE_BYTES:].decode(errors="replace")
            self.marks.append(NamedMark(int.from_bytes(plain[:SEQUENCE_BYTES], "big"), name, Mark.from_record(record)))
            return []
        sequence, body = int.from_bytes(plain[:SEQUENCE_BYTES], "big"), plain[SEQUENCE_BYTES:]
        messages = unpack(body) if header.flags & Flag.BUNDLE else [body]
        return [
            Kept(header.incarnation, sequence + at, record.time_ns, message, self.description)
            for at, message in enumerate(messages)
        ]
