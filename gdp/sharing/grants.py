"""Grants: delegations that a node's rules need, issued by the owner keys of this machine, delivered and renewed.

I/O. Own delegations are installed for the proxy of this machine; others go to the mailbox of their node. A delegation
whose delivery fails is delivered at the next upkeep.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from gdp.config.offered_qos import OfferedQos
from gdp.crypto.certificates import Root
from gdp.errors import GdpError
from gdp.metadata import SALT, Metadata
from gdp.names import Name
from gdp.sharing.exchange import Exchange, Exposure, MailKind, proxies_of, resolve_recipients
from gdp.sharing.issued import IssuedDelegation, IssuedStore
from gdp.sharing.proxy_files import ProxyFiles, Undelegated, fits
from gdp.sharing.state import ExposedName, Offer, ShareState
from gdp.stores.keyring import load_delegation, load_owner, save_delegation
from gdp.trust.grants import daily_epochs
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right

GIVING: Final = {"topic": Right.PUBLISH, "service": Right.SERVE, "action": Right.SERVE, "node": Right.SERVE}
_GIVES: Final = frozenset(GIVING.values())
_EXPOSE: Final = "expose"
TAKING: Final = {"topic": Right.READ, "service": Right.CALL, "action": Right.CALL, "node": Right.CALL}


def described(kind: str, name: str, type_name: str, salt: str = "") -> Metadata:
    """Return what the 256-bit name of a shared name digests, in addition to the owner's key."""
    own = {"kind": kind, "name": name, "type": type_name}
    return Metadata({**own, SALT: salt} if salt else own)


@dataclass(slots=True)
class ShareReport:
    """What was done, and what could not be done.

    Args:
        is_running: whether the proxy runs and has taken the change; None: nothing had to change.
        granted: delegations that were issued.
        received: offers that came.
        problems: texts; what they are about is tried again at the next upkeep.
    """

    is_running: bool | None = None
    granted: list[IssuedDelegation] = field(default_factory=list)
    received: list[Offer] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def add_problem(self, error: GdpError) -> None:
        """Add the text of an error, unless it is there already."""
        if str(error) not in self.problems:
            self.problems.append(str(error))


