"""Answer of a diagnosis: the cause, one sentence, the next command.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["Answer", "Cause", "Verdict"]


class Verdict(Enum):
    """Outcome of a diagnosis; the exit codes of ``gdp explain`` are 0, 1 and 3."""

    FINE = "fine"
    FAULT = "fault"
    UNKNOWN = "unknown"


class Cause(Enum):
    """Why a name does not arrive, or that it does; the value is the word in JSON."""

    ARRIVES = "arrives"
    IDLE = "idle"
    STARTING = "starting"
    UNKNOWN = "unknown"
    NO_PROXY_HERE = "no-proxy-here"
    CLOCK = "clock"
    IDENTITY_IN_USE = "identity-in-use"
    MEMBERSHIP_REVOKED = "membership-revoked"
    MEMBERSHIP_EXPIRED = "membership-expired"
    UNTRUSTED_DOMAIN = "untrusted-domain"
    INTERFACE_DOWN = "interface-down"
    SWITCH_DOWN = "switch-down"
    ETHERTYPE_FILTERED = "ethertype-filtered"
    LINK_SILENT = "link-silent"
    NAT_CLOSED = "nat-closed"
    TUNNEL_DOWN = "tunnel-down"
    RIB_DOWN = "rib-down"
    RIB_SILENT = "rib-silent"
    FAR_PROXY_DOWN = "far-proxy-down"
    NAME_UNKNOWN = "name-unknown"
    NOT_IMPORTED = "not-imported"
    TYPE_SUPPORT_MISSING = "type-support-missing"
    LOCAL_TYPE_DIFFERS = "local-type-differs"
    GRAPH_AWAY = "graph-away"
    RIVAL_PROXY = "rival-proxy"
    DELEGATION_EXPIRED = "delegation-expired"
    DELEGATION_REVOKED = "delegation-revoked"
    DELEGATION_MISSING = "delegation-missing"
    RIGHT_MISSING = "right-missing"
    QUOTA = "quota"
    ADVERTISEMENT_REFUSED = "advertisement-refused"
    ROS_DOMAIN_DIFFERS = "ros-domain-differs"
    SHARED_MEMORY_ONLY = "shared-memory-only"
    NO_READER_HERE = "no-reader-here"
    TYPE_DIFFERS = "type-differs"
    OWNER_DIFFERS = "owner-differs"
    METADATA_DIFFERS = "metadata-differs"
    NOT_EXPOSED = "not-exposed"
    NO_PUBLISHER = "no-publisher"
    NO_SERVER = "no-server"
    REPLICAS_SILENT = "replicas-silent"
    NO_ADVERTISER = "no-advertiser"
    NO_ROUTE = "no-route"
    KEY_EPOCH = "key-epoch"
    KEYS_DIFFER = "keys-differ"
    QOS_IMPOSSIBLE = "qos-impossible"
    QOS_RELIABILITY = "qos-reliability"
    QOS_DURABILITY = "qos-durability"
    TOO_LARGE = "too-large"
    RATE_LIMIT = "rate-limit"
    BIT_RATE_LIMIT = "bit-rate-limit"
    DEADLINE = "deadline"
    TOO_FAST = "too-fast"
    MEMORY_FULL = "memory-full"
    PENDING_FULL = "pending-full"
    MTU_HOLE = "mtu-hole"
    MALFORMED = "malformed"
    PATH_LOSES = "path-loses"
    PUBLISHER_SILENT = "publisher-silent"
    CALL_FAILED = "call-failed"

    @property
    def verdict(self) -> Verdict:
        """Return whether this is a fault."""
        return _VERDICTS.get(self, Verdict.FAULT)


_VERDICTS = {
    Cause.ARRIVES: Verdict.FINE,
    Cause.IDLE: Verdict.FINE,
    Cause.STARTING: Verdict.UNKNOWN,
    Cause.UNKNOWN: Verdict.UNKNOWN,
}


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer to ``gdp explain``.

    Args:
        sentence: one sentence for people.
        command: what to type next; empty where nothing is to be done.
        unknown: what could not be asked, and why.
    """

    cause: Cause
    sentence: str
    command: str = ""
    unknown: tuple[str, ...] = ()

    def to_fields(self) -> dict[str, object]:
        """Return the JSON form."""
        return {
            "verdict": self.cause.verdict.value,
            "cause": self.cause.value,
            "sentence": self.sentence,
            "command": self.command or None,
            "unknown": list(self.unknown),
        }
