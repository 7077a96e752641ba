"""Issued delegations of one owner, with what renewal and revocation need.

I/O. One private file for each name and node, ``OWNER/issued/NAME.NODE.json``. A file of a revoked delegation stays, so
that nothing gives the same node the name again by itself.
"""

from __future__ import annotations

import base64
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from gdp.config.offered_qos import OfferedQos
from gdp.config.schema import Section, first_fault
from gdp.errors import LocalError
from gdp.intervals import DAY_S
from gdp.limits import CLOCK_SKEW_S
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.sharing.state import links_of
from gdp.stores.files import private, read_private, write_all
from gdp.stores.issue import delegate
from gdp.stores.keyring import load_owner
from gdp.trust.delegation import Delegation
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right

RENEW_SHARE: Final = 2 / 3  # of its life, after which a delegation is renewed
_ISSUED: Final = "issued"


class OpenLink(Section):
    """A link that is valid until it expires or is revoked: SHA-256 of its signed part, hex."""

    fingerprint: str
    until_unix_s: int


class IssuedDelegation(Section):
    """The latest delegation of one name to one node.

    Args:
        label: of the node.
        node: its name, 64 hex digits.
        wire, card: the delegation and the node's descriptor, base64.
        days: life of this delegation, and of each that renews it.
        links: of this and of earlier delegations that have not expired.
        is_own: whether the node is the proxy of this machine.
        is_delivered: whether it was installed here, or left in the node's mailbox.
        is_revoked: whether the owner took it back.
        qos: of the topic, as last sent to the node; None: not yet.
        is_exposed: whether the name is exposed, as the node knows it; None: it never was, here or by another node.
    """

    label: str
    node: str
    wire: str
    card: str
    issued_unix_s: float
    until_unix_s: int
    days: float
    links: tuple[OpenLink, ...]
    is_own: bool = False
    is_delivered: bool = False
    is_revoked: bool = False
    qos: OfferedQos | None = None
    is_exposed: bool | None = None

    @property
    def delegation(self) -> Delegation:
        """Return the delegation."""
        return _delegation(self.wire)

    @property
    def descriptor(self) -> NodeDescriptor:
        """Return the node's descriptor at the time of issue."""
        return NodeDescriptor.from_wire(base64.b64decode(self.card))

    @property
    def metadata(self) -> Metadata:
        """Return the meaning of the name."""
        metadata = self.delegation.metadata
        if metadata is None:
            raise LocalError("an issued delegation without metadata")
        return metadata

    def is_due(self, unix_s: float) -> bool:
        """Return whether it is time to renew it."""
        return not self.is_revoked and unix_s >= self.issued_unix_s + RENEW_SHARE * self.days * DAY_S


@lru_cache(maxsize=4_096)
def _delegation(wire: str) -> Delegation:
    """Return a delegation; the upkeep looks at each of them in every pass."""
    return Delegation.from_wire(base64.b64decode(wire))


class IssuedStore:
    """Issued delegations in an owner's directory; ``owner``: directory of the owner's keys."""

    def __init__(self, owner: Path) -> None:
        self.owner = owner
        self._folder = owner / _ISSUED

    def __iter__(self) -> Iterator[IssuedDelegation]:
        for file in sorted(self._folder.glob("[!.]*.json")):
            yield self._load(file)

    def find(self, name: Name, node: Name) -> IssuedDelegation | None:
        """Return the latest delegation of a name to a node. Raises ``LocalError``: the file is invalid."""
        file = self._file(name.to_text(), node.to_text())
        return self._load(file) if file.exists() else None

    def issue(
        self,
        descriptor: NodeDescriptor,
        label: str,
        metadata: Metadata,
        rights: Collection[Right],
        epochs: Iterable[int],
        *,
        days: float,
        is_own: bool,
        unix_s: float,
    ) -> IssuedDelegation:
        """Delegate a name to a node and record it; rights of a present delegation stay with it.

        Raises:
            LocalError: the owner's keys are missing, or the record cannot be written.
        """
        before = self.find(load_owner(self.owner).subject(metadata).name, descriptor.name)
        held = None if before is None or before.is_revoked else before.delegation
        given = delegate(
            self.owner,
            descriptor,
            metadata,
            frozenset(rights) | (frozenset() if held is None else held.rights),
            epochs,
            days=days,
            unix_s=unix_s,
        )
        link = links_of(given)[-1]
        kept = () if before is None or before.is_revoked else before.links
        issued = IssuedDelegation(
            label=label,
            node=descriptor.name.to_text(),
            wire=base64.b64encode(given.to_wire()).decode(),
            card=base64.b64encode(descriptor.wire).decode(),
            issued_unix_s=unix_s,
            until_unix_s=link.validity.not_after_unix_s,
            days=days,
            links=(
                *(each for each in kept if each.until_unix_s + CLOCK_SKEW_S > unix_s),
                OpenLink(fingerprint=link.fingerprint.hex(), until_unix_s=link.validity.not_after_unix_s),
            ),
            is_own=is_own,
            is_exposed=None if before is None or before.is_revoked else before.is_exposed,
        )
        self.save(issued)
        return issued

    def epochs(self, name: Name) -> set[int]:
        """Return the epochs of a name that any node got. Raises ``LocalError``: a file is invalid."""
        records = map(self._load, self._folder.glob(f"{name.to_text()}.*.json"))
        return {epoch for each in records if not each.is_revoked for epoch in each.delegation.grants}

    def rotate(self, issued: IssuedDelegation, descriptor: NodeDescriptor, epochs: Iterable[int]) -> IssuedDelegation:
        """Give a delegation other epochs; its rights and life stay. Raises ``LocalError``: as ``issue``."""
        given = load_owner(self.owner).regrant(issued.delegation, descriptor, epochs)
        wire = base64.b64encode(given.to_wire()).decode()
        rotated = issued.model_copy(update={"wire": wire, "is_delivered": False})
        self.save(rotated)
        return rotated

    def renew(
        self, issued: IssuedDelegation, descriptor: NodeDescriptor, epochs: Iterable[int], unix_s: float
    ) -> IssuedDelegation:
        """Issue a delegation again, with the same rights and life. Raises ``LocalError``: as ``issue``."""
        given = issued.delegation
        return self.issue(
            descriptor,
            issued.label,
            issued.metadata,
            given.rights,
            epochs,
            days=issued.days,
            is_own=issued.is_own,
            unix_s=unix_s,
        )

    def revocations(self, issued: IssuedDelegation, unix_s: float) -> list[bytes]:
        """Return the revocations of all delegations of a name to a node. Raises ``LocalError``: no owner's keys."""
        owner, subject = load_owner(self.owner), issued.delegation.subject
        return [
            owner.revoke(subject, bytes.fromhex(each.fingerprint), each.until_unix_s)
            for each in issued.links
            if each.until_unix_s + CLOCK_SKEW_S > unix_s
        ]

    def save(self, issued: IssuedDelegation) -> None:
        """Write a record, in place of an earlier one. Raises ``LocalError``: the folder cannot be written."""
        file = self._file(issued.delegation.name.to_text(), issued.node)
        write_all(self._folder, {file.name: private(issued.model_dump_json().encode())}, force=True)

    def _file(self, name: str, node: str) -> Path:
        return self._folder / f"{name}.{node}.json"

    def _load(self, file: Path) -> IssuedDelegation:
        try:
            return IssuedDelegation.model_validate_json(read_private(file))
        except ValidationError as error:
            raise LocalError(f"{file}: not a record of a delegation: {first_fault(error)}") from error
