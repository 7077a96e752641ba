"""The one tree of errors, and the reasons for which a frame may be dropped.

Place: ground floor; imports nothing of ours.
An error answers "what may I do now?": a ``LocalError`` is our caller's fault, a ``RemoteError`` is a peer's (drop it,
count it, carry on), a ``ConfigError`` names the place in the file, a ``StoreError`` may be tried again.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

__all__ = [
    "DROP_COUNTERS",
    "ConfigError",
    "DropReason",
    "EnvelopeError",
    "FrameError",
    "GdpError",
    "LocalError",
    "RemoteError",
    "StatementError",
    "StoreError",
]


class DropReason(IntEnum):
    """Why a frame, a message or a statement went no further.

    The value is the metric label, the word in a trace and the counter index of a data plane at once, so new reasons are
    only ever appended.
    """

    # the frame itself
    TRUNCATED = 0  # fewer bytes than the header or the payload length says
    BAD_VERSION = 1
    BAD_ETHERTYPE = 2
    UNKNOWN_KIND = 3
    BAD_PARTS = 4  # part >= parts, no parts, or more than the limit
    HOPS_EXPIRED = 5
    TOO_BIG = 6  # longer than the next link carries
    # the way
    NO_ROUTE = 7
    NO_READER = 8  # a topic that nobody joined
    PORT_DOWN = 9
    PORT_FULL = 10  # the device's queue refused it
    PENDING_FULL = 11
    PENDING_EXPIRED = 12
    # the message
    BAD_TAG = 13  # AES-GCM refused the part
    BAD_SIGNATURE = 14
    REPLAYED = 15
    LATE = 16  # a part of a finished or abandoned message
    DUPLICATE = 17
    WRONG_INCARNATION = 18
    UNKNOWN_EPOCH = 19
    NO_KEY = 20
    MEMORY_FULL = 21
    ABANDONED = 22  # patience ran out before the last part came
    # the statement
    MALFORMED = 23  # not the CBOR it should be
    WRONG_NAME = 24  # the name's hash does not come out
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
    UNAVAILABLE = 35  # a RIB's store did not answer; the sender may try again
    IN_USE = 36  # another node with this identity is alive elsewhere
    INTERNAL = 37  # it drew an error of this program's own
    QUARANTINED = 38  # from a sender whose statements drew such errors
    MISPLACED = 39  # no proof that a node is attached where this says
    NO_CHANNEL = 40  # what must come in a channel came outside, or in one that is not known
    WRONG_SIDE = 41  # a topic's frame from a port on the way to which its publisher is not
    RATE_LIMITED = 42  # more hellos than are verified
    COOKIE_REQUIRED = 43  # a stranger's hello under load, without proof that it receives at its address
    UNCONCERNED = 44  # a revocation by somebody of whom no certificate is held here
    THROUGH_LEAF = 45  # the way leads through a leaf, or a leaf speaks for more than the nodes attached to it

    @property
    def label(self) -> str:
        """Return the word used in metrics and traces, such as ``bad-tag``."""
        return self.name.lower().replace("_", "-")


DROP_COUNTERS: Final = max(DropReason) + 1  # length of a list of counters, of which each stands at its reason


class GdpError(Exception):
    """Root of every error raised on purpose."""


class LocalError(GdpError):
    """The caller on this machine asked for something that cannot be."""


class RemoteError(GdpError):
    """A peer's bytes are wrong: drop them, count ``reason``, carry on. Never fatal to a node."""

    def __init__(self, reason: DropReason, detail: str = "") -> None:
        super().__init__(f"{reason.label}: {detail}" if detail else reason.label)
        self.reason = reason
        self.detail = detail


class FrameError(RemoteError):
    """The bytes are not a frame of ours."""


class StatementError(RemoteError):
    """A signed statement, certificate or delegation does not hold."""


class EnvelopeError(RemoteError):
    """A sealed part or message does not open."""


class ConfigError(GdpError):
    """A configuration is wrong; the text names the place and what was expected.

    Args:
        where: ``file:line:column`` as far as known.
        key: dotted path of the key, empty for the whole file.
        expected: what should have stood there.
    """

    def __init__(self, where: str, key: str, expected: str) -> None:
        super().__init__(f"{where}: {key}: {expected}" if key else f"{where}: {expected}")
        self.where = where
        self.key = key
        self.expected = expected


class StoreError(GdpError):
    """The store did not answer; the caller may try again."""
