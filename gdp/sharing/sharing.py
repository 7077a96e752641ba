"""Sharing of names by one node: exposed names, accepted offers, delegations to other nodes, and their upkeep.

I/O. Every change holds the lock on the folder of ``proxy.yaml``, writes the rules of the live proxy as one drop-in file
and reloads the proxy. A change that the proxy refuses leaves the earlier rules and the earlier state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

from gdp.config.drop_in import locked, read_drop_in
from gdp.config.offered_qos import OfferedQos
from gdp.crypto.statements import parse
from gdp.errors import DropReason, GdpError, LocalError, StatementError
from gdp.metadata import SALT, Metadata
from gdp.names import Name
from gdp.sharing.exchange import Exchange, Exposure, Mail, MailKind, load_groups, resolve_recipients
from gdp.sharing.grants import GIVING, TAKING, Grants, ShareReport, described
from gdp.sharing.issued import IssuedDelegation, IssuedStore
from gdp.sharing.proxy_files import LiveNames, ProxyFiles, Side, StatedRule, fits
from gdp.sharing.rules import accepted_nodes, check_accepted, check_exposed, check_name, kind_from_text, render, usable
from gdp.sharing.state import AcceptedName, ExposedName, Offer, ShareState, StateFolder, links_of
from gdp.stores.keyring import CARD, load_card, load_delegation, load_root, load_salt, save_delegation
from gdp.trust.adcert import AdCertCache, Chain
from gdp.trust.delegation import Delegation
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.revocation import Revocation

GROUPS: Final = "groups.yaml"
NOT_USED: Final = "not used"  # begins the state of an accepted offer that conflicts
WITHDRAWN: Final = "withdrawn"  # begins the state of an offer whose name the other machine no longer exposes

RevocationsSink: TypeAlias = "Callable[[Sequence[bytes]], bool]"


@dataclass(slots=True)
class _Pass:
    """What one change works on."""

    files: ProxyFiles
    state: ShareState
    offers: list[Offer]
    grants: Grants
    live: LiveNames = field(default_factory=LiveNames)
    report: ShareReport = field(default_factory=ShareReport)


class Sharing:
    """The shared names of the proxy that ``proxy.yaml`` describes.

    Args:
        path: of ``proxy.yaml``. ``groups.yaml`` may lie in the same folder.
        exchange: directory and mailboxes of the domain.
        owners: directories of owners whose delegations are renewed, in addition to those of exposed names.
    """

    def __init__(self, path: Path, exchange: Exchange, owners: Sequence[Path] = ()) -> None:
        self._path = path.absolute()
        self._exchange = exchange
        self._owners = [owner.absolute() for owner in owners]
        self._folder = StateFolder(self._path)

    def expose(self, wanted: ExposedName, unix_s: float, *, is_plain: bool = False) -> ShareReport:
        """Expose a name to nodes or groups; the live proxy carries it at once.

        A name without a type, and a pattern, are delegated as the proxy finds them in its graph: by ``work``.

        Args:
            is_plain: the 256-bit name has no salt, also where the owner has one.

        Raises:
            ConfigError: ``proxy.yaml`` or ``groups.yaml`` is not as expected.
            LocalError: no such node, the name is exposed or imported already, or the proxy refuses the rule.
        """
        wanted = wanted.model_copy(update={"owner": wanted.owner.absolute()})
        with self._change(unix_s) as at:
            check_exposed(at.files, at.state, at.offers, wanted)
            salt = self._salt(IssuedStore(wanted.owner), wanted.kind, wanted.name, is_plain=is_plain)
            wanted = wanted.model_copy(update={"salt": salt})
            grants = at.grants
            added = resolve_recipients(wanted.to, at.grants.nodes(), grants.groups)
            kept = [each for each in at.state.exposed if (each.kind, each.name) != (wanted.kind, wanted.name)]
            for each in at.state.exposed:
                if each not in kept:
                    merged: dict[str, object] = {
                        "to": (*each.to, *(label for label in wanted.to if label not in each.to))
                    }
                    merged |= {**wanted.rule_options, "type_name": wanted.type_name or each.type_name}
                    wanted = each.model_copy(update=merged)
            at.state = at.state.model_copy(update={"exposed": (*kept, wanted)})
            self._apply(at, is_required=True)
            self._grant(at, restored=added)
            self._renew(at)
        return at.report

    def stop_exposing(self, kind: str, name: str, unix_s: float) -> ShareReport:
        """Remove an exposed name from the live proxy; delegations stay until they are revoked or expire.

        Raises:
            LocalError: it is not exposed, or the proxy refuses the change.
        """
        with self._change(unix_s) as at:
            removed = [each for each in at.state.exposed if (each.kind, each.name) == (kind, name)]
            if not removed:
                raise LocalError(f"{name} is not exposed by 'gdp expose'; a rule of {self._path.name} is removed there")
            kept = tuple(each for each in at.state.exposed if each not in removed)
            at.state = at.state.model_copy(update={"exposed": kept})
            self._apply(at, is_required=True)
            self._attempt(at, partial(self._renew, more=[each.owner for each in removed]))
        return at.report

    def accept(self, wanted: AcceptedName, unix_s: float) -> ShareReport:
        """Accept present and later offers of a name or a pattern.

        Raises:
            LocalError: it is accepted already, goes in the other direction, or the proxy refuses the rules.
        """
        with self._change(unix_s) as at:
            self._attempt(at, self._receive)
            check_accepted(at.files, at.state, at.offers, wanted)
            at.state = at.state.model_copy(update={"accepted": (*at.state.accepted, wanted)})
            self._apply(at, is_required=True)
            if wanted.source is not None:  # it may join later: an unknown label is reported, not refused
                try:
                    resolve_recipients([wanted.source], at.grants.nodes(), {})
                except GdpError as error:
                    at.report.add_problem(error)
        return at.report

    def stop_accepting(self, side: Side, name: str, unix_s: float) -> ShareReport:
        """Remove an accepted name with its rules; its offers stay. Raises ``LocalError``: it is not accepted."""
        with self._change(unix_s) as at:
            kept = tuple(each for each in at.state.accepted if (each.side, each.name) != (side, name))
            if len(kept) == len(at.state.accepted):
                raise LocalError(f"{name} is not accepted; 'gdp import --list' shows what is")
            at.state = at.state.model_copy(update={"accepted": kept})
            self._apply(at, is_required=True)
        return at.report

    def share(
        self,
        owner: Path,
        name: str,
        recipients: Sequence[str],
        unix_s: float,
        *,
        kind: str = "topic",
        type_name: str = "",
        is_giving: bool = False,
        is_plain: bool = False,
        days: float,
    ) -> ShareReport:
        """Delegate a name of this owner to nodes or groups; a pattern means the names that are exposed here.

        Args:
            is_giving: the right to publish or serve; else to read or call.
            is_plain: as for ``expose``.

        Raises:
            LocalError: no such node, or the type of the name is not known.
        """
        check_name(name)
        kind_from_text(kind, type_name)
        with self._change(unix_s) as at:
            nodes = resolve_recipients(recipients, at.grants.nodes(), at.grants.groups)
            store = IssuedStore(owner.absolute())
            right = (GIVING if is_giving else TAKING)[kind]
            for metadata in self._known(at, store, kind, name, type_name, is_plain=is_plain):
                for label, node in nodes.items():
                    at.grants.issue(store, label, node, metadata, [right], days=days)
            self._reload_changed(at)
        return at.report

    def revoke(self, owner: Path, name: str, label: str, publish: RevocationsSink, unix_s: float) -> ShareReport:
        """Take back what a node got of a name or a pattern; nothing gives it back by itself.

        Args:
            publish: spreads the statements among the switches; returns whether they have them already.

        Raises:
            LocalError: nothing of the name was given to the node, or ``publish`` fails: then nothing is recorded.
        """
        with self._change(unix_s) as at:
            store = IssuedStore(owner.absolute())
            found = [
                each
                for each in store
                if each.label == label and not each.is_own and not each.is_revoked and fits(name, _ros_name(each))
            ]
            if not found:
                raise LocalError(f"{name} is not shared with {label}; 'gdp share --list' shows what is")
            statements = [(each, store.revocations(each, unix_s)) for each in found]
            if not publish([wire for _, wires in statements for wire in wires]):
                at.report.problems.append("the switch does not run: the revocation spreads when it starts")
            for each, wires in statements:
                store.save(each.model_copy(update={"is_revoked": True}))
                for wire in wires:
                    self._send_revocation(at, each, wire)
            exposed = tuple(
                each.model_copy(update={"to": tuple(to for to in each.to if to != label)})
                if each.name == name
                else each
                for each in at.state.exposed
            )
            at.state = at.state.model_copy(update={"exposed": exposed})
            at.report.granted = [each for each, _ in statements]
        return at.report

    def offers(self) -> list[tuple[Offer, str]]:
        """Return the offers, each with its state: ``offered``, ``used``, or ``not used``, ``withdrawn`` and the reason.

        Raises:
            LocalError: a file is invalid.
        """
        state = self._folder.read_state()
        offers = list(self._folder.offers(state))
        unused = dict[Name, str]()
        used = [each for _, each in usable(ProxyFiles.read(self._path), state, offers, unused)]

        def state_of(offer: Offer) -> str:
            if offer.is_withdrawn:
                return f"{WITHDRAWN}: {offer.sender} no longer exposes it"
            why = unused.get(offer.delegation.name)
            return "used" if offer in used else "offered" if why is None else f"{NOT_USED}: {why}"

        return [(each, state_of(each)) for each in offers]

    def state(self) -> ShareState:
        """Return what is exposed and accepted. Raises ``LocalError``: the file is invalid."""
        return self._folder.read_state()

    def work(self, unix_s: float) -> ShareReport:
        """Receive mail, apply accepted offers, delegate names that appeared, and renew; what fails is reported.

        Raises:
            LocalError: the state cannot be read or written.
        """
        with self._change(unix_s) as at:
            for step in (self._receive, self._find_brought, self._apply, self._grant, self._renew):
                self._attempt(at, step)
        return at.report

    @contextmanager
    def _change(self, unix_s: float) -> Iterator[_Pass]:
        """Load what a change needs, and save the state unless it fails."""
        with locked(self._path):
            files, report = ProxyFiles.read(self._path), ShareReport()
            grants = Grants(
                files=files,
                exchange=self._exchange,
                own=load_card(files.identity / CARD),
                root=load_root(files.root),
                groups=load_groups(self._path.with_name(GROUPS)),
                unix_s=unix_s,
                report=report,
            )
            state = self._folder.read_state()
            at = _Pass(files, state, list(self._folder.offers(state)), grants, report=report)
            yield at
            if at.state != state:
                self._folder.save(at.state)

    @staticmethod
    def _attempt(at: _Pass, step: Callable[[_Pass], None]) -> None:
        try:
            step(at)
        except GdpError as error:
            at.report.add_problem(error)

    def _apply(self, at: _Pass, *, is_required: bool = False) -> None:
        """Install and remove delegations of offers, and write the rules.

        Args:
            is_required: whether the proxy reloads in any case.
        """
        unused = dict[Name, str]()
        used = list(usable(at.files, at.state, at.offers, unused))
        at.report.problems += [
            f"{each.ros_name} from {each.sender}: {unused[each.delegation.name]}"
            for each in at.offers
            if each.delegation.name in unused
        ]
        is_changed = is_required
        for offer in at.offers:
            file = at.files.delegations / f"{offer.delegation.name.to_text()}.delegation"
            is_used = any(each is offer for _, each in used)
            held = load_delegation(file) if file.exists() else None
            if is_used and held != offer.delegation:
                save_delegation(at.files.delegations, offer.delegation, force=True)
                is_changed = True
            elif not is_used and held == offer.delegation:
                file.unlink()
                is_changed = True
        text = render(self._folder, at.files, at.state, used)
        if is_changed or text != read_drop_in(at.files.drop_in):
            at.report.is_running = at.files.replace_rules(text)

    def _find_brought(self, at: _Pass) -> None:
        """Mark the offers of what accepted nodes have: the live proxy knows it, and lacks their delegations."""
        nodes = accepted_nodes(at.state, at.offers)
        wanted = {each.name: each.node for each in at.files.live_names().undelegated} if nodes else {}
        for offer in at.offers if wanted else ():
            name = offer.delegation.name
            if (offer.sender, node := wanted.get(name, "")) in nodes and node != offer.node:
                at.state = self._folder.update_offer(at.state, name, offer.sender, node=node)
        at.offers = list(self._folder.offers(at.state)) if wanted else at.offers

    def _grant(self, at: _Pass, restored: Sequence[str] | dict[str, NodeDescriptor] = ()) -> None:
        if at.state.exposed or self._owners:
            at.live = at.files.live_names()
        if at.state.exposed:
            at.grants.grant_exposed(at.state, at.live.undelegated, restored)
        self._reload_changed(at)

    def _renew(self, at: _Pass, more: Sequence[Path] = ()) -> None:
        folders = dict.fromkeys([*(each.owner for each in at.state.exposed), *self._owners, *more])
        at.grants.renew([IssuedStore(folder) for folder in folders], at.state, at.live.qos)
        self._reload_changed(at)

    def _reload_changed(self, at: _Pass) -> None:
        if at.grants.is_changed:
            at.report.is_running = at.files.reload()
            at.grants.is_changed = False

    @staticmethod
    def _salt(store: IssuedStore, kind: str, name: str, *, is_plain: bool) -> str:
        """Return the salt of a name, or of a pattern of names; a name that was delegated before keeps its own.

        Raises:
            LocalError: it is to be plain, and has a salt already.
        """
        issued = (each.metadata for each in store)
        before = next((each for each in issued if each["kind"] == kind and fits(name, str(each["name"]))), None)
        if before is None:
            return "" if is_plain else load_salt(store.owner)
        salt = str(before.get(SALT, ""))
        if is_plain and salt:
            raise LocalError(f"{name} has a salt already, and a name never changes; leave --plain-name out")
        return salt

    def _known(
        self, at: _Pass, store: IssuedStore, kind: str, name: str, type_name: str, *, is_plain: bool
    ) -> list[Metadata]:
        """Return the names of this owner that a name or pattern means. Raises ``LocalError``: none is known."""
        found = list[Metadata]()
        covering = (each for each in at.files.rules if (each.side, each.kind) == ("expose", kind))
        if type_name and "*" not in name:
            exposed = next((each for each in at.state.exposed if each.kind == kind and fits(each.name, name)), None)
            rule = next((each for each in covering if fits(each.name, name)), None)
            if exposed is None and rule is not None:
                found.append(_stated(rule, name, type_name))
            else:
                salt = exposed.salt if exposed else self._salt(store, kind, name, is_plain=is_plain)
                found.append(described(kind, name, type_name, salt))
        else:
            for issued in store:
                if issued.is_own and issued.metadata["kind"] == kind and fits(name, _ros_name(issued)):
                    found.append(issued.metadata)
            found += [_stated(each, each.name, each.type_name) for each in covering if _means(name, each)]
        if not found:
            hint = "no rule of this machine matches it" if "*" in name else "its type is not known here: state --type"
            raise LocalError(f"{name}: {hint}")
        return found

    def _receive(self, at: _Pass) -> None:
        """Take the waiting mails; a mail that is not valid is reported."""
        for mail in self._exchange.receive_mail():
            try:
                if mail.kind == MailKind.DELEGATION.value:
                    self._take_delegation(at, mail)
                elif mail.kind == MailKind.REVOCATION.value:
                    self._take_revocation(at, mail)
                elif mail.kind == MailKind.QOS.value:
                    name, qos = OfferedQos.from_wire(mail.data)
                    at.state = self._folder.update_offer(at.state, name, mail.sender, qos=qos)
                    at.offers = list(self._folder.offers(at.state))
                elif mail.kind == MailKind.EXPOSURE.value:
                    stated = Exposure.from_cbor(mail.data)
                    is_withdrawn = not stated.is_exposed
                    at.state = self._folder.update_offer(at.state, stated.name, mail.sender, is_withdrawn=is_withdrawn)
                    at.offers = list(self._folder.offers(at.state))
            except GdpError as error:
                at.report.problems.append(f"mail from {mail.sender} is not taken: {error}")
            self._folder.save(at.state)  # before the mail is removed

    def _take_delegation(self, at: _Pass, mail: Mail) -> None:
        delegation = Delegation.from_wire(mail.data)
        _verify(delegation, at)
        offer = Offer(delegation=delegation, sender=mail.sender, received_unix_s=at.grants.unix_s)
        for each in at.offers:
            if each.delegation.name == delegation.name and each.age > offer.age:
                return  # an earlier mail that was delayed
        at.state = self._folder.save_offer(at.state, delegation, mail.sender, at.grants.unix_s)
        at.offers = list(self._folder.offers(at.state))
        at.report.received.append(offer)

    def _take_revocation(self, at: _Pass, mail: Mail) -> None:
        revocation = Revocation.from_statement(parse(mail.data))
        for offer in at.offers:
            links = links_of(offer.delegation)
            issuers = {offer.delegation.name, *(link.delegate for link in links)}
            is_meant = any(link.fingerprint == revocation.fingerprint for link in links)
            if is_meant and revocation.issuer.name in issuers:
                at.state = self._folder.remove_offer(at.state, offer.delegation.name)
                (at.files.delegations / f"{offer.delegation.name.to_text()}.delegation").unlink(missing_ok=True)
        if len(at.offers) != len(at.state.offers):
            at.offers = list(self._folder.offers(at.state))
            at.report.is_running = at.files.reload()

    def _send_revocation(self, at: _Pass, issued: IssuedDelegation, wire: bytes) -> None:
        try:
            self._exchange.send(issued.descriptor.name, MailKind.REVOCATION.value, wire)
        except GdpError as error:
            at.report.problems.append(f"{issued.label} is not informed: {error}")


def _means(name: str, rule: StatedRule) -> bool:
    return bool(rule.type_name) and fits(name, rule.name)


def _stated(rule: StatedRule, name: str, type_name: str) -> Metadata:
    """Return the name that a rule of a file gives to a ROS name. Raises ``LocalError``: a file holds its salt."""
    if rule.is_salted:
        raise LocalError(f"{rule.where}: the name has a salt: gdp delegate name gives it to a node")
    return Metadata({**rule.metadata, "kind": rule.kind, "name": name, "type": type_name})


def _ros_name(issued: IssuedDelegation) -> str:
    return str(issued.metadata["name"])


def _verify(delegation: Delegation, at: _Pass) -> None:
    """Return if a delegation is for the proxy of this machine, is valid now, and says what it means.

    Raises:
        StatementError: anything else.
    """
    own = at.grants.own
    if delegation.node != own.name:
        raise StatementError(DropReason.NOT_FOR_US, "a delegation to another node")
    chain = Chain.traverse(delegation.chain, delegation.subject, own.subject, AdCertCache(len(delegation.chain) + 1))
    for right in delegation.rights:
        chain.check(right, at.grants.unix_s)
    meaning = dict(delegation.metadata or {})
    check_name(str(meaning.get("name")))
    kind_from_text(str(meaning.get("kind")), str(meaning.get("type") or "?"))
    if not delegation.chain:
        raise StatementError(DropReason.NOT_DELEGATED, "an offer without a delegation")
