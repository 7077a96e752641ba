"""Admission of hellos: a bound on verified signatures, so that a flood costs a bounded share of a core.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: WireGuard (NDSS 2017), section 5.3, for cookies; RFC
9000, section 8.1, for the bound on bytes to an unvalidated address; RFC 4732 for the order of checks.

The port checks what is cheap, before it verifies any signature::

    neighbour's certificate and address  -> a token bucket of that neighbour
    any other                            -> a token bucket of its address, then one for all strangers on the port
    the strangers' bucket is empty       -> verified with a valid cookie only; without one it gets a cookie, 128 bytes

A cookie is a MAC over the port's session and the stranger's address. The port keeps no state for the receiver of a
cookie. The stranger proves the cookie by a tag over its own session and sequence number. The signature of its hello
covers the tag.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gdp.control.hello import COOKIE_BYTES, NONCE_BYTES, Hello
from gdp.errors import DropReason, FrameError, StatementError
from gdp.intervals import Rate
from gdp.token_bucket import TokenBucket, TokenBuckets

_DIGEST: Final = "sha256"
_SECRET_BYTES: Final = 32
# a secret is used for this time, and its cookies are accepted for as long again; WireGuard, 5.4.7
_SECRET_S: Final = 120.0
_PURPOSE: Final = b"gdp-cookie-1"

# per second, and burst; a neighbour sends at most four per second after a change
NEIGHBOUR_HELLOS: Final = Rate(25.0, burst=50.0)
ADDRESS_HELLOS: Final = Rate(10.0, burst=20.0)
# of all strangers on a port; 64 take 30 ms, a seventh of the time to detect
STRANGER_HELLOS: Final = Rate(100.0, burst=64.0)
PROVEN_HELLOS: Final = Rate(50.0, burst=50.0)  # of strangers with a cookie, in addition to the former
COOKIES: Final = Rate(100.0, burst=100.0)
REFUSALS: Final = Rate(100.0, burst=200.0)  # a higher rate of refusals is a flood, too
_LOADED_S: Final = 10.0  # after the strangers' bucket became empty
_ADDRESSES_MAX: Final = 256


class Cookies:
    """Cookies of one node, made with a secret that changes."""

    def __init__(self, random_bytes: Callable[[int], bytes]) -> None:
        self._random_bytes = random_bytes
        self._secrets: list[bytes] = []  # the present one first
        self._drawn_s = float("-inf")

    def make(self, session: bytes, mac: bytes, now_s: float) -> bytes:
        """Return the cookie of an address; ``session``: nonce of our port."""
        self._rotate(now_s)
        return _cookie(self._secrets[0], session, mac)

    def proves(self, hello: Hello, session: bytes, mac: bytes, now_s: float) -> bool:
        """Return whether a hello proves a cookie that this address received in this session of our port."""
        tag = next((tag for asker, tag in hello.cookies if asker == session), None)
        if tag is None:
            return False
        self._rotate(now_s)
        return any(
            hmac.compare_digest(tag, seal_cookie(_cookie(secret, session, mac), hello.nonce, hello.sequence))
            for secret in self._secrets
        )

    def _rotate(self, now_s: float) -> None:
        if now_s >= self._drawn_s + 2 * _SECRET_S:
            self._secrets.clear()
        if now_s >= self._drawn_s + _SECRET_S:
            self._secrets = [self._random_bytes(_SECRET_BYTES), *self._secrets[:1]]
            self._drawn_s = now_s


def _cookie(secret: bytes, session: bytes, mac: bytes) -> bytes:
    return hmac.digest(secret, session + mac, _DIGEST)[:COOKIE_BYTES]


def seal_cookie(cookie: bytes, nonce: bytes, sequence: int) -> bytes:
    """Return the tag by which a hello proves a cookie; an eavesdropper cannot use it for another hello."""
    return hmac.digest(cookie, _PURPOSE + nonce + sequence.to_bytes(8, "big"), _DIGEST)[:COOKIE_BYTES]


def cookie_payload(session: bytes, nonce: bytes, cookie: bytes) -> bytes:
    """Return the payload of a frame of kind COOKIE.

    Args:
        session: nonce of the port that issues it.
        nonce: nonce of the hello that it answers.
    """
    return session + nonce + cookie


def read_cookie(payload: bytes) -> tuple[bytes, bytes, bytes]:
    """Return session, nonce and cookie. Raises ``FrameError``: TRUNCATED."""
    if len(payload) < 2 * NONCE_BYTES + COOKIE_BYTES:
        raise FrameError(DropReason.TRUNCATED, "cookie")
    at = 2 * NONCE_BYTES
    return payload[:NONCE_BYTES], payload[NONCE_BYTES:at], payload[at : at + COOKIE_BYTES]


@dataclass(slots=True, kw_only=True)
class Admission:
    """Budget of one port for hellos.

    Attributes:
        loaded_until_s: strangers need a cookie until then.
        flooded_until_s: hellos are refused unverified until then; a neighbour's may be among them.
    """

    loaded_until_s: float = float("-inf")
    flooded_until_s: float = float("-inf")
    _strangers: TokenBucket = field(default_factory=lambda: TokenBucket(*STRANGER_HELLOS))
    _proven: TokenBucket = field(default_factory=lambda: TokenBucket(*PROVEN_HELLOS))
    _cookies: TokenBucket = field(default_factory=lambda: TokenBucket(*COOKIES))
    _refusals: TokenBucket = field(default_factory=lambda: TokenBucket(*REFUSALS))
    _addresses: TokenBuckets = field(default_factory=lambda: TokenBuckets(*ADDRESS_HELLOS, _ADDRESSES_MAX))

    def is_loaded(self, now_s: float) -> bool:
        """Return whether more hellos arrive than are verified without a cookie."""
        return now_s < self.loaded_until_s

    def check_quota(self, mac: bytes, now_s: float) -> None:
        """Refuse an address that has used up its share, before anything is parsed.

        Raises:
            FrameError: RATE_LIMITED.
        """
        if self._addresses.left(mac, now_s) < 1:
            self.refused(now_s)
            raise FrameError(DropReason.RATE_LIMITED, "hellos of one address")

    def refused(self, now_s: float) -> None:
        """Note a hello that was refused unverified; many of them are a flood."""
        if not self._refusals.spend(now_s):
            self.flooded_until_s = now_s + _LOADED_S

    def admit_neighbour(self, bucket: TokenBucket, now_s: float) -> None:
        """Take a token of a neighbour. Raises ``StatementError``: RATE_LIMITED."""
        if not bucket.spend(now_s):
            self.flooded_until_s = now_s + _LOADED_S
            raise StatementError(DropReason.RATE_LIMITED, "hellos of one neighbour")

    def admit_stranger(self, mac: bytes, now_s: float, has_cookie: Callable[[], bool]) -> None:
        """Take tokens of a stranger.

        Args:
            has_cookie: whether its hello proves a valid cookie; called under load only.

        Raises:
            StatementError: RATE_LIMITED, or COOKIE_REQUIRED.
        """
        if not self._addresses.spend(mac, now_s):
            self.refused(now_s)
            raise StatementError(DropReason.RATE_LIMITED, "hellos of one address")
        if not self.is_loaded(now_s):
            if self._strangers.spend(now_s):
                return
            self._load(now_s)
        if not has_cookie():
            if not self._strangers.spend(now_s):  # hellos without a cookie keep the port loaded
                self._load(now_s)
            raise StatementError(DropReason.COOKIE_REQUIRED, "hello")
        if not self._proven.spend(now_s):
            raise StatementError(DropReason.RATE_LIMITED, "hellos of strangers")

    def may_send_cookie(self, now_s: float) -> bool:
        """Take a token for a cookie; return whether there was one."""
        return self._cookies.spend(now_s)

    def _load(self, now_s: float) -> None:
        self.loaded_until_s = self.flooded_until_s = now_s + _LOADED_S
