"""Nodes of two domains that trust each other and of one untrusted domain, for tests of the control plane."""

from __future__ import annotations

from collections.abc import Sequence

from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import NodeSettings
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.frame.codec import HEADER_BYTES, Kind, decode
from gdp.sansio import ReceivedFrame, Timestamps
from gdp.trust.domain import Policy

UNIX_S = 1_800_000_000
YEAR = Validity(UNIX_S - 31_536_000, UNIX_S + 31_536_000)

SCHOOL = CertificateAuthority.create("school", SigningKey.generate(), YEAR)
CLOUD = CertificateAuthority.create("cloud", SigningKey.generate(), YEAR)
ELSEWHERE = CertificateAuthority.create("elsewhere", SigningKey.generate(), YEAR)
POLICY = Policy(SCHOOL.root, [CLOUD.root])


def node(
    label: str, role: Role = Role.SWITCH, domain: CertificateAuthority = SCHOOL, validity: Validity = YEAR
) -> Identity:
    """Return a new node of a domain."""
    return NodeKeys.generate(role, label).join(domain, validity)


def at(mono_s: float, unix_s: float = UNIX_S) -> Timestamps:
    """Return timestamps."""
    return Timestamps(mono_s, unix_s)


class Nonces:
    """Source of bytes that never repeats."""

    def __init__(self, salt: int) -> None:
        self._next = salt << 32

    def __call__(self, size: int) -> bytes:
        self._next += 1
        return self._next.to_bytes(size, "big")


def hello_protocol(identity: Identity, salt: int, policy: Policy = POLICY) -> HelloProtocol:
    """Return a HelloProtocol with one port, numbered 0."""
    settings = NodeSettings(incarnation=0, first_sequence=0, random_bytes=Nonces(salt), keepalive_ms=0)
    made = HelloProtocol(identity, policy, ControlFragmenter(identity.name, salt), settings)
    made.add_port(0, bytes([2, salt, 0, 0, 0, 0]), 1_500, 10, 0.0)
    return made


def statement_of(frame: bytes) -> bytes:
    """Return the payload of a frame, without its padding."""
    return frame[HEADER_BYTES : HEADER_BYTES + decode(frame).length]


def statement_of_frames(frames: Sequence[bytes]) -> bytes:
    """Return the statement that several frames carry."""
    return b"".join(map(statement_of, frames))


def hello_in(statement: bytes, port: int = 0, mac: bytes = b"\x02far\x00\x00", padded_bytes: int = 0) -> ReceivedFrame:
    """Return the received hello in one frame, with zeros behind up to ``padded_bytes``."""
    (frame,) = ControlFragmenter(bytes(32), 1).split(Kind.HELLO, statement, 60_000)
    return ReceivedFrame(port, mac, frame.ljust(padded_bytes, b"\0"))
