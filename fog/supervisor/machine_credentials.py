"""Credentials of machines: join tokens, misuse of these, and removal from the domain.

I/O; writes the domain's registry, the journal and revocations.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

from fog.bootstrap.bundles import machine_boot, machine_label
from fog.bootstrap.domain_members import DomainMembers
from fog.bootstrap.robot_config import reload
from fog.cluster import CloudNode, ClusterPlan
from fog.machine import MachineBundle
from fog.site import Site
from fog.supervisor.core.record import IssuedCredentials, Outcome, Record
from fog.supervisor.event_log import EventLog
from fog.supervisor.journal import Journal
from gdp.config.config import SwitchConfig
from gdp.errors import GdpError, LocalError, StoreError
from gdp.intervals import DAY_S
from gdp.stores.keyring import load_domain

log = logging.getLogger(__name__)

# arguments: plan, name of the machine, the provider's id
Release: TypeAlias = "Callable[[ClusterPlan, str, str], None]"


class MachineCredentials:
    """Issuer of join tokens, which also removes machines from the domain.

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
        until_s = self._end_of_credentials(now_s)
        token = self._members.issue_token(
            machine_label(plan.name, name),
            plan.carried,
            is_gateway=bool(uplink),
            valid_s=self._boot_s,
            until_unix_s=until_s,
            unix_s=now_s,
        )
        boot = machine_boot(
            plan,
            name,
            command,
            token,
            iface=self._site.config.device if self._site.border is None else "",
            uplink=uplink,
            lease_s=self._site.config.lease_s,
            has_relay=self._members.has_relay,
            software=software,
        )
        return boot, until_s

    def has_reports(self) -> bool:
        """Return whether a machine has joined, or a token was misused, since the last ``handle_reports``."""
        try:
            joined = any(self._members.find(_label(each)) is not None for each in self._awaited())
            return joined or bool(self._members.misuses())
        except StoreError:  # the next reconciliation reports it
            return False

    def handle_reports(self, release: Release, now_s: float) -> None:
        """Record the machines that joined, and release those whose token was misused; failed removals are repeated."""
        for gone in list(self._not_removed.values()):
            self.revoke(gone, now_s)
        for record in self._awaited():
            proxy = self._members.find(_label(record))
            if proxy is None:
                continue
            until_s = record.issued_credentials.until_unix_s
            known = replace(record, issued_credentials=IssuedCredentials(proxy.name.to_text(), until_s))
            self._events.put(known, "enrolled", f"as {known.issued_credentials.proxy[:16]}", now_s)
            if known.is_released:
                self.revoke(known, now_s)
        for label, detail in self._members.misuses():
            for record in self._records():
                if _label(record) == label:
                    self._handle_misused(record, detail, release, now_s)
            self._members.reported(label)

    def revoke(self, record: Record, now_s: float) -> None:
        """Revoke the memberships of a machine, and make its token useless."""
        label = _label(record)
        try:
            remove_member(self._site, self._members, label, now_s)
        except GdpError as error:
            if label not in self._not_removed:
                self._journal.write_event(now_s, record.spec.cluster, record.name, "trouble", f"not removed: {error}")
            self._not_removed[label] = record
        else:
            self._not_removed.pop(label, None)

    def _end_of_credentials(self, now_s: float) -> float:
        root = load_domain(self._site.authority.domain).root
        until_s = min(now_s + self._site.config.credential_days * DAY_S, float(root.validity.not_after_unix_s))
        if until_s <= now_s:
            raise LocalError("the root of the domain has run out")
        return until_s

    def _handle_misused(self, record: Record, detail: str, release: Release, now_s: float) -> None:
        cluster = record.spec.cluster
        log.error("token misused cluster=%s machine=%s: %s", cluster, record.name, detail)
        if not self._site.config.enrolment.revoke_misused or record.is_gone:
            self._events.put(record, "alarm", detail, now_s)
            return
        ending = Outcome.FAILED if record.served_unix_s is None else Outcome.PREEMPTED
        known = replace(record, released_unix_s=now_s, ending=ending, reason="its enrolment token was misused")
        self._events.put(known, "alarm", f"{detail}; it is revoked and replaced", now_s)
        self.revoke(known, now_s)
        if record.id:
            release(self._journal.cluster(cluster).plan, record.name, record.id)

    def _records(self, *, gone: bool = True) -> list[Record]:
        return [
            each
            for cluster in self._journal.clusters()
            for each in self._journal.machines(cluster.plan.name, gone=gone)
        ]

    def _awaited(self) -> list[Record]:
        """Return the machines that have not joined as far as the journal says."""
        return [each for each in self._records(gone=False) if not each.issued_credentials.proxy]


def remove_member(site: Site, members: DomainMembers, label: str, now_s: float) -> None:
    """Remove a machine from the domain, and make the switch flood the revocations.

    Raises:
        GdpError: files cannot be read or written now; a repeat completes the removal.
    """
    if members.remove(label, unix_s=now_s) and site.border is None and site.revocations is not None:
        config = SwitchConfig.load(site.revocations[1])
        reload(config.identity, config.control_socket)


def _label(record: Record) -> str:
    return machine_label(record.spec.cluster, record.name)
