"""Registry of frame kinds and flags.

Sans-I/O. A frame of a kind below 0x80 goes end to end, and the table forwards it. From 0x80 on it is for the neighbour
itself, and every data plane punts it.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final

ETHERTYPE: Final = 0x88B5  # IEEE 802 local experimental EtherType 1; IEEE 802-2014, clause 9.2.4
VERSION: Final = 1
CONTROL_FROM: Final = 0x80


class Kind(IntEnum):
    """Kind of a frame's content. Unknown kinds below 0x80 are forwarded; at the end they are dropped and counted."""

    DATA = 0x01  # a sealed message fragment, publisher to readers
    HEARTBEAT = 0x02  # sealed: what a publisher still holds, and the topic's description
    ACKNACK = 0x03  # sealed: what a reader has and lacks, to the publisher
    INTRODUCTION = 0x04  # sealed: identity of a reader and its key for reports, to the publisher
    PARITY = 0x05  # sealed: a coded form of some frames of one message, which restores lost ones, publisher to readers
    RIB_REQUEST = 0x10  # a statement to a RIB
    RIB_ANSWER = 0x11  # a statement from a RIB
    RELOCATE = 0x12  # a statement of a node's new switch to its former one
    ECHO_REQUEST = 0x20
    ECHO_REPLY = 0x21
    DIAGNOSTIC_REQUEST = 0x22  # a statement to a member, or to the switch where its hops end
    DIAGNOSTIC_REPLY = 0x23  # a statement from there to the member that asked
    HELLO = 0x80  # to the neighbour: identity of the sender
    LINK_STATE = 0x81
    JOIN = 0x82  # to the neighbour: request for a tree
    LEAVE = 0x83
    ADVERTISE = 0x84  # an attached node's advertisement, to its switch
    WITHDRAW = 0x85
    ADVERTISE_ACK = 0x86  # the switch's acknowledgement to an attached node: accepted, or rejected with a reason
    REVOKE = 0x87  # to the neighbour, which forwards it: this certificate is revoked
    KEEPALIVE = 0x88  # to a neighbour that is up: sign of life; no statement, but a tag by a key of both sessions
    REDIRECT = 0x89  # to the neighbour whose frames came here: where the node is now
    WHERE = 0x8A  # to the neighbour whose frame came here, while no RIB answers: where is that node?
    # answer to a hello under load: the sender must prove this before its signature is verified; no statement
    COOKIE = 0x8B
    REVOKED = 0x8C  # between neighbours: which revocations each keeps, and those that the other lacks
    JOIN_REFRESH = 0x8D  # to the neighbour: which joins stand, and back: which of them are unknown
    PACE = 0x8E  # a reader to its switch: which messages of a publisher its branch gets


class Flag(IntFlag):
    """Flags of a frame, set once by the source; they are authenticated."""

    NONE = 0
    LAST = 0x01  # the last fragment, which carries the signature
    RELIABLE = 0x02  # readers request all that they miss, and wait for it
    BUNDLE = 0x04  # several messages under one seal
    ALL_REPLICAS = 0x08
    LATCHED = 0x10  # late joiners get it too
    URGENT = 0x20  # goes before frames without the flag, wherever frames queue
    PARITY = 0x40  # parity frames may follow the message's frames


class KeepaliveFlag(IntFlag):
    """Flags of a keepalive, its first byte after the header."""

    NONE = 0
    POLL = 1  # requests an answer at once
    FINAL = 2  # the answer to a poll
    HEARD = 4  # the sender receives the receiver's keepalives
