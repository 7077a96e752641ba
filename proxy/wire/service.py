"""Service protocol: description of a service or an action, and the news of an action, inside sealed messages.

Sans-I/O. Every reader raises ``RemoteError`` (MALFORMED or BAD_VERSION) for any invalid bytes.

A service has one part, itself. An action has five, in this order: the services ``send_goal``, ``cancel_goal``
and ``get_result``, and the topics ``feedback`` and ``status``. Calls are in ``gdp/service/frames.py``; further, in
big-endian::

    news      version (1) | part (1) | stamp in ns (8)                        | body
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from gdp.crypto.schema import FLAG, FieldSet, Keyed, many
from gdp.errors import DropReason, StatementError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.service.frames import HEAD_MAX_BYTES, VERSION, read_head
from proxy.serial.channel import CHANNEL, CHANNEL_MAX_BYTES, SERVICE, Channel, Service
from proxy.serial.serializer import ENCODING, Encoding

PARTS_MAX: Final = 8
_NEWS: Final = struct.Struct("!BBQ")


class News(NamedTuple):
    """A message of an action's topics, from its server to all clients."""

    part: int
    stamp_ns: int
    body: bytes

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _NEWS.pack(VERSION, self.part, self.stamp_ns) + self.body

    @classmethod
    def from_wire(cls, wire: bytes) -> News:
        """Read the wire form."""
        part, stamp_ns = read_head(_NEWS, wire)
        return cls(part, stamp_ns, wire[_NEWS.size :])


def too_large(what: str, raw_bytes: int, max_bytes: int, body_bytes: int) -> str:
    """Return why a message cannot be sent: above its rule's limit, or encoded above the general one; else empty."""
    if raw_bytes > max_bytes:
        return f"{what} of {raw_bytes} bytes; the rule's max_bytes is {max_bytes}"
    if body_bytes > MESSAGE_MAX_BYTES - HEAD_MAX_BYTES:
        return f"{what} of {body_bytes} bytes as it travels; at most {MESSAGE_MAX_BYTES - HEAD_MAX_BYTES} can"
    return ""


@dataclass(frozen=True, slots=True)
class Exchange(FieldSet):
    """Description of a service or an action by one side, with its encoding.

    Args:
        topics: of an action; their parts follow the services'.
        is_leaving: the server answers what is under way, and then leaves; clients use others.
        is_ordered: it keeps state, and executes requests in one order only.
    """

    MAX_BYTES = 2 * PARTS_MAX * CHANNEL_MAX_BYTES
    encoding: Annotated[Encoding, Keyed("e", ENCODING)]
    services: Annotated[tuple[Service, ...], Keyed("s", many(SERVICE, PARTS_MAX, is_cut=False))]
    topics: Annotated[tuple[Channel, ...], Keyed("c", many(CHANNEL, PARTS_MAX, is_cut=False))] = ()
    is_leaving: Annotated[bool, Keyed("l", FLAG, absent=False, is_omitted=True)] = False
    is_ordered: Annotated[bool, Keyed("o", FLAG, absent=False, is_omitted=True)] = False

    def check(self) -> None:
        """Return if there is a service, and not too many parts. Raises ``StatementError``: MALFORMED."""
        if not self.services or len(self.services) + len(self.topics) > PARTS_MAX:
            raise StatementError(DropReason.MALFORMED, "a description of a service")
