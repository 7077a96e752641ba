"""Machines of a cluster as members of a domain: their tokens, what they become, and removal.

I/O, on the host of the domain's registry. A token has the role of the planned machine: the enrolment server admits one
switch and one proxy with its label, once, and delegates to the proxy what the plan states.
"""

from __future__ import annotations

from collections.abc import Iterable

from fog.bootstrap.members import metadata_of
from fog.cluster import ExportedInterface
from gdp.crypto.certificates import Role
from gdp.enrolment.create import make_token
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.registry import MachineRow, Plan, Registry
from gdp.enrolment.removal import remove_machine
from gdp.trust.join_token import JoinRole, JoinToken
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import right_on


class DomainMembers:
    """Members of the domain with these files on this host.

    Raises:
        StoreError: the registry cannot be opened or read now; every method may raise this too.
    """

    def __init__(self, files: DomainFiles) -> None:
        self._files = files
        self._registry = Registry(files.config.state)

    def close(self) -> None:
        """Close the registry."""
        self._registry.close()

    def issue_token(
        self,
        label: str,
        carried: Iterable[ExportedInterface],
        *,
        is_gateway: bool = False,
        valid_s: float,
        until_unix_s: float,
        unix_s: float,
    ) -> JoinToken:
        """Return a token with which one machine of this label joins once.

        Args:
            carried: what the machine's proxy may provide (serve, publish).
            is_gateway: it may become the gateway of its group. Its switch is then not a leaf, because it carries
                transit traffic.
            until_unix_s: end of validity of everything issued for it.

        Raises:
            LocalError: another machine has the label, or the domain's files cannot be read.
        """
        grants = [(metadata_of(each), right_on(each.kind, gives=True)) for each in carried]
        return make_token(
            self._files,
            JoinRole.GATEWAY if is_gateway else JoinRole.MACHINE,
            valid_s=valid_s,
            label=label,
            unix_s=unix_s,
            plan=Plan(grants=grants, until_unix_s=until_unix_s),
        )

    @property
    def has_relay(self) -> bool:
        """Return whether the border relays through TLS for members whose networks block UDP."""
        return bool(self._files.config.relays)

    def find(self, label: str) -> NodeDescriptor | None:
        """Return the proxy of the machine with this label; None: it has not finished joining, or was removed."""
        row = self._registry.machine_with(label)
        return None if row is None else _joined(row)

    def misuses(self) -> list[tuple[str, str]]:
        """Return label and detail of each token that somebody else knows, until it is ``reported``."""
        return self._registry.misuses()

    def reported(self, label: str) -> None:
        """Note that the misuse of a machine's token was handled."""
        self._registry.reported(label)

    def remove(self, label: str, *, unix_s: float) -> bool:
        """Withdraw a machine's token, and remove the machine from the domain; return whether it ever was a member.

        Its memberships are revoked, and its endpoint record leaves the border's peers, which closes the tunnel. A
        repeat completes an interrupted removal.

        Raises:
            LocalError: the domain's files cannot be read or written.
        """
        self._registry.withdraw_tokens(label)
        if self._registry.machine_with(label, with_removed=True) is None:
            return False
        remove_machine(self._files, label, unix_s=unix_s)
        return True


def _joined(row: MachineRow) -> NodeDescriptor | None:
    """Return a machine's proxy, once all its nodes have sent their descriptors; None: it has not finished joining."""
    proxies = [each for each in row.nodes if each.role == Role.PROXY.value]
    if not proxies or any(each.card is None for each in row.nodes):
        return None
    return NodeDescriptor.from_wire(proxies[0].card or b"")
