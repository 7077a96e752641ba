"""Service description for a caller: its request and its response, each described like a topic's messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.schema import OCTETS, FieldSet, Keyed, mapped
from gdp.errors import DropReason, StatementError
from proxy.serial.channel import CHANNEL, CHANNEL_MAX_BYTES, TEXT, Channel, RosVersion


@dataclass(frozen=True, slots=True)
class Service(FieldSet):
    """A service.

    Args:
        type_name: as ROS 2 writes it (``std_srvs/srv/SetBool``), for ROS 1 too.
        hash: md5 sum of the ROS 1 service, ``RIHS01_...`` for ROS 2; empty where unknown.
        request: of type ``std_srvs/srv/SetBool_Request``, for ROS 1 too; its ``topic`` is the service's name.
        response: of type ``std_srvs/srv/SetBool_Response``.
    """

    MAX_BYTES = 2 * CHANNEL_MAX_BYTES + 4_096
    name: Annotated[str, Keyed("n", TEXT)]
    type_name: Annotated[str, Keyed("t", TEXT)]
    hash: Annotated[str, Keyed("h", TEXT)]
    request: Annotated[Channel, Keyed("q", CHANNEL)]
    response: Annotated[Channel, Keyed("r", CHANNEL)]

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version of the messages' wire form."""
        return self.request.ros

    def check(self) -> None:
        """Return if both parts are of one ROS. Raises ``StatementError``: MALFORMED."""
        if self.request.ros != self.response.ros:
            raise StatementError(DropReason.MALFORMED, "a service description")


SERVICE: Final = mapped(OCTETS, Service.from_cbor, Service.to_cbor)
