"""Two ends of a relay connection in memory, and the members of two domains."""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable
from dataclasses import dataclass

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.links.relay_context import tls_context
from gdp.relay.admission import ClientAdmission, verified_border, verified_switch
from gdp.relay.connection import ConnectionSettings, RelayConnection
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy

NOW = 1_800_000_000.0
DAY_S = 86_400.0
SETTINGS = ConnectionSettings(mtu=1_350, keepalive_s=0.25, dead_s=1.0, queue_bytes=1 << 20)


def at(mono_s: float) -> Timestamps:
    return Timestamps(mono_s, NOW)


def domain(label: str, unix_s: float = NOW) -> CertificateAuthority:
    return CertificateAuthority.create(label, SigningKey.generate(), Validity.lasting(unix_s - 99 * DAY_S, 400 * DAY_S))


def member(
    authority: CertificateAuthority,
    label: str,
    role: Role = Role.SWITCH,
    *,
    begins_s: float = NOW - 60,
    days: float = 30,
) -> Identity:
    return NodeKeys.generate(role, label).join(authority, Validity.lasting(begins_s, days * DAY_S))


@dataclass
class Ends:
    """A border and a member with their policies."""

    border: Identity
    member: Identity
    border_policy: Policy
    member_policy: Policy
    allow: frozenset[str] | None = None
    clients_max: int = 64
    begun_s: float = 0.0  # of the connections

    def admit(self, certificate: bytes, moment: Timestamps) -> Membership:
        found = verified_switch(certificate, self.border_policy.verify_membership, moment.unix_s)
        own = self.border_policy.own
        ClientAdmission(own_domain=own, allow=self.allow, clients_max=self.clients_max).check(found, {})
        return found

    def server(self, settings: ConnectionSettings = SETTINGS) -> RelayConnection:
        context = tls_context(self.border, self.border_policy, is_server=True)
        return RelayConnection(
            context=context, is_server=True, settings=settings, authenticate=self.admit, now_s=self.begun_s
        )

    def client(
        self,
        settings: ConnectionSettings = SETTINGS,
        authenticate: Callable[[bytes, Timestamps], Membership] | None = None,
        context: ssl.SSLContext | None = None,
    ) -> RelayConnection:
        def dialled(certificate: bytes, moment: Timestamps) -> Membership:
            return verified_border(certificate, self.border.name, self.member_policy.verify_membership, moment.unix_s)

        return RelayConnection(
            context=context or tls_context(self.member, self.member_policy, is_server=False),
            is_server=False,
            settings=settings,
            authenticate=authenticate or dialled,
            now_s=self.begun_s,
        )


def ends(
    lab: CertificateAuthority | None = None,
    joining: Identity | None = None,
    allow: frozenset[str] | None = None,
    clients_max: int = 64,
) -> Ends:
    """Return a border of a domain and a member that trusts this domain; without ``joining``, one of the same domain."""
    lab = lab or domain("lab")
    return Ends(
        border=member(lab, "border"),
        member=joining or member(lab, "member"),
        border_policy=Policy(lab.root),
        member_policy=Policy(lab.root),
        allow=allow,
        clients_max=clients_max,
    )


def ends_now() -> Ends:
    """Return a border and a member whose certificates and clocks are those of this machine."""
    unix_s = time.time()
    lab = domain("lab", unix_s)
    one, other = (member(lab, label, begins_s=unix_s - 60) for label in ("border", "member"))
    return Ends(one, other, Policy(lab.root), Policy(lab.root), begun_s=time.monotonic())


def exchange(one: RelayConnection, other: RelayConnection, mono_s: float = 0.0) -> tuple[list[bytes], list[bytes]]:
    """Carry bytes both ways until neither end has more; return the frames that each received."""
    frames: tuple[list[bytes], list[bytes]] = [], []
    moves = True
    while moves:
        moves = False
        for index, (sender, receiver) in enumerate(((one, other), (other, one))):
            while data := sender.data_to_send(mono_s):
                moves = True
                frames[1 - index].extend(map(bytes, receiver.receive_bytes(data, at(mono_s))))
    return frames
