"""Issuing of memberships in the site's domain and of the owner's delegations, to the robot's side and to gateways.

I/O; reads the domain's and the owner's private keys. Keys of these members are generated here and leave nothing on
disk; machines generate their own keys, and join (``domain_members``).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from fog.cluster import ExportedInterface
from gdp.crypto.certificates import Role
from gdp.metadata import Metadata
from gdp.stores.issue import delegate, make_node
from gdp.stores.keyring import CARD, OWNER_PUBLIC, save_delegation
from gdp.trust.right import right_on


@dataclass(frozen=True, slots=True)
class Authority:
    """Issuer of memberships and delegations: the directories of a domain and of an owner.

    Args:
        scratch: folder for temporary files; leftovers of a killed process may be deleted.
    """

    domain: Path
    owner: Path
    scratch: Path | None = None

    def enrol(self, role: Role, label: str, folder: str, *, days: float) -> dict[str, bytes]:
        """Return the files of a new member whose keys are generated here, private, by their paths below ``folder``.

        Raises:
            LocalError: the domain or the owner is missing, or the root certificate has expired.
        """
        with tempfile.TemporaryDirectory(prefix="gdp-fog-", dir=self.scratch) as scratch:
            node = Path(scratch) / "node"
            make_node(node, role, label, self.domain, days=days)
            paths = [each for each in node.rglob("*") if each.is_file()]
            return {f"{folder}/{each.relative_to(node)}": each.read_bytes() for each in paths}

    def grant_access(self, node: Path, delegations: Path, carried: Iterable[ExportedInterface], *, days: float) -> None:
        """Delegate to a node of the robot's side to use (call, read) interfaces; earlier delegations are replaced.

        Raises:
            LocalError: as ``enrol``, or the node's directory has no node descriptor.
        """
        for each in carried:
            given = delegate(self.owner, node / CARD, metadata_of(each), [right_on(each.kind, gives=False)], days=days)
            save_delegation(delegations, given, force=True)

    @property
    def owner_key(self) -> Path:
        """Return the path of the owner's public key."""
        return self.owner / OWNER_PUBLIC


def metadata_of(carried: ExportedInterface) -> Metadata:
    """Return the metadata that the overlay name of a service, action or topic hashes."""
    own = {"kind": carried.kind, "name": carried.name, "type": carried.type_name}
    more = carried.options.get("metadata", {})
    return Metadata({**own, **more} if isinstance(more, dict) else own)
