"""Grant: the secret of a topic's epoch, sealed to one node.

Sans-I/O except for the randomness that sealing draws. Source: docs/explanation/design.md, section 4. HPKE (RFC 9180) to
the node's key, signed by the owner. The owner stores one master secret::

    secret(name, epoch) = HKDF-SHA256(master, salt "", info "gdp-topic-secret-1" || name || epoch (2)), 32 bytes
    HPKE info           = "gdp-grant-1" || name || epoch (2) || the node's name

Epochs below ``DAILY_FROM`` are numbered by hand, and begin when a node has them. Any other is a day since 1970 (UTC),
and begins with it. So grants arrive before their day, and all writers change together.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated, Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.identity import Identity
from gdp.crypto.kem import KemPublicKey
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.schema import NAME, OCTETS, Body, Keyed, uint
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.crypto.subject import SUBJECT, Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name

EPOCH_MAX: Final = (1 << 16) - 1  # two bytes of the frame header
EPOCH_S: Final = 86_400
DAILY_FROM: Final = 10_000
SECRET_BYTES: Final = 32
_SECRET_INFO: Final = b"gdp-topic-secret-1"
_GRANT_INFO: Final = b"gdp-grant-1"


@dataclass(frozen=True, slots=True)
class Grant:
    """The secret of one epoch of a topic."""

    name: Name
    epoch: int
    secret: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class _Sealed(Body):
    """A grant as it is signed."""

    TYPE = StatementType.GRANT
    subject: Annotated[Subject, SUBJECT]
    node: Annotated[Name, Keyed("to", NAME)]
    epoch: Annotated[int, Keyed("epoch", uint(EPOCH_MAX))]
    sealed: Annotated[bytes, Keyed("sealed", OCTETS)]


def begun_epochs(secrets: Mapping[int, bytes], unix_s: float) -> dict[int, bytes]:
    """Return the secrets of the epochs that have begun; the first one if none has."""
    begun = {epoch: secret for epoch, secret in secrets.items() if epoch < DAILY_FROM or epoch * EPOCH_S <= unix_s}
    return begun or dict(sorted(secrets.items())[:1])


def daily_epochs(held: Collection[int], unix_s: float) -> set[int]:
    """Return the epochs that the members of a topic hold today: the present one, the one before, and tomorrow's.

    The one before opens what its publishers repeat. A day whose eve brought no grant keeps the present epoch.

    Args:
        held: epochs that any of the members holds.
    """
    today = int(unix_s // EPOCH_S)
    return {*sorted(each for each in held if each <= today)[-2:], min(today + 1, EPOCH_MAX)}


def topic_secret(owner_master: bytes, name: Name, epoch: int) -> bytes:
    """Return the 32-byte secret of a topic's epoch.

    Args:
        owner_master: 32 random bytes that never leave the owner.
        epoch: 0 to ``EPOCH_MAX``.

    Raises:
        LocalError: a length or the epoch is out of bounds.
    """
    if len(owner_master) != SECRET_BYTES:
        raise LocalError(f"an owner's master secret has {SECRET_BYTES} bytes")
    info = _SECRET_INFO + name + _epoch_bytes(epoch)
    return HKDF(hashes.SHA256(), SECRET_BYTES, None, info).derive(owner_master)


def make_grant(
    key: SigningKey, owner_master: bytes, subject: Subject, epoch: int, node: Name, kem: KemPublicKey
) -> bytes:
    """Return the signed statement that grants an epoch's secret to a node.

    Args:
        key: the owner's, or that of a delegate that may delegate the topic in the owner's place.
        epoch: 0 to ``EPOCH_MAX``.
        kem: that node's public key, from its node descriptor.

    Raises:
        LocalError: an epoch out of bounds, or a library without the KEM.
        StatementError: MALFORMED, the node's public key is invalid.
    """
    secret = topic_secret(owner_master, subject.name, epoch)
    sealed = kem.seal(secret, _info(subject.name, epoch, node))
    return _Sealed(subject, node, epoch, sealed).to_wire(subject.name, key)


def open_grant(identity: Identity, wire: bytes, delegates: Collection[bytes] = ()) -> Grant:
    """Return the secret that an owner granted to this node.

    Args:
        delegates: keys that may delegate the topic in the owner's place, 33 bytes each.

    Raises:
        StatementError: MALFORMED, WRONG_NAME, NOT_FOR_US, BAD_SIGNATURE or BAD_TAG.
        LocalError: a library without the KEM.
    """
    statement = parse(wire)
    grant = _Sealed.from_statement(statement)
    grant.subject.expect(statement.signer)
    if grant.node != identity.name:
        raise StatementError(DropReason.NOT_FOR_US, "a grant to another node")
    _verify(statement, (grant.subject.owner_key, *delegates))
    secret = identity.kem.open(grant.sealed, _info(grant.subject.name, grant.epoch, identity.name))
    if len(secret) != SECRET_BYTES:
        raise StatementError(DropReason.MALFORMED, f"a secret has {SECRET_BYTES} bytes")
    return Grant(grant.subject.name, grant.epoch, secret)


def _verify(statement: Statement, keys: tuple[bytes, ...]) -> None:
    for key in keys[:-1]:
        with suppress(StatementError):
            statement.verify(PublicKey.from_compressed(key))
            return
    statement.verify(PublicKey.from_compressed(keys[-1]))


def _info(name: Name, epoch: int, node: Name) -> bytes:
    return _GRANT_INFO + name + _epoch_bytes(epoch) + node


def _epoch_bytes(epoch: int) -> bytes:
    if not 0 <= epoch <= EPOCH_MAX:
        raise LocalError(f"an epoch is a number from 0 to {EPOCH_MAX}")
    return epoch.to_bytes(2, "big")
