"""Error tree of the project, and the reasons for which a frame may be dropped.

Sans-I/O; imports nothing of this project. An error states what the caller may do. A ``LocalError`` is the fault of our
caller. A ``RemoteError`` is the fault of a peer: drop, count, carry on. A ``ConfigError`` names the location in the
file. After a ``StoreError`` the caller may try again.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class DropReason(IntEnum):
    """Reason why a frame, a message or a statement was dropped.

    The value is at once the metric label, the word in a trace and the counter index of a data plane. New reasons are
    only ever appended.
    """

    # the frame itself
    TRUNCATED = 0  # fewer bytes than the header or the payload length requires
    BAD_VERSION = 1
    BAD_ETHERTYPE = 2
    UNKNOWN_KIND = 3
    BAD_PARTS = 4  # part >= parts, no parts, or more than the limit
    HOPS_EXPIRED = 5
    TOO_BIG = 6  # longer than the MTU of the next link
    # forwarding
    NO_ROUTE = 7
    NO_READER = 8  # a topic without readers
    PORT_DOWN = 9
    PORT_FULL = 10  # the device's queue refused it
    PENDING_FULL = 11
    PENDING_EXPIRED = 12
    # the message
    BAD_TAG = 13  # AES-GCM refused the fragment
    BAD_SIGNATURE = 14
    REPLAYED = 15
    LATE = 16  # a fragment of a finished or abandoned message; a message too old to steer by
    DUPLICATE = 17
    WRONG_INCARNATION = 18
    UNKNOWN_EPOCH = 19
    NO_KEY = 20
    MEMORY_FULL = 21
    ABANDONED = 22  # the timeout expired before the last fragment came
    # the statement
    MALFORMED = 23  # not the expected CBOR
    WRONG_NAME = 24  # the name differs from its hash
    WRONG_DOMAIN = 25  # the signer's domain is not trusted here
    BAD_CERTIFICATE = 26
    EXPIRED = 27
    STALE = 28  # a sequence number that is not newer
    NOT_DELEGATED = 29
    LEASE_BOUNDS = 30
    QUOTA = 31
    UNKNOWN_SENDER = 32  # not a neighbour (yet)
    NOT_FOR_US = 33
    REVOKED = 34
    UNAVAILABLE = 35  # a RIB's store did not respond; the sender may try again
    IN_USE = 36  # another node with this identity is alive elsewhere
    INTERNAL = 37  # it provoked an error of this program's own
    QUARANTINED = 38  # from a sender whose statements provoked such errors
    MISPLACED = 39  # no proof that a node is attached at the stated location
    NO_CHANNEL = 40  # it must come in a channel, and came outside, or in an unknown one
    WRONG_SIDE = 41  # a topic's frame from a port that does not lead to its publisher
    RATE_LIMITED = 42  # more hellos than are verified
    COOKIE_REQUIRED = 43  # a stranger's hello under load, without proof that it receives at its address
    UNCONCERNED = 44  # a revocation by an issuer of whose certificates none is held here
    THROUGH_LEAF = 45  # the path leads through a leaf, or a leaf sends for more than the nodes attached to it
    NO_SECOND_PATH = 46  # the second copy of a frame at a switch that has no second path for it
    SECOND_COPY = 47  # a copy of a frame that is here: the other path, or one sent again against loss, brought it
    LIFESPAN = 48  # a best-effort message that could not leave in time, before a frame of it was sealed
    UNUSED_PARITY = 49  # a parity frame whose block lost nothing, or was filled before
    UNPROVEN = 50  # a reader's count of frames that its receipts do not prove; more count as lost
    THINNED = 51  # a copy of a message that is for faster branches than this one
    NOT_IN_CONTROL = 52  # a message of a publisher that does not hold the exclusive control of its topic

    @property
    def label(self) -> str:
        """Return the word used in metrics and traces, such as ``bad-tag``."""
        return self.name.lower().replace("_", "-")


DROP_COUNTERS: Final = max(DropReason) + 1  # length of a list of counters, indexed by reason


class GdpError(Exception):
    """Root of every error raised on purpose."""


class LocalError(GdpError):
    """The caller on this machine requested something impossible."""


class RemoteError(GdpError):
    """A peer's bytes are wrong: drop them, count ``reason``, carry on. Never fatal to a node."""

    def __init__(self, reason: DropReason, detail: str = "") -> None:
        super().__init__(f"{reason.label}: {detail}" if detail else reason.label)
        self.reason = reason
        self.detail = detail


class FrameError(RemoteError):
    """The bytes are not a frame of ours."""


class StatementError(RemoteError):
    """A signed statement, certificate or delegation is invalid."""


class EnvelopeError(RemoteError):
    """A sealed fragment or message does not open."""


class ConfigError(GdpError):
    """A configuration is wrong; the text names the location and what was expected.

    Args:
        where: ``file:line:column`` as far as known.
        key: dotted path of the key, empty for the whole file.
        expected: the expected content.
    """

    def __init__(self, where: str, key: str, expected: str) -> None:
        super().__init__(f"{where}: {key}: {expected}" if key else f"{where}: {expected}")
        self.where = where
        self.key = key
        self.expected = expected


class StoreError(GdpError):
    """The store did not respond; the caller may try again."""
