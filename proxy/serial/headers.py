"""Rewriter of headers in messages, whatever their type: coordinate frames, and stamps.

Sans-I/O. A type's definition shows where they are: frames are texts called ``frame_id`` or ``child_frame_id``, stamps
those of ``std_msgs/Header``. Source: std_msgs/Header, geometry_msgs/TransformStamped; REP 105.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, NamedTuple, TypeAlias

from gdp.errors import DropReason, RemoteError
from gdp.intervals import HOUR_S
from proxy.serial.channel import Channel
from proxy.serial.dialect import MisfitError
from proxy.serial.schema import Array, Number, Record, Sequence, Text, parse
from proxy.serial.serializer import native_codec

_FIELDS: Final = frozenset({"frame_id", "child_frame_id"})
_HEADER, _STAMP = "std_msgs/msg/Header", "stamp"
_COUNT: Final = struct.Struct("<I")
_TAIL_MIN: Final = 4_096  # bytes of a last array that are worth a copy less

Renamed: TypeAlias = "Callable[[bytes], bytes]"


class StampShift(NamedTuple):
    """How stamps are converted: ``by_ns`` is added to those of the clock that showed ``sent_ns``.

    A stamp further away than an hour is of another clock, such as that of a simulation, or of none, and stays.
    """

    by_ns: int
    sent_ns: int

    def moved(self, stamp: dict[str, int]) -> dict[str, int]:
        """Return a stamp by the other clock."""
        at_ns = stamp["sec"] * 10**9 + stamp["nanosec"]
        if abs(at_ns - self.sent_ns) > HOUR_S * 10**9:
            return stamp
        sec, nanosec = divmod(at_ns + self.by_ns, 10**9)
        return {"sec": sec, "nanosec": nanosec}


class HeaderRewriter:
    """Rewriter of one channel's messages.

    Args:
        renamed: what a frame is to be called; None: as it is.
        has_stamps: stamps are converted.

    Raises:
        DefinitionError: the channel has no usable definition, so its frames are not known.
    """

    __slots__ = ("_codec", "_places", "_renamed", "_ros", "_tail")

    def __init__(self, channel: Channel, renamed: Renamed | None, *, has_stamps: bool = False) -> None:
        record = parse(channel.type_name, channel.definition, channel.definition_format, channel.ros)
        self._codec = native_codec(channel)
        self._places = _places_of(record, _FIELDS if renamed else frozenset(), {}, has_stamps=has_stamps)
        self._renamed = renamed or bytes
        self._ros = channel.ros
        self._tail = _tail_of(record)

    def rewrite(self, raw: bytes, shift: StampShift) -> bytes:
        """Return a message with its frames renamed and its stamps moved; unchanged and unread if its type has none.

        Raises:
            RemoteError: the bytes are no message of the channel.
        """
        if not self._places:
            return raw
        try:
            tree = self._codec.to_tree(raw)
            self._places.rewrite(tree, self._renamed, shift)
            return self._joined(tree)
        except (MisfitError, struct.error) as error:
            raise RemoteError(DropReason.MALFORMED, f"header: {error}"[:200]) from error

    def _joined(self, tree: object) -> bytes:
        """Return the bytes of a tree; a long array at its end, as that of an image, is copied once."""
        name, width = self._tail
        tail = tree.get(name) if isinstance(tree, dict) else None
        if not isinstance(tree, dict) or not isinstance(tail, memoryview) or len(tail) < _TAIL_MIN:
            return self._codec.to_raw(tree)
        tree[name] = tail[:0]
        head = self._codec.to_raw(tree)[: -_COUNT.size] + _COUNT.pack(len(tail) // width)
        # Alignment counts from behind the four bytes of encapsulation.
        pad = -(len(head) - 4) % width if self._ros == 2 else 0
        return b"".join((head, bytes(pad), tail))


class _Places(NamedTuple):
    """Where frames and stamps of a record are: its own fields, and those of its records and lists of records."""

    fields: tuple[str, ...]
    stamps: tuple[str, ...]
    records: tuple[tuple[str, _Places], ...]
    lists: tuple[tuple[str, _Places], ...]

    def __bool__(self) -> bool:
        return any(map(bool, self[:]))

    def rewrite(self, tree: object, renamed: Renamed, shift: StampShift) -> None:
        """Rename the frames of a tree, and move its stamps.

        Raises:
            MisfitError: the tree is that of another type.
        """
        if not isinstance(tree, dict):
            raise MisfitError("not a message of this type")
        for name in self.fields:
            tree[name] = memoryview(renamed(bytes(tree[name])))
        for name in self.stamps:
            tree[name] = shift.moved(tree[name])
        for name, places in self.records:
            places.rewrite(tree[name], renamed, shift)
        for name, places in self.lists:
            for item in tree[name]:
                places.rewrite(item, renamed, shift)


def _places_of(record: Record, texts: frozenset[str], done: dict[int, _Places], *, has_stamps: bool) -> _Places:
    if id(record) not in done:
        fields = tuple(name for name, kind in record.fields if name in texts and kind == Text(wide=False))
        is_header = has_stamps and record.name == _HEADER
        inner = [
            (name, isinstance(kind, Array | Sequence), places)
            for name, kind in record.fields
            if isinstance(item := kind.item if isinstance(kind, Array | Sequence) else kind, Record)
            and (places := _places_of(item, texts, done, has_stamps=has_stamps))
        ]
        records = tuple((name, places) for name, is_list, places in inner if not is_list)
        lists = tuple((name, places) for name, is_list, places in inner if is_list)
        done[id(record)] = _Places(fields, (_STAMP,) if is_header else (), records, lists)
    return done[id(record)]


def _tail_of(record: Record) -> tuple[str, int]:
    """Return name and item size of a last field that is a sequence of numbers; an empty name: it is none."""
    name, kind = record.fields[-1] if record.fields else ("", None)
    if isinstance(kind, Sequence) and isinstance(kind.item, Number):
        return name, kind.item.size
    return "", 1