@dataclass(slots=True, kw_only=True)
class Grants:
    """The delegations of one upkeep.

    Args:
        own: descriptor of the proxy of this machine.
        root: of the domain, which confirms the descriptors of its nodes.
        report: gets what is issued and what fails.
        is_changed: whether a delegation of the proxy of this machine was installed, so that it must reload.
    """

    files: ProxyFiles
    exchange: Exchange
    own: NodeDescriptor
    root: Root
    groups: Mapping[str, Sequence[str]]
    unix_s: float
    report: ShareReport
    is_changed: bool = False
    _nodes: Mapping[str, NodeDescriptor] | None = None
    _failure: GdpError | None = None

    def nodes(self) -> Mapping[str, NodeDescriptor]:
        """Return the proxies of the domain by label; the exchange is asked once.

        Raises:
            GdpError: the exchange does not answer.
        """
        if self._failure is not None:
            raise self._failure
        if self._nodes is None:
            try:
                self._nodes = proxies_of(self.exchange, self.root, self.unix_s)
            except GdpError as error:
                self._failure = error
                raise
        return self._nodes

    def grant_exposed(
        self, state: ShareState, undelegated: Iterable[Undelegated], restored: Collection[str] = ()
    ) -> None:
        """Issue what the exposed names lack: for the proxy itself, and for each recipient.

        Args:
            undelegated: names that the live proxy has found for the rules.
            restored: labels of nodes whose revoked delegations are issued again.
        """
        found = list(undelegated)
        for store in {each.owner: IssuedStore(each.owner) for each in state.exposed}.values():
            key = load_owner(store.owner).public.compressed
            rules = [each for each in state.exposed if each.owner_key == key.hex()]
            names = dict[bytes, Metadata]()
            brought = defaultdict[bytes, set[tuple[str, str]]](set)  # by which node, on which side
            recorded = dict[bytes, set[tuple[str, str]]]()
            for each in rules:
                if each.type_name and "*" not in each.name:
                    metadata = described(each.kind, each.name, each.type_name, each.salt)
                    names[metadata.digest()] = metadata
            for lacking in found:
                for salt in {each.salt for each in rules}:
                    metadata = described(lacking.kind, lacking.shared, lacking.type_name, salt)
                    if metadata.name(key) == lacking.name and lacking.node:
                        names[metadata.digest()] = metadata
                        brought[metadata.digest()].add((lacking.node, lacking.side))
                    elif metadata.name(key) == lacking.name and lacking.side == _EXPOSE:
                        names[metadata.digest()] = metadata
            for issued in store:
                if issued.is_own and not issued.is_revoked:
                    names[issued.metadata.digest()] = issued.metadata
                    recorded[issued.metadata.digest()] = set(issued.brought)
                    brought[issued.metadata.digest()] |= set(issued.brought)
            for digest, metadata in names.items():
                by_node = brought[digest]
                for side in (_EXPOSE, "import"):
                    covering = [
                        each
                        for each in rules
                        if (side == _EXPOSE and _covers(each, metadata))
                        or (each.kind == "node" and (each.name, side) in by_node)
                    ]
                    if covering:
                        self._grant(store, metadata, covering, restored, is_exposed=side == _EXPOSE)
                if by_node != recorded.get(digest, set()):
                    self._keep_brought(store, load_owner(store.owner).subject(metadata).name, by_node)

    def issue(
        self,
        store: IssuedStore,
        label: str,
        node: NodeDescriptor,
        metadata: Metadata,
        rights: Collection[Right],
        *,
        days: float,
    ) -> IssuedDelegation:
        """Issue and deliver one delegation, with the epochs of its name.

        Raises:
            LocalError: the owner's keys are missing, or a record cannot be written.
        """
        is_own = node.name == self.own.name
        name = load_owner(store.owner).subject(metadata).name
        epochs = store.epochs(name)
        file = self.files.delegations / f"{name.to_text()}.delegation"
        if file.exists():
            held = load_delegation(file)
            epochs |= set(held.grants)
            rights = frozenset(rights) | (held.rights if is_own and held.node == node.name else frozenset())
        epochs = epochs or {0}
        if self._has_daily_epochs(metadata):
            epochs = daily_epochs(epochs, self.unix_s)
        issued = store.issue(node, label, metadata, rights, epochs, days=days, is_own=is_own, unix_s=self.unix_s)
        return self.deliver(store, issued)

    def deliver(self, store: IssuedStore, issued: IssuedDelegation) -> IssuedDelegation:
        """Install a delegation here, or send it to its node; what fails is reported.

        Raises:
            LocalError: the record of the delivery cannot be written.
        """
        try:
            if issued.is_own:
                save_delegation(self.files.delegations, issued.delegation, force=True)
                self.is_changed = True
            else:
                wire = issued.delegation.to_wire()
                self.exchange.send(issued.descriptor.name, MailKind.DELEGATION.value, wire)
            issued = issued.model_copy(update={"is_delivered": True})
            store.save(issued)
        except GdpError as error:
            self.report.problems.append(f"{issued.metadata['name']} is not delivered to {issued.label} yet: {error}")
        self.report.granted.append(issued)
        return issued

    def renew(self, owners: Iterable[IssuedStore], state: ShareState, qos: Mapping[Name, OfferedQos]) -> None:
        """Renew delegations after two thirds of their life, grant tomorrow's epoch, and deliver what waits.

        A node that has left the domain gets nothing.

        Args:
            state: nodes that take a name learn when its last rule here goes, and when one comes again.
            qos: of the topics that the live proxy exposes; nodes that may read one learn what is new of it.
        """
        for store in owners:
            issued_of, held = list(store), defaultdict[Name, set[int]](set)
            given_to_others = set[Name]()
            for each in issued_of:
                held[each.delegation.name] |= set() if each.is_revoked else set(each.delegation.grants)
                if not each.is_own and not each.is_revoked and each.delegation.rights & _GIVES:
                    given_to_others.add(each.delegation.name)
            for issued in issued_of:
                try:
                    self._renew(store, issued, held[issued.delegation.name])
                    is_exposed = issued.delegation.name in given_to_others or self._is_exposed(issued.metadata, state)
                    self._send_exposure(store, issued, is_exposed=is_exposed)
                    self._send_qos(store, issued, qos)
                except GdpError as error:
                    self.report.problems.append(
                        f"the delegation of {issued.metadata['name']} to {issued.label} is not renewed: {error}"
                    )

    def _renew(self, store: IssuedStore, issued: IssuedDelegation, held: Collection[int]) -> None:
        if issued.is_revoked:
            return
        given = set(issued.delegation.grants)
        epochs = daily_epochs(held, self.unix_s) if self._has_daily_epochs(issued.metadata) else given
        lacks_epoch = not epochs <= given
        if issued.is_delivered and not lacks_epoch and not issued.is_due(self.unix_s):
            return
        present = self.own if issued.is_own else self._present(issued)
        if present is None or present.name != issued.descriptor.name:
            return  # it has left the domain, or joined again as another node
        if issued.is_due(self.unix_s):
            self.deliver(store, store.renew(issued, present, epochs, self.unix_s))
        elif lacks_epoch:
            self.deliver(store, store.rotate(issued, present, epochs))
        elif not issued.is_delivered:
            self.deliver(store, issued)

    def _send_qos(self, store: IssuedStore, issued: IssuedDelegation, offered: Mapping[Name, OfferedQos]) -> None:
        """Tell a node that reads a topic its QoS, where that is new to it; what fails is reported."""
        name = issued.delegation.name
        qos, is_reader = offered.get(name), not issued.is_own and Right.READ in issued.delegation.rights
        if qos is None or qos == issued.qos or not is_reader:
            return
        self._inform(store, issued, MailKind.QOS, qos.to_wire(name), {"qos": qos})

    def _send_exposure(self, store: IssuedStore, issued: IssuedDelegation, *, is_exposed: bool) -> None:
        """Tell a node that takes a name whether it is exposed, where that has changed; a new delegation says it is."""
        known, takes = issued.is_exposed, issued.delegation.rights - _GIVES
        if issued.is_own or not takes or is_exposed is bool(known):
            return
        wire = Exposure(issued.delegation.name, is_exposed).to_cbor()
        self._inform(store, issued, MailKind.EXPOSURE, None if known is None else wire, {"is_exposed": is_exposed})

    def _inform(
        self, store: IssuedStore, issued: IssuedDelegation, kind: MailKind, wire: bytes | None, known: dict[str, object]
    ) -> None:
        """Send a mail, if there is one, and record what the node then knows; what fails is reported."""
        latest = store.find(issued.delegation.name, issued.descriptor.name)  # a renewal may have written another
        if latest is None or not latest.is_delivered or latest.is_revoked:
            return
        try:
            if wire is not None:
                self.exchange.send(issued.descriptor.name, kind.value, wire)
            store.save(latest.model_copy(update=known))
        except GdpError as error:
            self.report.add_problem(error)

    def _is_exposed(self, metadata: Metadata, state: ShareState) -> bool:
        """Return whether a rule of this machine may mean a name; what its metadata are does not matter."""
        rules = [(each.kind, each.name) for each in self.files.rules if each.side == "expose"]
        rules += [(each.kind, each.name) for each in state.exposed]
        return any(kind == metadata["kind"] and fits(name, str(metadata["name"])) for kind, name in rules)

    def _has_daily_epochs(self, metadata: Metadata) -> bool:
        """Return whether a name gets them; holders of a plain one may have delegations that a person wrote."""
        return self.files.has_daily_epochs and SALT in metadata

    def _present(self, issued: IssuedDelegation) -> NodeDescriptor | None:
        """Return the descriptor of a node, None if it has left; without an answer the one at the time of issue."""
        try:
            return self.nodes().get(issued.label)
        except GdpError as error:
            self.report.add_problem(error)
            return issued.descriptor

    def _keep_brought(self, store: IssuedStore, name: Name, by_node: Collection[tuple[str, str]]) -> None:
        """Record which nodes have a name: later recipients of these get it, too."""
        own = store.find(name, self.own.name)
        if own is not None:
            store.save(own.model_copy(update={"brought": tuple(sorted(by_node))}))

    def _grant(
        self,
        store: IssuedStore,
        metadata: Metadata,
        rules: Sequence[ExposedName],
        restored: Collection[str],
        *,
        is_exposed: bool,
    ) -> None:
        """Issue what these rules need; of what a node here subscribes to, the recipients are the givers."""
        kind, days = str(metadata["kind"]), max(each.days for each in rules)
        ours, theirs = (GIVING[kind], TAKING[kind]) if is_exposed else (TAKING[kind], GIVING[kind])
        wanted = [(self.own.label, self.own, ours)]
        for each in dict.fromkeys(label for rule in rules for label in rule.to):
            try:
                nodes = resolve_recipients([each], self.nodes(), self.groups)
            except GdpError as error:
                self.report.add_problem(error)
                continue
            wanted += [(label, node, theirs) for label, node in nodes.items() if node.name != self.own.name]
        name = load_owner(store.owner).subject(metadata).name
        for label, node, right in wanted:
            before = store.find(name, node.name)
            if before is not None and before.is_revoked and label not in restored:
                continue
            if before is None or before.is_revoked or right not in before.delegation.rights:
                self.issue(store, label, node, metadata, [right], days=days)


def _covers(rule: ExposedName, metadata: Metadata) -> bool:
    kind, name, type_name = (str(metadata[key]) for key in ("kind", "name", "type"))
    is_same = rule.kind == kind and rule.type_name in ("", type_name) and rule.salt == metadata.get("salt", "")
    return is_same and fits(rule.name, name)
