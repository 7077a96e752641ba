"""Hello: the periodic message between neighbours on a link.

Sans-I/O. Source: OSPF (RFC 2328, section 9.5).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.control.endpoints import Endpoint
from gdp.control.preshared_key import SIZES
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import FRAME_MAX_BYTES
from gdp.names import Name

__all__ = [
    "COOKIES_MAX",
    "COOKIE_BYTES",
    "DIGEST_BYTES",
    "ECHO_BYTES",
    "HEARD_MAX",
    "HELLO_MAX_BYTES",
    "INCARNATION_BYTES",
    "INTERVAL_MAX_MS",
    "MULTIPLIER_MAX",
    "NONCE_BYTES",
    "NO_KEEPALIVES",
    "OBSERVED_MAX",
    "RTCERTS_MAX",
    "Hello",
    "Timing",
    "echo_of",
]

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
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

    nonce: bytes
    sequence: int
    heard: tuple[bytes, ...]
    mtu: int
    digest: bytes
    membership: bytes
    timing: Timing = NO_KEEPALIVES
    exchange_key: bytes = b""
    incarnation_id: bytes = bytes(INCARNATION_BYTES)
    conflicts: tuple[bytes, ...] = ()
    rtcerts: tuple[bytes, ...] = ()
    cookies: tuple[tuple[bytes, bytes], ...] = ()
    observed: tuple[tuple[bytes, Endpoint], ...] = ()
    preshared: bytes = field(default=b"", repr=False)

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "n": self.nonce,
            "s": self.sequence,
            "h": list(self.heard[:HEARD_MAX]),
            "m": self.mtu,
            "d": self.digest,
            "c": self.membership,
            "k": list(self.timing),
            "x": self.exchange_key,
            "b": self.incarnation_id,
            "u": list(self.conflicts[:CONFLICTS_MAX]),
            "r": list(self.rtcerts[:RTCERTS_MAX]),
            "y": [asker + tag for asker, tag in self.cookies[:COOKIES_MAX]],
            "o": [nonce + endpoint.to_wire() for nonce, endpoint in self.observed[:OBSERVED_MAX]],
        }
        if self.preshared:
            body["p"] = self.preshared
        return sign(StatementType.HELLO, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Hello:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        return cls(
            nonce=fields.bytes_("n", NONCE_BYTES),
            sequence=fields.uint("s"),
            heard=tuple(fields.byte_strings("h", HEARD_MAX, ECHO_BYTES)),
            mtu=fields.uint("m", FRAME_MAX_BYTES),
            digest=fields.bytes_("d", DIGEST_BYTES),
            membership=fields.bytes_("c"),
            timing=_timing(fields),
            exchange_key=fields.bytes_("x", EXCHANGE_KEY_BYTES) if fields.get("x") != b"" else b"",
            incarnation_id=fields.bytes_("b", INCARNATION_BYTES),
            conflicts=tuple(fields.byte_strings("u", CONFLICTS_MAX, ECHO_BYTES)),
            rtcerts=tuple(fields.byte_strings("r", RTCERTS_MAX)),
            cookies=tuple(
                (each[:NONCE_BYTES], each[NONCE_BYTES:])
                for each in fields.byte_strings("y", COOKIES_MAX, NONCE_BYTES + COOKIE_BYTES)
            ),
            observed=_observed(fields),
            preshared=_preshared(fields),
        )


def _observed(fields: Fields) -> tuple[tuple[bytes, Endpoint], ...]:
    try:
        return tuple(
            (each[:NONCE_BYTES], Endpoint.from_wire(each[NONCE_BYTES:]))
            for each in (fields.byte_strings("o", OBSERVED_MAX) if "o" in fields else ())
        )
    except ValueError as error:
        raise StatementError(DropReason.MALFORMED, "an observed endpoint") from error


def _preshared(fields: Fields) -> bytes:
    message = fields.bytes_("p") if "p" in fields else b""
    if len(message) not in SIZES:
        raise StatementError(DropReason.MALFORMED, "a message about a preshared key")
    return message


def _timing(fields: Fields) -> Timing:
    match fields.list_("k", 3):
        case [int(transmit_ms), int(receive_ms), int(multiplier)] if (
            0 <= transmit_ms <= INTERVAL_MAX_MS
            and 0 <= receive_ms <= INTERVAL_MAX_MS
            and 1 <= multiplier <= MULTIPLIER_MAX
        ):
            return Timing(transmit_ms, receive_ms, multiplier)
    raise StatementError(DropReason.MALFORMED, "timing of keepalives")
