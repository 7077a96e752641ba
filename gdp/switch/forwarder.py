"""Forwarding decision: the reference that every data plane must match.

Sans-I/O. Data planes are tested against it, and call it for any unusual frame. Source: docs/explanation/design.md,
sections 3 and 7. The order of the checks:

1. shorter than an Ethernet and a GDP header: drop, truncated; another EtherType or version: drop;
2. a kind from 0x80 on is for the neighbour itself: punt;
3. hops left 0 or 1: drop, for it may not leave again, but punt a diagnostic request; a payload longer than the received
   bytes: drop, truncated;
4. look up destination and source, then destination alone; a miss: punt; an entry whose frames come from other sides:
   drop, wrong side; an entry without hops: drop, no route. A copy for the second path has a key of its own, the
   destination with its last bit inverted; a miss is a drop, because the first copy travels anyway;
5. one copy to every hop, or to its alternate while the hop's port is down; a copy to a port that is down, or whose link
   is too narrow, is dropped alone, as is one whose hop has a lower pace than the frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from gdp.errors import DropReason
from gdp.frame.codec import (
    CONTROL_FROM,
    DESTINATION_AT,
    ETHER_BYTES,
    ETHERTYPE,
    HEADER_BYTES,
    HOPS_AT,
    HOPS_MASK,
    KIND_AT,
    OVERHEAD_BYTES,
    PACE_AT,
    SECOND_PATH,
    VERSION,
    Kind,
    second_path_key,
)
from gdp.names import NAME_BYTES
from gdp.switch.table import MACS_BYTES, Hop, Hops, Paces, is_side

_NO_SIDES: Final[Mapping[bytes, int]] = {}
_NO_PACES: Final[Mapping[bytes, Paces]] = {}
_ETHERTYPE: Final = ETHERTYPE.to_bytes(2, "big")
_KIND: Final = ETHER_BYTES + KIND_AT
_HOPS: Final = ETHER_BYTES + HOPS_AT
_LENGTH: Final = ETHER_BYTES + 6
_PACE: Final = ETHER_BYTES + PACE_AT
_DESTINATION: Final = ETHER_BYTES + DESTINATION_AT


class Drop(NamedTuple):
    """The frame is dropped."""

    reason: DropReason


class Punt(NamedTuple):
    """The frame goes to the control plane: it is a neighbour's statement, or its destination has no entry."""


class Forward(NamedTuple):
    """Copies to send, and the reasons of those that are lost."""

    hops: tuple[Hop, ...]
    lost: tuple[DropReason, ...] = ()


Decision = Drop | Punt | Forward
PUNT: Final = Punt()


def decide(
    frame: bytes | bytearray | memoryview,
    entries: Mapping[bytes, Hops],
    mtus: Mapping[int, int],
    sides: Mapping[bytes, int] = _NO_SIDES,
    port: int = 0,
    paces: Mapping[bytes, Paces] = _NO_PACES,
) -> Decision:
    """Return the decision for a frame. Any bytes get a decision; nothing is raised.

    Args:
        frame: from the Ethernet header on, padding included.
        mtus: port index to MTU (bytes after the Ethernet header) of the ports that are up.
        sides: the table's masks of ports that frames may come from.
        port: index of the port that this frame came from.
        paces: the table's paces of hops.
    """
    if len(frame) < OVERHEAD_BYTES:
        return Drop(DropReason.TRUNCATED)
    if frame[MACS_BYTES:ETHER_BYTES] != _ETHERTYPE:
        return Drop(DropReason.BAD_ETHERTYPE)
    if frame[ETHER_BYTES] != VERSION:
        return Drop(DropReason.BAD_VERSION)
    if frame[_KIND] >= CONTROL_FROM:
        return PUNT
    if frame[_HOPS] & HOPS_MASK <= 1:
        # this switch answers it; a second copy would make a second answer
        is_for_us = frame[_KIND] == Kind.DIAGNOSTIC_REQUEST and not frame[_HOPS] & SECOND_PATH
        return PUNT if is_for_us else Drop(DropReason.HOPS_EXPIRED)
    if len(frame) < OVERHEAD_BYTES + int.from_bytes(frame[_LENGTH : _LENGTH + 2], "big"):
        return Drop(DropReason.TRUNCATED)
    key = bytes(frame[_DESTINATION : ETHER_BYTES + HEADER_BYTES])
    is_second = bool(frame[_HOPS] & SECOND_PATH)
    if is_second:
        key = second_path_key(key)
    hops = entries.get(key)
    if hops is None:
        hops = entries.get(key[:NAME_BYTES])
    if hops is None:
        return Drop(DropReason.NO_SECOND_PATH) if is_second else PUNT
    if key in sides and not is_side(sides[key], port):
        return Drop(DropReason.WRONG_SIDE)
    if not hops:
        return Drop(DropReason.NO_ROUTE)
    thinned = 0
    if key in paces:
        fast = tuple(hop for hop, pace in zip(hops, paces[key], strict=True) if frame[_PACE] <= pace)
        hops, thinned = fast, len(hops) - len(fast)
    return _fit(hops, len(frame) - ETHER_BYTES, mtus, thinned)


def _fit(hops: Hops, size: int, mtus: Mapping[int, int], thinned: int) -> Forward:
    """Return the hops whose link takes ``size`` bytes after the Ethernet header, and the reasons of the others."""
    good: list[Hop] = []
    lost = [DropReason.THINNED] * thinned
    for hop in hops:
        exit_: Hop = hop[:2]
        mtu = mtus.get(exit_[0])
        if mtu is None and len(hop) > 2:
            exit_ = hop[2:]
            mtu = mtus.get(exit_[0])
        if mtu is None:
            lost.append(DropReason.PORT_DOWN)
        elif size > mtu:
            lost.append(DropReason.TOO_BIG)
        else:
            good.append(exit_)
    return Forward(tuple(good), tuple(lost))


def rewrite(frame: bytes | bytearray | memoryview, macs: bytes) -> bytes:
    """Return the copy that leaves: new addresses, one hop fewer, every other byte unchanged (padding too).

    Args:
        frame: from the Ethernet header on, for which ``decide`` returned ``Forward``.
        macs: destination and source MAC, 12 bytes.
    """
    copy = bytearray(frame)
    copy[:MACS_BYTES] = macs
    copy[_HOPS] -= 1
    return bytes(copy)
