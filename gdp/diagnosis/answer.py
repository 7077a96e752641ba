"""Answer of a diagnosis: the cause, one sentence, the next command."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Verdict(Enum):
    """Outcome of a diagnosis; the exit codes of ``gdp explain`` are 0, 1 and 3."""

    FINE = "fine"
    FAULT = "fault"
    UNKNOWN = "unknown"


class Cause(Enum):
    """Why a name does not arrive, or that it does; the value is the word in JSON.

    The members stand in the order of a diagnosis, which is that of a path: what stops everything comes first. "It
    arrives" precedes every fault but a missing proxy, so a name that flows never raises an alarm. The last two have no
    rule.
    """

    NO_PROXY_HERE = "no-proxy-here"
    ARRIVES = "arrives"
    CLOCK = "clock"
    IDENTITY_IN_USE = "identity-in-use"
    MEMBERSHIP_REVOKED = "membership-revoked"
    MEMBERSHIP_EXPIRED = "membership-expired"
    INTERFACE_DOWN = "interface-down"
    NAME_UNKNOWN = "name-unknown"
    NOT_IMPORTED = "not-imported"
    SWITCH_DOWN = "switch-down"
    UNTRUSTED_DOMAIN = "untrusted-domain"
    NAT_CLOSED = "nat-closed"
    TUNNEL_DOWN = "tunnel-down"
    ETHERTYPE_FILTERED = "ethertype-filtered"
    RIB_DOWN = "rib-down"
    LINK_SILENT = "link-silent"
    NO_ROUTE = "no-route"
    FAR_PROXY_DOWN = "far-proxy-down"
    TYPE_SUPPORT_MISSING = "type-support-missing"
    LOCAL_TYPE_DIFFERS = "local-type-differs"
    GRAPH_AWAY = "graph-away"
    RIVAL_PROXY = "rival-proxy"
    TYPE_DIFFERS = "type-differs"
    OWNER_DIFFERS = "owner-differs"
    METADATA_DIFFERS = "metadata-differs"
    DELEGATION_EXPIRED = "delegation-expired"
    DELEGATION_REVOKED = "delegation-revoked"
    DELEGATION_MISSING = "delegation-missing"
    RIGHT_MISSING = "right-missing"
    QUOTA = "quota"
    ADVERTISEMENT_REFUSED = "advertisement-refused"
    SHARED_MEMORY_ONLY = "shared-memory-only"
    ROS_DOMAIN_DIFFERS = "ros-domain-differs"
    NO_READER_HERE = "no-reader-here"
    NO_PUBLISHER = "no-publisher"
    NO_SERVER = "no-server"
    NOT_EXPOSED = "not-exposed"
    RIB_SILENT = "rib-silent"
    NO_ADVERTISER = "no-advertiser"
    REPLICAS_SILENT = "replicas-silent"
    KEY_EPOCH = "key-epoch"
    KEYS_DIFFER = "keys-differ"
    QOS_IMPOSSIBLE = "qos-impossible"
    TOO_LARGE = "too-large"
    NOT_IN_CONTROL = "not-in-control"
    RATE_LIMIT = "rate-limit"
    BIT_RATE_LIMIT = "bit-rate-limit"
    DEADLINE = "deadline"
    QOS_RELIABILITY = "qos-reliability"
    QOS_DURABILITY = "qos-durability"
    PENDING_FULL = "pending-full"
    MEMORY_FULL = "memory-full"
    TOO_FAST = "too-fast"
    MTU_HOLE = "mtu-hole"
    MALFORMED = "malformed"
    CALL_FAILED = "call-failed"
    PATH_LOSES = "path-loses"
    PUBLISHER_SILENT = "publisher-silent"
    IDLE = "idle"
    STARTING = "starting"
    UNKNOWN = "unknown"

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
