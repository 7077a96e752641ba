"""Credentials of machines of this host: enrolment tickets, issued credentials and revocation.

I/O; writes tickets, the journal and revocations.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, TypeAlias

from fog.bootstrap.bundles import machine_boot, machine_seats
from fog.bootstrap.members import revoke_credentials
from fog.bootstrap.robot_config import reload
from fog.bootstrap.tickets import News, Report, Tickets
from fog.cluster import CloudNode, ClusterPlan
from fog.machine import MachineBundle
from fog.site import Site
from fog.supervisor.core.record import Outcome, Record
from fog.supervisor.event_log import EventLog
from fog.supervisor.journal import Journal
from gdp.config.config import SwitchConfig
from gdp.errors import LocalError
from gdp.stores.issue import DAY_S
from gdp.stores.keyring import load_domain
from gdp.trust.bootstrap_ticket import TOKEN_BYTES, Ticket

__all__ = ["CredentialIssuer", "MachineCredentials", "Release", "end_of_credentials"]

log = logging.getLogger(__name__)

# arguments: plan, name of the machine, the provider's id
Release: TypeAlias = "Callable[[ClusterPlan, str, str], None]"


class CredentialIssuer(Protocol):
    """Issuer of the credentials of a site's machines, which also revokes them."""

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
        """Return a new machine's bundle, and the end of validity of its credentials (Unix time)."""

    def has_reports(self) -> bool:
        """Return whether ``handle_reports`` has something to do at once."""

    def handle_reports(self, release: Release, now_s: float) -> None:
        """Record the machines that became members, and release those whose token was misused."""

    def revoke(self, record: Record, now_s: float) -> None:
        """Revoke the memberships of a machine, and make its token useless."""


def end_of_credentials(site: Site, now_s: float) -> float:
    """Return the end of validity of a new machine's credentials (Unix time).

    Raises:
        LocalError: the domain is missing, or its root certificate has expired.
    """
    root = load_domain(site.authority.domain).root
    until_s = min(now_s + site.credential_days * DAY_S, float(root.validity.not_after_unix_s))
    if until_s <= now_s:
        raise LocalError("the root of the domain has run out")
    return until_s


class MachineCredentials:
    """Issuer of machine credentials, which also revokes them; ``boot_s``: seconds within which a machine must enrol."""

    def __init__(self, site: Site, journal: Journal, events: EventLog, tickets: Tickets, *, boot_s: float) -> None:
        self._site = site
        self._journal = journal
        self._events = events
        self._tickets = tickets
        self._boot_s = boot_s

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
        """Return a new machine's bundle with a ticket, and the end of validity of its credentials (Unix time).

        Raises:
            LocalError: the domain is missing, or its root certificate has expired.
        """
        ticket, until_s = self._issue_ticket(plan, name, now_s, is_gateway=bool(uplink))
        boot = machine_boot(
            self._site.authority,
            plan,
            name,
            command,
            ticket,
            iface=self._site.machine_iface,
            lease_s=self._site.lease_s,
            uplink=uplink,
            software=software,
        )
        return boot, until_s

    def has_reports(self) -> bool:
        """Return False: the supervisor polls machines of this host often enough."""
        return False

    def _issue_ticket(self, plan: ClusterPlan, name: str, now_s: float, *, is_gateway: bool) -> tuple[Ticket, float]:
        until_s = end_of_credentials(self._site, now_s)
        ticket = self._tickets.issue(
            plan.name,
            name,
            machine_seats(plan, name, is_gateway=is_gateway),
            secrets.token_bytes(TOKEN_BYTES),
            addresses=[self._site.enrolment_url],
            unix_s=now_s,
            expires_unix_s=now_s + self._boot_s,
            until_unix_s=until_s,
        )
        return ticket, until_s

    def handle_reports(self, release: Release, now_s: float) -> None:
        """Record the machines that enrolled, and release machines whose token was misused."""
        for news in self._tickets.pending_reports():
            record = next((each for each in self._journal.machines(news.cluster) if each.name == news.machine), None)
            if record is not None:
                if news.issued_credentials is not None:
                    record = replace(record, issued_credentials=news.issued_credentials)
                if news.report is Report.ENROLLED:
                    self._events.put(record, "enrolled", news.detail, now_s)
                    if record.is_gone or record.is_released:
                        self.revoke(record, now_s)
                else:
                    self._handle_misused(record, news, release, now_s)
            self._tickets.taken(news)

    def revoke(self, record: Record, now_s: float) -> None:
        """Revoke the memberships of a machine, and delete its ticket."""
        self._tickets.delete(record.spec.cluster, record.name)
        if self._site.revocations is None:
            return
        folder, switch = self._site.revocations
        issued_credentials = record.issued_credentials
        domain = self._site.authority.domain
        try:
            if revoke_credentials(
                domain,
                folder,
                issued_credentials.fingerprints,
                until_unix_s=issued_credentials.until_unix_s,
                unix_s=now_s,
            ):
                config = SwitchConfig.load(switch)
                reload(config.identity, config.control_socket)
        except LocalError as error:
            self._journal.write_event(now_s, record.spec.cluster, record.name, "trouble", f"not revoked: {error}")

    def _handle_misused(self, record: Record, news: News, release: Release, now_s: float) -> None:
        log.error("token misused cluster=%s machine=%s: %s", news.cluster, news.machine, news.detail)
        if not self._site.enrolment.revoke_misused or record.is_gone:
            self._events.put(record, "alarm", news.detail, now_s)
            return
        ending = Outcome.FAILED if record.served_unix_s is None else Outcome.PREEMPTED
        known = replace(record, released_unix_s=now_s, ending=ending, reason="its enrolment token was misused")
        self._events.put(known, "alarm", f"{news.detail}; it is revoked and replaced", now_s)
        self.revoke(known, now_s)
        if record.id:
            release(self._journal.cluster(news.cluster).plan, news.machine, record.id)
