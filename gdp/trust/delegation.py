"""Delegation: all that a node received from an owner for one name, in one file.

Sans-I/O; ``gdp/stores/files`` stores it. It holds proofs and sealed secrets, and is of use only with the node's keys.
The metadata may be added in plain, so that the node's operator sees its purpose: the file is private to the node.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from gdp.crypto.cbor import decode, encode
from gdp.crypto.fields import Fields
from gdp.crypto.identity import Identity
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CHAIN_MAX
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.adcert import AdCertCache, Chain
from gdp.trust.grants import EPOCH_MAX, Grant, open_grant
from gdp.trust.right import Right, rights_from_fields, rights_to_wire

__all__ = ["DELEGATION_MAX_BYTES", "EPOCHS_MAX", "Delegation"]

DELEGATION_MAX_BYTES: Final = 512 << 10
EPOCHS_MAX: Final = 256  # in one file
_FORMAT: Final = "gdp-delegation-1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Delegation:
    """The rights of a node on a name, and their proofs.

    Args:
        chain: AdCerts from the owner to the node, signed statements.
        grants: epoch to signed statement.
        metadata: the meaning of the name, if the issuer added it; its hash belongs to the name.
    """

    subject: Subject
    node: Name
    rights: frozenset[Right]
    chain: tuple[bytes, ...]
    grants: Mapping[int, bytes]
    metadata: Metadata | None = None

    @property
    def name(self) -> Name:
        """Return the name that it is about."""
        return self.subject.name

    def to_wire(self) -> bytes:
        """Return the file's bytes: deterministic CBOR. Raises ``LocalError``: more epochs than a file may hold."""
        if len(self.grants) > EPOCHS_MAX:
            raise LocalError(f"a delegation holds at most {EPOCHS_MAX} epochs")
        grants = [{"epoch": epoch, "grant": wire} for epoch, wire in sorted(self.grants.items())]
        body = {
            **self.subject.to_fields(),
            "format": _FORMAT,
            "name": self.subject.name,
            "node": self.node,
            "rights": rights_to_wire(self.rights),
            "chain": list(self.chain),
            "grants": grants,
        }
        if self.metadata is not None:
            body["metadata"] = dict(self.metadata)
        return encode(body)

    @classmethod
    def from_wire(cls, wire: bytes) -> Delegation:
        """Read a file; signatures are not checked, see ``verify``.

        Raises:
            StatementError: MALFORMED or WRONG_NAME.
        """
        value = decode(wire, DELEGATION_MAX_BYTES)
        fields = Fields(value if isinstance(value, dict) else {})
        if fields.text("format") != _FORMAT:
            raise StatementError(DropReason.MALFORMED, "a delegation of another format")
        subject = Subject.from_fields(fields, fields.name("name"))
        return cls(
            subject=subject,
            node=fields.name("node"),
            rights=rights_from_fields(fields, "rights"),
            chain=tuple(fields.byte_strings("chain", CHAIN_MAX)),
            grants=MappingProxyType(
                {each.uint("epoch", EPOCH_MAX): each.bytes_("grant") for each in fields.maps("grants", EPOCHS_MAX)}
            ),
            metadata=_metadata(fields.map_("metadata"), subject) if "metadata" in fields else None,
        )

    def verify(self, identity: Identity, unix_s: float) -> None:
        """Return if the node now has all rights in the file. Revocations are checked elsewhere.

        Raises:
            StatementError: NOT_FOR_US, NOT_DELEGATED, EXPIRED, BAD_SIGNATURE, WRONG_NAME or MALFORMED.
        """
        if self.node != identity.name:
            raise StatementError(DropReason.NOT_FOR_US, "a delegation to another node")
        if not self.chain and self.subject.owner_key != identity.key.public.compressed:
            raise StatementError(DropReason.NOT_DELEGATED, "no delegation from the owner")
        chain = Chain.traverse(self.chain, self.subject, identity.subject, AdCertCache(CHAIN_MAX))
        for right in self.rights:
            chain.check(right, unix_s)

    def open(self, identity: Identity) -> dict[int, Grant]:
        """Return the topic's secrets by epoch.

        Raises:
            StatementError: a grant is not valid, or is not for this node and name.
            LocalError: a library without the KEM.
        """
        chain = Chain.traverse(self.chain, self.subject, identity.subject, AdCertCache(CHAIN_MAX))
        givers = [link.delegate_key for link in chain.links[:-1]]
        opened = {epoch: open_grant(identity, wire, givers) for epoch, wire in self.grants.items()}
        for epoch, grant in opened.items():
            if (grant.name, grant.epoch) != (self.name, epoch):
                raise StatementError(DropReason.MALFORMED, "a grant for another name or epoch")
        return opened


def _metadata(fields: Fields, subject: Subject) -> Metadata:
    items: dict[str, str | int] = {}
    for key, value in fields.items():
        if isinstance(value, bool) or not isinstance(value, str | int):
            raise StatementError(DropReason.MALFORMED, "metadata of the wrong form")
        items[key] = value
    try:
        metadata = Metadata(items)
    except LocalError as error:
        raise StatementError(DropReason.MALFORMED, str(error)) from error
    if metadata.digest() != subject.digest:
        raise StatementError(DropReason.WRONG_NAME, "metadata of another name")
    return metadata
