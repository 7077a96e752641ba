"""The one registry of frame kinds and flags.

Place: pure. Below 0x80 a frame goes end to end and the table forwards it; from 0x80 on it is for the neighbour itself
and every data plane hands it up.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final

__all__ = ["CONTROL_FROM", "ETHERTYPE", "VERSION", "Flag", "Kind"]

ETHERTYPE: Final = 0x88B5  # IEEE 802 local experimental EtherType 1; IEEE 802-2014, clause 9.2.4
VERSION: Final = 1
CONTROL_FROM: Final = 0x80


class Kind(IntEnum):
    """What a frame carries. Unknown kinds below 0x80 are forwarded; at the end they are dropped and counted."""

    DATA = 0x01  # a sealed message part, publisher to readers
    HEARTBEAT = 0x02  # sealed: what a publisher still holds, and the topic's description
    ACKNACK = 0x03  # sealed: what a reader has and lacks, to the publisher
    INTRODUCTION = 0x04  # sealed: who a reader is and its key for reports, to the publisher
    RIB_REQUEST = 0x10  # a statement to a RIB
    RIB_ANSWER = 0x11  # a statement from a RIB
    RELOCATE = 0x12  # a statement of a node's new switch to its former one
    ECHO_REQUEST = 0x20
    ECHO_REPLY = 0x21
    HELLO = 0x80  # to the neighbour: who I am
    LINK_STATE = 0x81
    JOIN = 0x82  # to the neighbour: send me this tree
    LEAVE = 0x83
    ADVERTISE = 0x84  # an attached node's claim, to its switch
    WITHDRAW = 0x85
    ADVERTISE_ACK = 0x86  # the switch's answer to an attached node: taken, or refused and why
    REVOKE = 0x87  # to the neighbour, who passes it on: this certificate no longer counts
    KEEPALIVE = 0x88  # to a neighbour that is up: I am still here; no statement, but a tag by a key of both sessions
    REDIRECT = 0x89  # to the neighbour whose frames came here: where the node is now
    WHERE = 0x8A  # to the neighbour whose frame came here, while no RIB answers: where is that node?
    COOKIE = 0x8B  # to whoever said hello: too many do, show this before your signature is verified; no statement
    REVOKED = 0x8C  # between neighbours: which revocations each keeps, and those that the other lacks


class Flag(IntFlag):
    """Set once by the source; part of what is authenticated."""

    NONE = 0
    LAST = 0x01  # the last part, which carries the signature
    RELIABLE = 0x02  # readers ask for what they miss
    BUNDLE = 0x04  # several messages under one seal
    ALL_REPLICAS = 0x08
    LATCHED = 0x10  # late joiners want it too
    URGENT = 0x20  # goes before all that is not, wherever frames queue
