"""Machines of a cluster as members of the border's domain: their tokens, delegations and removal.

I/O, on the border: the domain's registry and the owner's keys. Delegations go as mail through the enrolment server to
the machine's agent, which installs them. A token admits one leaf switch and one proxy with the machine's label, once.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fog.bootstrap.members import metadata_of, right_of
from fog.cluster import ExportedInterface
from gdp.crypto.certificates import Role
from gdp.enrolment.agent import DELEGATION_KIND
from gdp.enrolment.create import make_token
from gdp.enrolment.domain_client import DomainClient
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.registry import MachineRow, Registry
from gdp.enrolment.removal import remove_machine
from gdp.stores.issue import DAY_S, delegate
from gdp.trust.join_token import JoinRole, JoinToken
from gdp.trust.node_descriptor import NodeDescriptor

__all__ = ["DomainMembers"]


class DomainMembers:
    """Members of the domain whose directory ``gdp domain create`` made on this host.

    Raises:
        LocalError, ConfigError: no domain was created there.
        StoreError: the registry cannot be opened or read now; every method may raise this too.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._files = DomainFiles.load(directory)
        self._registry = Registry(self._files.config.state)

    def close(self) -> None:
        """Close the registry."""
        self._registry.close()

    def issue_token(self, label: str, *, valid_s: float, unix_s: float) -> JoinToken:
        """Return a token with which one machine of this label joins once.

        Raises:
            LocalError: another machine has the label, or the domain's files cannot be read.
        """
        return make_token(self._files, JoinRole.ROBOT, valid_s=valid_s, label=label, unix_s=unix_s)

    @property
    def has_relay(self) -> bool:
        """Return whether the border relays through TLS for members whose networks block UDP."""
        return bool(self._files.config.relays)

    def find(self, label: str) -> NodeDescriptor | None:
        """Return the proxy of the machine with this label; None: it has not finished joining, or was removed."""
        row = self._registry.machine_with(label)
        return None if row is None else _joined(row)

    def delegate(
        self, proxy: NodeDescriptor, carried: Iterable[ExportedInterface], *, until_unix_s: float, unix_s: float
    ) -> None:
        """Send a machine delegations to provide (serve, publish) the exported interfaces.

        Raises:
            EnrolmentError: the enrolment server cannot be reached, or refuses.
            LocalError: the owner's keys cannot be read.
        """
        days = (until_unix_s - unix_s) / DAY_S
        given = [
            delegate(
                self._files.config.owner,
                proxy,
                metadata_of(each),
                [right_of(each, gives=True)],
                days=days,
                unix_s=unix_s,
            )
            for each in carried
        ]
        with DomainClient.open(self._directory) as client:
            for each in given:
                client.send(proxy.name, DELEGATION_KIND, each.to_wire())

    def remove(self, label: str, *, unix_s: float) -> bool:
        """Withdraw a machine's token, and remove the machine from the domain; return whether it was a member.

        Its memberships are revoked, and its endpoint record leaves the border's peers, which closes the tunnel.

        Raises:
            LocalError: the domain's files cannot be read or written.
        """
        self._registry.withdraw_tokens(label)
        if self._registry.machine_with(label) is None:
            return False
        remove_machine(self._files, label, unix_s=unix_s)
        return True


def _joined(row: MachineRow) -> NodeDescriptor | None:
    """Return a machine's proxy, once all its nodes have sent their descriptors; None: it has not finished joining."""
    proxies = [each for each in row.nodes if each.role == Role.PROXY.value]
    if not proxies or any(each.card is None for each in row.nodes):
        return None
    return NodeDescriptor.from_wire(proxies[0].card or b"")
