"""Message decoder: from a remote body to a local message, by the remote definition, converted into the local one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from proxy.bridge.core.reduction import Restore
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding, Serializer

if TYPE_CHECKING:  # most proxies convert nothing
    from proxy.serial.converter import MessageConverter


class MessageDecoder:
    """Decoder of one message type.

    Args:
        source: description by the remote side.
        converter: None where both sides have the same wire form.

    Attributes:
        differences: the fields that one side lacks, as texts.
    """

    __slots__ = ("_converter", "_serializer", "differences", "target")

    def __init__(
        self, source: Channel, encoding: Encoding, target: Channel, converter: MessageConverter | None
    ) -> None:
        self._serializer = Serializer(source, encoding)
        self._converter = converter
        self.differences = () if converter is None else converter.differences
        self.target = target

    @classmethod
    def ready(
        cls, source: Channel, encoding: Encoding, known: Channel | None, ros: RosVersion, *, is_strict: bool = True
    ) -> MessageDecoder:
        """Return the decoder that turns ``source`` into messages of this machine.

        Args:
            known: this machine's description of the type; None where it has none.
            is_strict: as ``MessageConverter``.

        Raises:
            DefinitionError: the definitions differ, or this ROS has no such type.
        """
        if source.ros != ros:
            from proxy.serial.converter import MessageConverter, translated_channel

            target = translated_channel(source, ros) if known is None else known
            return cls(source, encoding, target, MessageConverter(source, target, is_strict=is_strict))
        if known is None:
            return cls(source, encoding, source, None)
        if source.hash and known.hash and source.hash != known.hash:
            from proxy.serial.converter import MessageConverter

            converter = MessageConverter(source, known, is_strict=is_strict)  # or its error names the first difference
            if converter.differences:
                return cls(source, encoding, replace(known, qos=source.qos), converter)
            if ros == 1 and is_strict:
                raise DefinitionError(f"md5 {source.hash} there, {known.hash} here")
        return cls(source, encoding, replace(known, qos=source.qos), None)

    def decode(self, body: bytes, restore: Restore | None = None) -> bytes:
        """Return the local message of a body.

        Args:
            restore: what the remote message as ROS wrote it has to pass through, as ``MessageExpander`` says.

        Raises:
            RemoteError: it does not fit its description, or has no local form.
        """
        raw = self._serializer.decode(body)
        if restore is not None:
            raw = restore(raw)
        return raw if self._converter is None else self._converter.convert(raw)


def differences_of(decoders: Iterable[MessageDecoder]) -> str:
    """Return the fields that one side lacks as one text; empty if there are none."""
    found = dict.fromkeys(each for decoder in decoders for each in decoder.differences)
    return f"messages are converted: {'; '.join(found)}" if found else ""
