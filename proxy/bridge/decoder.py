"""From a far side's body to a local message: decoded by its definition, converted into ours.

Place: pure.
"""

from __future__ import annotations

from dataclasses import replace

from proxy.serial.channel import Channel, RosVersion
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding, Serializer

__all__ = ["MessageDecoder"]


class MessageDecoder:
    """One kind of message, made ready.

    Args:
        source: as the far side describes it.
        target: as it is here.
        twin: converts; None where both sides have the same wire form.
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
        """Return what turns ``source`` into something that this machine takes.

        Args:
            known: how this machine knows the type; None where it does not.
            ros: what is spoken here.

        Raises:
            DefinitionError: the definitions differ, or there is no such type in this ROS.
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

    def decode(self, body: bytes) -> bytes:
        """Return the local message of a body.

        Raises:
            RemoteError: it is not what its description says, or has no form here.
        """
        raw = self._serializer.decode(body)
        return raw if self._converter is None else self._converter.convert(raw)
