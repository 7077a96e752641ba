"""Domain in the present, for stores whose servers have a clock of their own, and RIBs over each kind of store."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from gdp.control.rib_statements import AdvertiseAck, Query, RelayedStatement, Response
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, parse
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.rib.outbox import OutgoingStatement
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore, Store
from gdp.sansio import Timestamps
from gdp.stores.snapshot import Snapshot
from gdp.trust.advertisement import UnverifiedAdvertisement, Withdrawal
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert

EVIDENCE_S = 3_600  # for which advertisements can be proven: the RtCert ends before the memberships


@dataclass
class Site:
    """One domain with a switch, a robot and two RIBs."""

    unix_s: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        self.validity = Validity.lasting(self.unix_s, 86_400)
        self.authority = CertificateAuthority.create("site", SigningKey.generate(), self.validity)
        self.switch, self.robot = self.node(Role.SWITCH, "switch"), self.node(Role.PROXY, "robot")
        self.ribs = self.node(Role.RIB, "one"), self.node(Role.RIB, "two")
        self.rtcert = RtCert.make(self.robot, self.switch.name, Validity.lasting(self.unix_s, EVIDENCE_S))

    def node(self, role: Role, label: str) -> Identity:
        return NodeKeys.generate(role, label).join(self.authority, self.validity)

    def policy(self) -> Policy:
        return Policy(self.authority.root)

    def now(self, later_s: float = 0.0) -> Timestamps:
        return Timestamps(1_000.0 + later_s, self.unix_s + later_s)

    def subject(self, name: str) -> Subject:
        return Subject.of(Metadata({"kind": "topic", "name": name}), self.robot.key.public.compressed)

    def relay(self, name: str, sequence: int, lease_s: float = 60.0) -> bytes:
        wire = UnverifiedAdvertisement(
            subject=self.subject(name),
            right=Right.PUBLISH,
            rtcert=self.rtcert,
            sequence=sequence,
            incarnation=1,
            lease_ms=round(lease_s * 1_000),
            is_global=False,
        ).signed(self.robot)
        return self.relayed(wire)

    def withdrawal(self, name: str, sequence: int) -> bytes:
        return self.relayed(
            Withdrawal(self.subject(name).name, Right.PUBLISH, sequence).to_wire(self.robot.name, self.robot.key)
        )

    def relayed(self, statement: bytes) -> bytes:
        return RelayedStatement(statement, (), self.switch.membership).to_wire(self.switch.name, self.switch.key)

    def query(self, name: str, watch_s: float = 0.0) -> bytes:
        query = Query(self.subject(name).name, watch_s)
        return query.to_wire(self.switch.name, self.switch.key, self.switch.membership)


class Pair:
    """Two RIBs of a domain; ``sync`` lets the second learn the advertisements of the first."""

    def __init__(self, site: Site, stores: tuple[Store, Store], peers: tuple[Name, ...] = ()) -> None:
        self.site = site
        self.one, self.two = (
            RibCore(identity, site.policy(), store, RibSettings(peers=peers))
            for identity, store in zip(site.ribs, stores, strict=True)
        )
        self.sent: list[OutgoingStatement] = []

    def give(self, rib: RibCore, wire: bytes, later_s: float = 0.0) -> list[OutgoingStatement]:
        """Hand a statement of the switch to a RIB; return the statements back to the switch."""
        rib.receive_all([(wire, self.site.switch.name)], self.site.now(later_s))
        return self.take(rib)

    def take(self, rib: RibCore) -> list[OutgoingStatement]:
        letters = rib.statements_to_send()
        self.sent += [outgoing for outgoing in letters if outgoing.to != self.site.switch.name]
        return [outgoing for outgoing in letters if outgoing.to == self.site.switch.name]

    def sync(self, later_s: float = 0.0) -> list[OutgoingStatement]:
        """Return the second RIB's statements to the switch about it."""
        raise NotImplementedError

    def wait_until(self, later_s: float) -> None:
        """Let that time come for servers that have a clock of their own."""

    def close(self) -> None:
        pass


class MemoryPair(Pair):
    """Two stores in memory, replicated."""

    def __init__(self, site: Site) -> None:
        super().__init__(site, (MemoryStore(), MemoryStore()), tuple(identity.name for identity in site.ribs))

    def sync(self, later_s: float = 0.0) -> list[OutgoingStatement]:
        reported = self.take(self.two)
        now = self.site.now(later_s)
        by_name = {identity.name: rib for identity, rib in zip(self.site.ribs, (self.one, self.two), strict=True)}
        for rib in by_name.values():
            rib.connected(now)
            rib.handle_timer(now)
            reported += self.take(rib)
        while self.sent:
            outgoing = self.sent.pop(0)
            sender = parse(outgoing.statement).signer
            by_name[outgoing.to].receive(outgoing.statement, sender, now)
            reported += self.take(by_name[outgoing.to])
        return reported


class SnapshotPair(Pair):
    """Second RIB that reads what the first wrote to disk."""

    def __init__(self, site: Site, path: Path) -> None:
        self._path = path
        self.memory = MemoryStore()
        self.memory.changes = set()
        super().__init__(site, (self.memory, MemoryStore()))

    def sync(self, later_s: float = 0.0) -> list[OutgoingStatement]:
        now = self.site.now(later_s)
        writer = Snapshot(self._path)
        writer.start()
        assert self.memory.changes is not None
        writer.write([(key, self.one.state.entry_of(key, now.mono_s)) for key in self.memory.changes], now.unix_s)
        self.memory.changes.clear()
        writer.close()
        for entries in Snapshot(self._path).load(now.unix_s):
            self.two.load(entries, now)
        return self.take(self.two)


def acks(letters: list[OutgoingStatement]) -> list[AdvertiseAck]:
    found = [parse(outgoing.statement) for outgoing in letters]
    return [AdvertiseAck.from_fields(each.fields) for each in found if each.type is StatementType.ADVERTISE_ACK]


def answers(letters: list[OutgoingStatement]) -> list[Response]:
    found = [parse(outgoing.statement) for outgoing in letters]
    return [Response.from_fields(each.fields) for each in found if each.type is StatementType.ANSWER]
