"""From a far side's body to a local message: decoded by its definition, converted into ours.

Place: pure.
"""

from __future__ import annotations

from dataclasses import replace

from proxy.serial.channel import Channel, RosVersion
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding, Serializer
from proxy.serial.twin import Twin, twin_channel

__all__ = ["Incoming"]


class Incoming:
    """One kind of message, made ready.

    Args:
        source: as the far side describes it.
        target: as it is here.
        twin: converts; None where both sides have the same wire form.
    """

    __slots__ = ("_serializer", "_twin", "target")

    def __init__(self, source: Channel, encoding: Encoding, target: Channel, twin: Twin | None) -> None:
        self._serializer = Serializer(source, encoding)
        self._twin = twin
        self.target = target

    @classmethod
    def ready(cls, source: Channel, encoding: Encoding, known: Channel | None, ros: RosVersion) -> Incoming:
        """Return what turns ``source`` into something that this machine takes.

        Args:
            known: how this machine knows the type; None where it does not.
            ros: what is spoken here.

        Raises:
            DefinitionError: the definitions differ, or there is no such type in this ROS.
        """
        if source.ros != ros:
            target = twin_channel(source, ros) if known is None else known
            return cls(source, encoding, target, Twin(source, target))
        if known is None:
            return cls(source, encoding, source, None)
        if source.hash and known.hash and source.hash != known.hash:
            Twin(source, known)  # names the first difference
            if ros == 1:
                raise DefinitionError(f"md5 {source.hash} there, {known.hash} here")
        return cls(source, encoding, replace(known, qos=source.qos), None)

    def decode(self, body: bytes) -> bytes:
        """Return the local message of a body.

        Raises:
            RemoteError: it is not what its description says, or has no form here.
        """
        raw = self._serializer.decode(body)
        return raw if self._twin is None else self._twin.convert(raw)
