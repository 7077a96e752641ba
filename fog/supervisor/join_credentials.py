"""Credentials of machines that join the border's domain: tokens, delegations and removal.

I/O; writes the domain's registry and the journal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from fog.bootstrap.bundles import joining_boot, machine_label
from fog.bootstrap.domain_members import DomainMembers
from fog.cluster import CloudNode, ClusterPlan
from fog.credentials import IssuedCredentials
from fog.machine import MachineBundle
from fog.site import Site
from fog.supervisor.core.record import Record
from fog.supervisor.event_log import EventLog
from fog.supervisor.journal import Journal
from fog.supervisor.machine_credentials import Release, end_of_credentials
from gdp.errors import GdpError, StoreError

__all__ = ["JoinCredentials"]


class JoinCredentials:
    """Issuer of join tokens, which also delegates to joined machines and removes them from the domain.

    Args:
        boot_s: seconds within which a machine must join.
    """

    def __init__(
        self, site: Site, journal: Journal, events: EventLog, members: DomainMembers, *, boot_s: float
    ) -> None:
        self._site = site
        self._journal = journal
        self._events = events
        self._members = members
        self._boot_s = boot_s
        self._failed: set[str] = set()  # labels of joined machines whose delegations could not be sent
        self._not_removed: dict[str, Record] = {}  # by label

    def make_bundle(
        self,
        plan: ClusterPlan,
        name: str,
        command: Callable[[CloudNode], Sequence[str]],
        software: Mapping[str, bytes],
        now_s: float,
        *,
        uplink: str,
    ) -> tuple[MachineBundle, float]:
        """Return a new machine's bundle with a token, and the end of validity of its credentials (Unix time).

        Raises:
            LocalError: the domain's files cannot be read, or its root certificate has expired.
        """
        del uplink  # these machines are no gateways
        until_s = end_of_credentials(self._site, now_s)
        token = self._members.issue_token(machine_label(plan.name, name), valid_s=self._boot_s, unix_s=now_s)
        boot = joining_boot(
            plan,
            name,
            command,
            token,
            lease_s=self._site.lease_s,
            has_relay=self._members.has_relay,
            software=software,
        )
        return boot, until_s

    def has_reports(self) -> bool:
        """Return whether a machine has joined since the last ``handle_reports``."""
        try:
            labels = {_label(each) for each in self._awaited()} - self._failed
            return any(self._members.find(each) is not None for each in labels)
        except StoreError:  # the next reconciliation reports it
            return False

    def handle_reports(self, release: Release, now_s: float) -> None:
        """Record the machines that joined, and send their delegations; what failed before is tried again."""
        del release  # a token that was used before is refused by the domain, and the machine does not serve
        for gone in list(self._not_removed.values()):
            self.revoke(gone, now_s)
        self._failed.clear()
        for record in self._awaited():
            proxy = self._members.find(_label(record))
            if proxy is None:
                continue
            cluster, until_s = record.spec.cluster, record.issued_credentials.until_unix_s
            plan = self._journal.cluster(cluster).plan
            try:
                self._members.delegate(proxy, plan.carried, until_unix_s=until_s, unix_s=now_s)
            except GdpError as error:
                self._events.add_trouble(cluster, f"{record.name}: no delegations: {error}", key=_label(record))
                self._failed.add(_label(record))
                continue
            self._events.clear_trouble(_label(record))
            known = replace(record, issued_credentials=IssuedCredentials(proxy.name.to_text(), until_s))
            self._events.put(known, "enrolled", f"as {known.issued_credentials.proxy[:16]}", now_s)

    def revoke(self, record: Record, now_s: float) -> None:
        """Remove a machine from the domain, and withdraw its token."""
        label = _label(record)
        try:
            self._members.remove(label, unix_s=now_s)
        except GdpError as error:
            if label not in self._not_removed:
                self._journal.write_event(now_s, record.spec.cluster, record.name, "trouble", f"not removed: {error}")
            self._not_removed[label] = record
        else:
            self._not_removed.pop(label, None)

    def _awaited(self) -> list[Record]:
        """Return the machines that have not joined as far as the journal says."""
        records = (
            each
            for cluster in self._journal.clusters()
            for each in self._journal.machines(cluster.plan.name, gone=False)
        )
        return [each for each in records if not each.issued_credentials.proxy and not each.is_released]


def _label(record: Record) -> str:
    return machine_label(record.spec.cluster, record.name)
