"""Simulation of a topology in memory: domains with keys, switches, RIBs and members, ready to run.

No I/O. ``namespaces`` realises the same topology with kernel namespaces and real processes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, TypeVar

from cryptography.hazmat.primitives.asymmetric import ec

from gdp.client.participant import Participant, Topic
from gdp.client.rib_host import RibHost
from gdp.control.hello import NodeSettings
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SoftwareKey
from gdp.crypto.validity import Validity
from gdp.intervals import ADVERTISEMENT, NEIGHBOUR, SCAPY_KEEPALIVE_MS
from gdp.journal.incident import Incident
from gdp.journal.journal import Journal
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.trust.domain import Policy
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.owner import Owner
from gdp.trust.right import Right
from lab.network import EPOCH_UNIX_S, SimLink, SimNetwork
from lab.topology import Attachment, Topology

_C = TypeVar("_C", SwitchCore, RibHost, Participant)
_YEAR_S = 365 * 86_400
_ORDER: Final = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551  # of P-256


@dataclass(slots=True, kw_only=True)
class Simulation:
    """A running network in memory.

    Args:
        topology: what to build. A node has the name of its switch, or ``switch/device`` if it is attached to one.
        trusts: for each domain label, the labels it trusts; None: all domains trust each other.
        transits: for a domain label, the labels through which its traffic may pass; by default all trusted ones.
        delay_s: of every link between switches.
        lease_s: of advertisements and watches.
        lead_mtu: of the links to members and RIBs, in bytes after the Ethernet header.
        keepalive_ms: as in ``NodeSettings``; by default those of the Scapy plane, since half of all frames would be
            keepalives. None: of the other planes, which detect a silent link within 0.21 s.
        leaves: switches whose certificate has the role ``leaf``.
        journal_bytes: of the journal of each node; 0: none.

    Attributes:
        journals: by node; of one that was restarted also by the number of the incarnation.
    """

    topology: Topology
    seed: int = 1
    delay_s: float = 0.0005
    lead_mtu: int = 1_500
    hello_s: float = NEIGHBOUR.refresh_s
    dead_s: float = NEIGHBOUR.lease_s
    lease_s: float = ADVERTISEMENT.lease_s
    keepalive_ms: int | None = SCAPY_KEEPALIVE_MS
    trusts: dict[str, tuple[str, ...]] | None = None
    transits: Mapping[str, tuple[str, ...]] | None = None
    leaves: Collection[str] = ()
    journal_bytes: int = 0
    journals: dict[str, Journal] = field(default_factory=dict)
    network: SimNetwork = field(init=False)
    authorities: dict[str, CertificateAuthority] = field(default_factory=dict)
    identities: dict[str, Identity] = field(default_factory=dict)
    switches: dict[str, SwitchCore] = field(default_factory=dict)
    ribs: dict[str, RibHost] = field(default_factory=dict)  # by domain; further ones of a domain: ``domain#2``, ...
    members: dict[str, Participant] = field(default_factory=dict)
    cables: dict[frozenset[str], SimLink] = field(default_factory=dict)
    leads: dict[str, SimLink] = field(default_factory=dict)  # of members and RIBs, by label
    owner: Owner = field(init=False)
    settled_s: float = field(init=False)  # when ``run_until_attached`` last ended; at first, when it began
    _incarnation: int = 0
    _keys: int = 0
    _serials: int = 1 << 64

    def __post_init__(self) -> None:
        self.network = SimNetwork(self.seed)
        self.settled_s = self.network.now.mono_s
        self.owner = Owner(self._key(), bytes(range(32)))
        self.validity = Validity(int(EPOCH_UNIX_S) - _YEAR_S, int(EPOCH_UNIX_S) + _YEAR_S)
        for domain in self.topology.domains:
            self.authorities[domain.label] = CertificateAuthority.create(
                domain.label, self._key(), self.validity, self._serial
            )
        for node in self.topology.nodes:
            self._add_switch(node, self.topology.domain_of(node).label)
        for link in self.topology.links:
            sim_link = SimLink(self.delay_s, mtu=link.mtu)
            self.cables[link.ends()] = self.network.connect(link.a, link.b, sim_link, link.cost)
        for label, at in self._rib_places().items():
            identity = self.identity(Role.RIB, f"{at.switch}/{at.ifname}", self.topology.domain_of(at.switch).label)
            self.identities[f"rib:{label}"] = identity
        for label, at in self._rib_places().items():
            self._add_rib(label, at)
        for at in self.topology.attached("proxy"):
            self.add_member(f"{at.switch}/{at.ifname}", at.switch)

    validity: Validity = field(init=False)

    def identity(self, role: Role, label: str, domain: str) -> Identity:
        """Return the identity of a node, made at the first call."""
        known = self.identities.get(label)
        if known is None:
            keys = NodeKeys.generate(role, label.replace("/", "-"), key=self._key())
            known = self.identities[label] = keys.join(self.authorities[domain], self.validity)
        return known

    def policy(self, domain: str) -> Policy:
        """Return the policy of a domain's nodes."""
        trusted = self.authorities if self.trusts is None else self.trusts.get(domain, ())
        through = None if self.transits is None else self.transits.get(domain)
        return Policy(
            self.authorities[domain].root,
            [self.authorities[label].root for label in trusted],
            None if through is None else [self.authorities[label].root.domain for label in through],
        )

    def add_member(self, label: str, switch: str, domain: str | None = None) -> Participant:
        """Attach a member to a switch; its domain is the switch's unless given."""
        domain = domain or self.topology.domain_of(switch).label
        identity = self.identity(Role.PROXY, label, domain)
        member = self.members[label] = self._kept(label, Participant, identity, self.policy(domain))
        self.network.add(label, member)
        self.leads[label] = self.network.connect(switch, label, SimLink(0.0001, mtu=self.lead_mtu))
        return member

    def restart_member(self, label: str) -> Participant:
        """Restart a member without any state or topic."""
        before = self.members[label]
        identity = next(each for each in self.identities.values() if each.name == before.name)
        domain = next(domain for domain, each in self.authorities.items() if each.root.domain == identity.root.domain)
        member = self.members[label] = self._kept(label, Participant, identity, self.policy(domain))
        self.network.replace(label, member)
        return member

    def roam(self, label: str, switch: str) -> None:
        """Move a member's link to another switch."""
        self.network.set_link(self.leads[label], up=False)
        self.leads[label] = self.network.connect(switch, label, SimLink(0.0001, mtu=self.lead_mtu))

    def topic(self, name: str, member: Participant, rights: Collection[Right], **metadata: str) -> Topic:
        """Return a topic of the owner, delegated to a member."""
        identity = next(each for each in self.identities.values() if each.name == member.name)
        described = Metadata({"kind": "topic", "name": name, **metadata})
        card = NodeDescriptor.from_wire(NodeDescriptor.make(identity))
        delegation = self.owner.delegate(card, described, rights, [1], self.validity)
        grants = delegation.open(identity)
        return Topic(delegation, {epoch: grant.secret for epoch, grant in grants.items()})

    def restart_switch(self, name: str) -> SwitchCore:
        """Restart a switch without any state."""
        switch, table = self._switch(name, self.topology.domain_of(name).label)
        self.network.replace(name, switch, table)
        return switch

    def restart_rib(self, label: str) -> RibHost:
        """Restart a RIB without any state; ``label`` as in ``ribs``."""
        host = self._rib(label)
        self.network.replace(self.rib_node(label), host)
        return host

    def kill_rib(self, label: str) -> None:
        """Stop a RIB without a goodbye; ``restart_rib`` brings it back."""
        self.network.stop(self.rib_node(label))

    def rib_node(self, label: str) -> str:
        """Return the name of a RIB in ``network`` and ``leads``: ``switch/device``."""
        at = self._rib_places()[label]
        return f"{at.switch}/{at.ifname}"

    def run_until_attached(self, duration_s: float = 10.0) -> bool:
        """Let time pass until every member is attached; return whether that came true."""
        settled = self.network.run(duration_s, lambda: all(m.attachment.is_attached for m in self.members.values()))
        self.settled_s = self.network.now.mono_s
        return settled

    def _key(self) -> SoftwareKey:
        """Return a key that follows from the seed, so that names, and all that is sorted by them, repeat."""
        self._keys += 1
        digest = hashlib.sha256(b"%d %d" % (self.seed, self._keys)).digest()
        return SoftwareKey.of(ec.derive_private_key(int.from_bytes(digest, "big") % (_ORDER - 1) + 1, ec.SECP256R1()))

    def _serial(self) -> int:
        """Return the next serial number of a certificate; all have the same length."""
        self._serials += 1
        return self._serials

    def _add_switch(self, name: str, domain: str) -> None:
        self.identity(Role.LEAF if name in self.leaves else Role.SWITCH, name, domain)
        self.network.add(name, *self._switch(name, domain))

    def _switch(self, name: str, domain: str) -> tuple[SwitchCore, Table]:
        table = Table()
        switch = self.switches[name] = self._kept(
            name,
            lambda identity, policy, settings: SwitchCore(identity, policy, table, settings),
            self.identities[name],
            self.policy(domain),
        )
        return switch, table

    def _rib_places(self) -> dict[str, Attachment]:
        """Return the locations of the RIBs: a domain's first by its label, others as ``domain#2``, ``domain#3``."""
        places: dict[str, Attachment] = {}
        for domain in self.topology.domains:
            of_domain = [at for at in self.topology.attached("rib") if at.switch in domain.switches]
            for number, at in enumerate(of_domain, 1):
                places[domain.label if number == 1 else f"{domain.label}#{number}"] = at
        return places

    def _rib_names(self, domain: str) -> tuple[Name, ...]:
        labels = [label for label in self._rib_places() if label.split("#", maxsplit=1)[0] == domain]
        return tuple(self.identities[f"rib:{label}"].name for label in labels)

    def _upper_names(self, domain: str | None) -> tuple[Name, ...]:
        """Return the RIBs of a domain, and after them those of the tiers above it."""
        if domain is None:
            return ()
        above = next(each.upper for each in self.topology.domains if each.label == domain)
        return self._rib_names(domain) + self._upper_names(above)

    def _add_rib(self, label: str, at: Attachment) -> None:
        node = self.rib_node(label)
        self.network.add(node, self._rib(label))
        self.leads[node] = self.network.connect(at.switch, node, SimLink(0.0001, mtu=self.lead_mtu))

    def _rib(self, label: str) -> RibHost:
        domain = next(each for each in self.topology.domains if each.label == label.split("#", maxsplit=1)[0])
        upper, peers = self._upper_names(domain.upper), self._rib_names(domain.label)
        identity = self.identities[f"rib:{label}"]
        chosen = RibSettings(upper=upper, peers=peers)

        def host(identity: Identity, policy: Policy, settings: NodeSettings) -> RibHost:
            return RibHost(identity, policy, RibCore(identity, policy, MemoryStore(), chosen), settings)

        made = self.ribs[label] = self._kept(self.rib_node(label), host, identity, self.policy(domain.label), chosen)
        return made

    def _kept(
        self,
        name: str,
        make: Callable[[Identity, Policy, NodeSettings], _C],
        identity: Identity,
        policy: Policy,
        rib: RibSettings | None = None,
    ) -> _C:
        """Return a node's core, with a journal if the simulation keeps them."""
        settings = self._settings()
        if not self.journal_bytes:
            return make(identity, policy, settings)
        unrepeatable = "" if identity.role is not Role.PROXY else "calls of a member's program are not in its journal"
        lives = sum(each.partition("~")[0] == name for each in self.journals)
        journal = self.journals[f"{name}~{lives + 1}" if lives else name] = Journal(self.journal_bytes, unrepeatable)
        return journal.build(make, replace(identity), policy, settings, self.network.now, rib)

    def save_journals(self, folder: Path) -> None:
        """Write the incident of each node that has a journal, not sealed: a simulation has no secrets."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, journal in self.journals.items():
            data = Incident.from_blocks(journal.head(), journal.blocks()).to_bytes()
            (folder / f"{name.replace('/', '-')}.incident").write_bytes(data)

    def _settings(self) -> NodeSettings:
        self._incarnation += 1
        return NodeSettings(
            incarnation=self._incarnation,
            first_sequence=int(self.network.now.unix_s * 1000),
            random_bytes=self.network.random_bytes,
            hello_s=self.hello_s,
            dead_s=self.dead_s,
            lease_s=self.lease_s,
            keepalive_ms=self.keepalive_ms,
        )
