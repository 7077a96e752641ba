"""Delegation: all that a node received from an owner for one name, in one file.

Sans-I/O; ``gdp/stores/files`` stores it. It holds proofs and sealed secrets, and is of use only with the node's keys.
The metadata may be added in plain, so that the node's operator sees its purpose: the file is private to the node.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Annotated, Final, cast

from gdp.crypto.cbor import Value
from gdp.crypto.identity import Identity
from gdp.crypto.schema import MAP, NAME, STATEMENT, FieldSet, Keyed, inner, many, mapped, one_of, uint
from gdp.crypto.subject import NAMED_SUBJECT, Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CHAIN_MAX
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.adcert import CHAIN, AdCertCache, Chain
from gdp.trust.grants import EPOCH_MAX, Grant, open_grant
from gdp.trust.right import RIGHTS, Right

DELEGATION_MAX_BYTES: Final = 512 << 10
EPOCHS_MAX: Final = 256  # in one file


class _Format(str, Enum):
    DELEGATION_1 = "gdp-delegation-1"


@dataclass(frozen=True, slots=True)
class _Epoch(FieldSet):
    epoch: Annotated[int, Keyed("epoch", uint(EPOCH_MAX))]
    grant: Annotated[bytes, Keyed("grant", STATEMENT)]


def _metadata(items: Mapping[str, Value]) -> Metadata:
    try:
        return Metadata(cast("Mapping[str, str | int]", items))
    except LocalError as error:
        raise ValueError(str(error)) from error


_METADATA: Final = mapped(MAP, _metadata, dict)
_GRANTS: Final = mapped(
    many(inner(_Epoch), EPOCHS_MAX),
    lambda grants: MappingProxyType({each.epoch: each.grant for each in grants}),
    lambda grants: tuple(_Epoch(*each) for each in sorted(grants.items())),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Delegation(FieldSet):
    """The rights of a node on a name, and their proofs.

    Args:
        chain: AdCerts from the owner to the node, signed statements.
        grants: epoch to signed statement.
        metadata: the meaning of the name, if the issuer added it; its hash belongs to the name.
    """

    MAX_BYTES = DELEGATION_MAX_BYTES
    subject: Annotated[Subject, NAMED_SUBJECT]
    node: Annotated[Name, Keyed("node", NAME)]
    rights: Annotated[frozenset[Right], Keyed("rights", RIGHTS)]
    chain: Annotated[tuple[bytes, ...], Keyed("chain", CHAIN)]
    grants: Annotated[Mapping[int, bytes], Keyed("grants", _GRANTS)]
    metadata: Annotated[Metadata | None, Keyed("metadata", _METADATA, absent=None, is_omitted=True)] = None
    format: Annotated[_Format, Keyed("format", one_of(_Format))] = _Format.DELEGATION_1

    @property
    def name(self) -> Name:
        """Return the name that it is about."""
        return self.subject.name

    def to_wire(self) -> bytes:
        """Return the file's bytes: deterministic CBOR. Raises ``LocalError``: more epochs than a file may hold."""
        if len(self.grants) > EPOCHS_MAX:
            raise LocalError(f"a delegation holds at most {EPOCHS_MAX} epochs")
        return self.to_cbor()

    @classmethod
    def from_wire(cls, wire: bytes) -> Delegation:
        """Read a file; signatures are not checked, see ``verify``.

        Raises:
            StatementError: MALFORMED or WRONG_NAME.
        """
        return cls.from_cbor(wire)

    def check(self) -> None:
        """Return if the metadata is the name's. Raises ``StatementError``: WRONG_NAME."""
        if self.metadata is not None and self.metadata.digest() != self.subject.digest:
            raise StatementError(DropReason.WRONG_NAME, "metadata of another name")

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
