"""Converter of a topic's messages between ROS 1 and ROS 2: the description and the bytes in the other ROS.

Sans-I/O. A message is read with one definition and written with the other; no type is known beforehand. The allowed
differences are in ``type_match``; ``docs/reference/serialisation.md`` has them as a table.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import replace
from typing import Final

from gdp.errors import DropReason, RemoteError
from proxy.serial.channel import Channel, Qos, RosVersion
from proxy.serial.dialect import MisfitError
from proxy.serial.native_dialect import NativeDialect
from proxy.serial.schema import Array, DefinitionError, Record, Sequence, Text, Type, default_values, msg_name, parse
from proxy.serial.serializer import Codec
from proxy.serial.type_match import Amend, Side, match
from proxy.serial.type_translation import bounds_of, md5_text, retyped, rihs01, text_of, types_of

_NATIVE: Final = NativeDialect()
# QoS equivalent of a latching ROS 1 publisher: every late joiner gets its last message.
_LATCHED: Final = Qos(depth=1, reliability="reliable", durability="transient_local")


def translated_channel(channel: Channel, ros: RosVersion) -> Channel:
    """Return the channel in ROS ``ros``: the same topic and type name, its own definition, hash and QoS.

    Raises:
        DefinitionError: there is no definition, or a field has no form there; the text names it.
    """
    if channel.ros == ros:
        return channel
    name = msg_name(channel.type_name, channel.definition_format)
    record = _record(channel)
    if ros == 1 and (path := _wide_in(record, "", set())):
        raise DefinitionError(f"{path}: wstring has no form in ROS 1")
    types = retyped(types_of(channel), ros)
    if ros == 1:
        digest = hashlib.md5(md5_text(name, types).encode(), usedforsecurity=False).hexdigest()
    else:
        digest = rihs01(channel.type_name, types | {channel.type_name: types[name]})
    latched = channel.latched or any(profile.durability == "transient_local" for profile in channel.qos)
    return replace(
        channel,
        ros=ros,
        hash=digest,
        definition=text_of(name, types, ros),
        definition_format="msg",
        qos=(_LATCHED,) if latched and ros == 2 else (),
        latched=latched,
        callerid=None,
    )


class MessageConverter:
    """Converter from one channel to another, of either ROS.

    Between channels of the same ROS and of equal definition every message is returned unchanged and unread.

    Args:
        is_strict: both definitions have the same fields; else those that one lacks get their default, or are dropped.

    Raises:
        DefinitionError: a definition is missing or cannot be read, or the two do not match field by field; the text
            names the first difference, such as ``pose.position.x: float64 there, float32 here``.

    Attributes:
        differences: the fields that one side lacks, as texts.
    """

    __slots__ = ("_amend", "_read", "_write", "differences", "source", "target")

    def __init__(self, source: Channel, target: Channel, *, is_strict: bool = True) -> None:
        self.differences: tuple[str, ...] = ()
        self.source = source
        self.target = target
        self._read: Codec | None = None
        self._write: Codec | None = None
        self._amend: Amend | None = None
        if _same_hash(source, target):
            return
        sides = (_side(each, is_strict=is_strict) for each in (source, target))
        pair = match(*sides, is_strict=is_strict)
        self.differences = pair.differences
        self._amend = pair.amend
        if source.ros == target.ros and pair.amend is None and not pair.differences:
            return
        self._read = Codec(pair.read, source.ros, _NATIVE, None)
        self._write = Codec(pair.write, target.ros, _NATIVE, None)

    def convert(self, raw: bytes) -> bytes:
        """Return the message in the target's wire form: ROS 1, or little-endian CDR with zero padding.

        Raises:
            RemoteError: the bytes are no message of the source, or hold a value that the target has no form for (a time
                out of its range, a string or sequence beyond its bound).
        """
        if self._read is None or self._write is None:
            return raw
        try:
            tree = self._read.to_tree(raw)
            if tree is None:
                raise MisfitError("not a message of this type")
            if self._amend is not None:
                self._amend(tree)
            return self._write.to_raw(tree)
        except (MisfitError, struct.error) as error:
            raise RemoteError(DropReason.MALFORMED, f"{self.source.type_name}: {error}"[:200]) from error


def _same_hash(source: Channel, target: Channel) -> bool:
    """Return whether the hashes of two channels without comparable definitions prove one type."""
    if source.definition_format and target.definition_format:
        return False
    return source.ros == target.ros and bool(source.hash) and source.hash == target.hash


def _record(channel: Channel) -> Record:
    return parse(channel.type_name, channel.definition, channel.definition_format, channel.ros)


def _side(channel: Channel, *, is_strict: bool) -> Side:
    bounds = bounds_of(types_of(channel)) if channel.ros == 2 else {}
    defaults = {} if is_strict else default_values(channel.type_name, channel.definition, channel.definition_format)
    return Side(_record(channel), channel.ros, bounds, defaults)


def _wide_in(kind: Type, path: str, seen: set[int]) -> str:
    """Return the path of the first wide string, empty if there is none."""
    if isinstance(kind, Array | Sequence):
        return _wide_in(kind.item, f"{path}[]", seen)
    if isinstance(kind, Text):
        return path if kind.wide else ""
    if not isinstance(kind, Record) or id(kind) in seen:
        return ""
    seen.add(id(kind))
    fields = (_wide_in(field, f"{path}.{name}" if path else name, seen) for name, field in kind.fields)
    return next(filter(None, fields), "")
