"""Hello: the periodic message between neighbours on a link, and the settings with which a node begins to send it.

Sans-I/O. Source: OSPF (RFC 2328, section 9.5).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Final, NamedTuple

from gdp.control.endpoints import ENDPOINT_MAX_BYTES, Endpoint
from gdp.control.preshared_key import SIZES
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES
from gdp.crypto.schema import CERT, OCTETS, STATEMENT, Body, Keyed, many, mapped, octets, or_empty, packed, row, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.intervals import ADVERTISEMENT, DETECT_MULTIPLIER, KEEPALIVE_MS, NEIGHBOUR
from gdp.limits import FRAME_MAX_BYTES
from gdp.names import Name

NONCE_BYTES: Final = 8
ECHO_BYTES: Final = 16
DIGEST_BYTES: Final = 8
INCARNATION_BYTES: Final = 16  # first sequence number (wall-clock milliseconds of the start), incarnation; big-endian
COOKIE_BYTES: Final = 16
HEARD_MAX: Final = 128  # NEIGHBOURS_MAX of a port, and as many that have not proved themselves yet
CONFLICTS_MAX: Final = 32
COOKIES_MAX: Final = 16
OBSERVED_MAX: Final = 16
HELLO_MAX_BYTES: Final = 10 << 10  # a certificate, ``RTCERTS_MAX`` RtCerts and all nonces fit
RTCERTS_MAX: Final = 8
INTERVAL_MAX_MS: Final = 60_000
MULTIPLIER_MAX: Final = 255


class Timing(NamedTuple):
    """Timing that one end requests; the slower end decides. Source: RFC 5880, section 6.8.1.

    Attributes:
        transmit_ms: desired minimum between keepalives that it sends; 0: it sends none.
        receive_ms: required minimum between those that it receives; 0: it wants none.
        multiplier: after this number of its intervals without a frame the other end may declare it down.
    """

    transmit_ms: int
    receive_ms: int
    multiplier: int

    def interval_s(self, receiver: Timing) -> float:
        """Return the seconds between keepalives from here to ``receiver``; 0: there are none."""
        return max(self.transmit_ms, receiver.receive_ms) / 1_000 if self.transmit_ms and receiver.receive_ms else 0.0


NO_KEEPALIVES: Final = Timing(0, 0, 1)


def echo_of(nonce: bytes, name: Name) -> bytes:
    """Return how other nodes refer to a session of a port: by its nonce and by the node that sent it.

    A bare nonce does not suffice, because another member could send it as its own (docs/model, H2 and J2).
    """
    return hashlib.sha256(b"gdp echo\0" + nonce + name).digest()[:ECHO_BYTES]


_TIMING: Final = row(Timing, uint(INTERVAL_MAX_MS), uint(INTERVAL_MAX_MS), uint(MULTIPLIER_MAX, 1))
_COOKIE: Final = packed(
    NONCE_BYTES + COOKIE_BYTES, lambda each: (each[:NONCE_BYTES], each[NONCE_BYTES:]), lambda pair: pair[0] + pair[1]
)
_OBSERVED: Final = mapped(
    octets(most=NONCE_BYTES + ENDPOINT_MAX_BYTES),
    lambda each: (each[:NONCE_BYTES], Endpoint.from_wire(each[NONCE_BYTES:])),
    lambda pair: pair[0] + pair[1].to_wire(),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello(Body):
    """One hello on one port.

    Args:
        nonce: random for this session of the sender's port; its echo proves that the neighbour is present now.
        sequence: rises within the session.
        heard: the echo of each node that the sender receives on this port (``echo_of``).
        mtu: bytes after the Ethernet header that the sender's port accepts.
        digest: of the link state that both ends should share; if it differs, they send each other all of it.
        membership: the sender's certificate, DER.
        timing: the keepalive timing that the sender requests.
        exchange_key: X25519, for the key of keepalives; empty if the sender wants none.
        incarnation_id: mark of the sender's incarnation, ``INCARNATION_BYTES``.
        rtcerts: of a RIB, one for each switch that it receives here: permission to attract its traffic.
        conflicts: echoes of those here whose identity another node has, too; those not in ``heard`` are refused.
        cookies: for each receiver that required one, the nonce of its port and the tag that proves the cookie.
        observed: on a tunnel, for each receiver the nonce of its port, and its endpoint as the sender sees it.
        preshared: on a tunnel, a message of the agreement on its preshared key; empty: none.
    """

    TYPE = StatementType.HELLO
    nonce: Annotated[bytes, Keyed("n", octets(NONCE_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
    heard: Annotated[tuple[bytes, ...], Keyed("h", many(octets(ECHO_BYTES), HEARD_MAX))]
    mtu: Annotated[int, Keyed("m", uint(FRAME_MAX_BYTES))]
    digest: Annotated[bytes, Keyed("d", octets(DIGEST_BYTES))]
    membership: Annotated[bytes, Keyed("c", CERT)]
    timing: Annotated[Timing, Keyed("k", _TIMING)] = NO_KEEPALIVES
    exchange_key: Annotated[bytes, Keyed("x", or_empty(octets(EXCHANGE_KEY_BYTES), b""))] = b""
    incarnation_id: Annotated[bytes, Keyed("b", octets(INCARNATION_BYTES))] = bytes(INCARNATION_BYTES)
    conflicts: Annotated[tuple[bytes, ...], Keyed("u", many(octets(ECHO_BYTES), CONFLICTS_MAX))] = ()
    rtcerts: Annotated[tuple[bytes, ...], Keyed("r", many(STATEMENT, RTCERTS_MAX))] = ()
    cookies: Annotated[tuple[tuple[bytes, bytes], ...], Keyed("y", many(_COOKIE, COOKIES_MAX))] = ()
    observed: Annotated[tuple[tuple[bytes, Endpoint], ...], Keyed("o", many(_OBSERVED, OBSERVED_MAX), absent=())] = ()
    preshared: Annotated[bytes, Keyed("p", OCTETS, absent=b"", is_omitted=True)] = field(default=b"", repr=False)

    def check(self) -> None:
        """Return if the message about a preshared key has one of its sizes. Raises ``StatementError``: MALFORMED."""
        if len(self.preshared) not in SIZES:
            raise StatementError(DropReason.MALFORMED, "a message about a preshared key")


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSettings:
    """Start settings of a switch, a RIB or a participant.

    Args:
        incarnation: 64 random bits, new at each start.
        first_sequence: above every sequence number of an earlier incarnation; wall-clock milliseconds suffice.
        random_bytes: source of nonces.
        hello_s: between two hellos on a port.
        dead_s: a neighbour silent for this time is lost, while it sends no keepalives.
        lease_s: lease of what the node keeps at RIBs: advertisements of a participant or a RIB, watches of a switch.
        keepalive_ms: between keepalives, which neighbours negotiate; 0: none; None: in proportion to ``dead_s``.
        detect_multiplier: a neighbour silent for this number of keepalives is lost.
    """

    incarnation: int
    first_sequence: int
    random_bytes: Callable[[int], bytes]
    hello_s: float = NEIGHBOUR.refresh_s
    dead_s: float = NEIGHBOUR.lease_s
    lease_s: float = ADVERTISEMENT.lease_s
    keepalive_ms: int | None = None
    detect_multiplier: int = DETECT_MULTIPLIER

    @property
    def incarnation_id(self) -> bytes:
        """Return the mark of this incarnation, ``INCARNATION_BYTES``: of two, that of the older one is less."""
        return self.first_sequence.to_bytes(8, "big") + self.incarnation.to_bytes(8, "big")

    @property
    def timing(self) -> Timing:
        """Return the keepalive timing that this node requests."""
        every_ms = (
            round(KEEPALIVE_MS * self.dead_s / NEIGHBOUR.lease_s) if self.keepalive_ms is None else self.keepalive_ms
        )
        return Timing(every_ms, every_ms, self.detect_multiplier)
