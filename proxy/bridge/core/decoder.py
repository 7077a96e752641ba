"""Message decoder: from a remote body to a local message, by the remote definition, converted into the local one.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import replace

from proxy.bridge.core.reduction import Restore
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding, Serializer

__all__ = ["MessageDecoder"]


class MessageDecoder:
    """Decoder of one message type.

    Args:
        source: description by the remote side.
        twin: converter; None where both sides have the same wire form.
    """

    __slots__ = ("_converter", "_serializer", "target")

    def __init__(
        self, source: Channel, encoding: Encoding, target: Channel, converter: MessageConverter | None
    ) -> None:
        self._serializer = Serializer(source, encoding)
        self._converter = converter
        self.target = target

    @classmethod
    def ready(cls, source: Channel, encoding: Encoding, known: Channel | None, ros: RosVersion) -> MessageDecoder:
        """Return the decoder that turns ``source`` into messages of this machine.

        Args:
            known: this machine's description of the type; None where it has none.

        Raises:
            DefinitionError: the definitions differ, or this ROS has no such type.
        """
        if source.ros != ros:
            target = translated_channel(source, ros) if known is None else known
            return cls(source, encoding, target, MessageConverter(source, target))
        if known is None:
            return cls(source, encoding, source, None)
        if source.hash and known.hash and source.hash != known.hash:
            MessageConverter(source, known)  # names the first difference
            if ros == 1:
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
