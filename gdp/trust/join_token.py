"""Join token: the compact text by which one machine joins a trust domain, once.

Sans-I/O. Source: base32 (RFC 4648, section 6), HKDF (RFC 5869). The text is ``gdp1`` and the base32 form, without
padding, of::

    version (1) || role (1) || expires, Unix seconds (5) || SHA-256 of the founding root certificate, DER (32)
    || secret (16) || number of servers (1) || for each: length (1) || "host:port" or "unix:" and a path, UTF-8
    || first 5 bytes of SHA-256 of all bytes before

The secret is never sent. Its holder proves it by a MAC (``join_proof``) over what binds the TLS connection, and the
domain stores only the id and the MAC key that follow from it.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.certificates import Role, Root
from gdp.errors import LocalError
from gdp.host_port import checked_host_port, split_host_port

JOIN_SECRET_BYTES: Final = 16
JOIN_ID_BYTES: Final = 16
SERVERS_MAX: Final = 8
HOLDER_FOLDER: Final = "store"
_UNIX: Final = "unix:"
_SERVER_MAX_BYTES: Final = 255
_PREFIX: Final = "gdp1"
_VERSION: Final = 1
_KEY_BYTES: Final = 32
_FINGERPRINT_BYTES: Final = 32
_TIME_BYTES: Final = 5
_CHECKSUM_BYTES: Final = 5
_TEXT_MAX: Final = 4_096
_MISTYPED: Final = "the token was typed or copied wrong: its checksum does not match; copy the whole line once more"


class JoinRole(str, Enum):
    """Role of a machine that joins: which nodes it gets, and whether traffic of others passes through it."""

    ROBOT = "robot"  # a leaf switch and a proxy
    SWITCH = "switch"  # a switch that forwards for others, and a proxy
    LEAF = "leaf"  # a leaf switch alone, for a program that brings its own node
    MACHINE = "machine"  # of a cluster: a leaf switch, and a proxy with delegations
    GATEWAY = "gateway"  # of a cluster: the same, and its switch may forward for others
    HOLDER = "holder"  # a leaf switch and a holder of capsules

    @property
    def is_of_cluster(self) -> bool:
        """Return whether a launcher plans the machine: it receives delegations, and any other request is misuse."""
        return self in (JoinRole.MACHINE, JoinRole.GATEWAY)

    @property
    def nodes(self) -> tuple[tuple[str, Role], ...]:
        """Return the folder and the role of each node of the machine; the switch is the first."""
        switch = Role.SWITCH if self in (JoinRole.SWITCH, JoinRole.GATEWAY) else Role.LEAF
        folder = HOLDER_FOLDER if self is JoinRole.HOLDER else Role.PROXY.value
        proxy = () if self is JoinRole.LEAF else ((folder, Role.PROXY),)
        return ((Role.SWITCH.value, switch), *proxy)


_ROLES: Final = tuple(JoinRole)  # the number on the wire is the index


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinToken:
    """A join token.

    Args:
        root: ``fingerprint_of`` the domain.
        secret: ``JOIN_SECRET_BYTES``, random.
        expires_unix_s: the domain refuses the token from then on.
        servers: ``host:port`` of the enrolment server, or ``unix:`` and its path, to be tried in this order.
    """

    root: bytes
    secret: bytes = field(repr=False)
    role: JoinRole
    expires_unix_s: int
    servers: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 0 < len(self.servers) <= SERVERS_MAX:
            raise LocalError(f"a token names 1 to {SERVERS_MAX} servers")
        for each in self.servers:
            if not each.startswith(_UNIX):
                split_host_port(each)
            elif len(_encoded(each)) > _SERVER_MAX_BYTES:
                raise LocalError(f"{each}: a token's path of a socket has at most {_SERVER_MAX_BYTES} bytes")
        if len(self.root) != _FINGERPRINT_BYTES or len(self.secret) != JOIN_SECRET_BYTES:
            raise LocalError("a token has a fingerprint of 32 bytes and a secret of 16")

    def to_text(self) -> str:
        """Return the text that a person copies."""
        servers = [_encoded(each) for each in self.servers]
        body = b"".join(
            [
                bytes([_VERSION, _ROLES.index(self.role)]),
                self.expires_unix_s.to_bytes(_TIME_BYTES, "big"),
                self.root,
                self.secret,
                bytes([len(servers)]),
                *(bytes([len(each)]) + each for each in servers),
            ]
        )
        text = base64.b32encode(body + _checksum(body)).decode().rstrip("=").lower()
        return _PREFIX + text

    @classmethod
    def from_text(cls, text: str) -> JoinToken:
        """Read a token; letter case, blanks and line breaks do not matter.

        Raises:
            LocalError: it is no token, was typed wrong, or is of a later version.
        """
        compact = "".join(text.split()).lower()
        if not compact.startswith(_PREFIX) or len(compact) > _TEXT_MAX:
            raise LocalError(f"this is no token: a token begins with {_PREFIX}; copy the whole line that names it")
        wire = _decoded(compact[len(_PREFIX) :])
        body, checksum = wire[:-_CHECKSUM_BYTES], wire[-_CHECKSUM_BYTES:]
        if len(wire) <= _CHECKSUM_BYTES or not hmac.compare_digest(_checksum(body), checksum):
            raise LocalError(_MISTYPED)
        if body[0] != _VERSION:
            raise LocalError(f"a token of version {body[0]}, which this program does not read; update the program")
        return cls._from_body(body[1:])

    @classmethod
    def _from_body(cls, body: bytes) -> JoinToken:
        try:
            role, at = _ROLES[body[0]], 1
            expires, at = int.from_bytes(body[at : at + _TIME_BYTES], "big"), at + _TIME_BYTES
            root, at = body[at : at + _FINGERPRINT_BYTES], at + _FINGERPRINT_BYTES
            secret, at = body[at : at + JOIN_SECRET_BYTES], at + JOIN_SECRET_BYTES
            servers, count, at = [], body[at], at + 1
            for _ in range(count):
                end = at + 1 + body[at]
                servers.append(body[at + 1 : end].decode(errors="surrogateescape"))
                at = end
        except IndexError as error:
            raise LocalError(_MISTYPED) from error
        if at != len(body):
            raise LocalError(_MISTYPED)
        return cls(root=root, secret=secret, role=role, expires_unix_s=expires, servers=tuple(servers))


def checked_server(text: str) -> str:
    """Return ``host:port``, or ``unix:`` and a path, unchanged, as a validator of pydantic.

    Raises:
        ValueError: another form.
    """
    return text if text.startswith(_UNIX) else checked_host_port(text)


def fingerprint_of(root: Root) -> bytes:
    """Return the SHA-256 of a domain's founding root certificate: it stays the same under successors."""
    return hashlib.sha256(root.lineage[0].wire).digest()


