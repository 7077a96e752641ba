"""Service description for a caller: its request and its response, each described like a topic's messages.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cbor2

from gdp.errors import DropReason, RemoteError
from proxy.serial.cbor_bounds import check_bounds
from proxy.serial.channel import CHANNEL_MAX_BYTES, Channel, RosVersion

__all__ = ["Service"]

_ITEMS_MAX: Final = 16
_WIRE_MAX_BYTES: Final = 2 * CHANNEL_MAX_BYTES + 4_096


@dataclass(frozen=True, slots=True)
class Service:
    """A service.

    Args:
        type_name: as ROS 2 writes it (``std_srvs/srv/SetBool``), for ROS 1 too.
        hash: md5 sum of the ROS 1 service, ``RIHS01_...`` for ROS 2; empty where unknown.
        request: of type ``std_srvs/srv/SetBool_Request``, for ROS 1 too; its ``topic`` is the service's name.
        response: of type ``std_srvs/srv/SetBool_Response``.
    """

    name: str
    type_name: str
    hash: str
    request: Channel
    response: Channel

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version of the messages' wire form."""
        return self.request.ros

    def to_wire(self) -> bytes:
        """Return the bounded CBOR form.

        Raises:
            LocalError: a part is longer than a peer would accept.
        """
        fields = {
            "n": self.name,
            "t": self.type_name,
            "h": self.hash,
            "q": self.request.to_wire(),
            "r": self.response.to_wire(),
        }
        return cbor2.dumps(fields, canonical=True)

    @classmethod
    def from_wire(cls, wire: bytes) -> Service:
        """Parse the form that ``to_wire`` writes.

        Raises:
            RemoteError: any other bytes.
        """
        if len(wire) > _WIRE_MAX_BYTES:
            raise RemoteError(DropReason.MALFORMED, "a service description that is too long")
        try:
            check_bounds(wire, _ITEMS_MAX)
            fields = cbor2.loads(wire)
        except (cbor2.CBORDecodeError, RecursionError, ValueError, TypeError, OverflowError) as error:
            raise RemoteError(DropReason.MALFORMED, "a service description that is not CBOR") from error
        match fields:
            case {"n": str(name), "t": str(type_name), "h": str(md5), "q": bytes(request), "r": bytes(response)} if (
                max(len(name), len(type_name), len(md5)) <= 1_024
            ):
                service = cls(name, type_name, md5, Channel.from_wire(request), Channel.from_wire(response))
                if service.request.ros == service.response.ros:
                    return service
        raise RemoteError(DropReason.MALFORMED, "a service description")