def join_id(secret: bytes) -> bytes:
    """Return the id under which the domain stores a token: ``JOIN_ID_BYTES``."""
    return _derived(secret, b"gdp-join-id-1", JOIN_ID_BYTES)


def join_key(secret: bytes) -> bytes:
    """Return the MAC key of a token, 32 bytes: what the domain stores in place of the secret."""
    return _derived(secret, b"gdp-join-mac-1", _KEY_BYTES)


def join_proof(key: bytes, binding: bytes, nonce: bytes, request: bytes) -> bytes:
    """Return the proof, 32 bytes, that the sender of a request has the token's secret.

    Args:
        key: ``join_key``.
        binding: channel binding of the TLS connection: tls-server-end-point (RFC 5929, section 4).
        nonce: of the server, for this connection.
    """
    return hmac.digest(key, b"gdp-join-1" + binding + nonce + hashlib.sha256(request).digest(), "sha256")


def _encoded(server: str) -> bytes:
    return server.encode(errors="surrogateescape")


def _decoded(text: str) -> bytes:
    try:
        return base64.b32decode(text.upper() + "=" * (-len(text) % 8))
    except (binascii.Error, ValueError) as error:
        raise LocalError(_MISTYPED) from error


def _checksum(body: bytes) -> bytes:
    return hashlib.sha256(body).digest()[:_CHECKSUM_BYTES]


def _derived(secret: bytes, info: bytes, size: int) -> bytes:
    return HKDF(hashes.SHA256(), size, None, info).derive(secret)
