"""Desk of a domain: it decides on requests of joiners and members, and writes what follows from them.

I/O: the registry, the domain's keys and ledger, and the border's folder of peers; no socket. Calls may take some
milliseconds, and tens of them where a disk is synced.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.control.endpoints import Endpoint, EndpointRecord
from gdp.crypto.cbor import encode
from gdp.crypto.certificates import Membership, Root, Unverified
from gdp.crypto.identity import node_metadata
from gdp.crypto.kem import KemPublicKey
from gdp.crypto.schema import OCTETS, Keyed, inner, many, octets, text, uint
from gdp.crypto.statements import parse
from gdp.crypto.subject import Subject
from gdp.crypto.x509_profile import SubjectInfo, read_request
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.member_setup import record_file_name
from gdp.enrolment.registry import MachineRow, Plan, Registry, TokenRow
from gdp.errors import LocalError, RemoteError, StatementError, StoreError
from gdp.intervals import DAY_S, HOUR_S
from gdp.links.endpoint_files import own_record, public_candidates
from gdp.names import Name
from gdp.stores.audit_log import AuditLog
from gdp.stores.files import public, read_public, write_all
from gdp.stores.issue import admit, delegate, renew
from gdp.stores.keyring import NODE_CERTIFICATE, OWNER_PUBLIC, ROOT_CERTIFICATE, load_identity, load_root
from gdp.token_bucket import TokenBuckets
from gdp.trust.audit import Action, AuditTrail
from gdp.trust.domain import Policy
from gdp.trust.enrolment_wire import (
    DELEGATIONS,
    MEMBERS,
    MEMBERS_MAX,
    NONCE_BYTES,
    PAGE,
    RESPONSE_MAX_BYTES,
    VERSION,
    Application,
    DomainNews,
    EnrolmentError,
    Greeting,
    InstallRequest,
    ListedMachine,
    ListedMail,
    MemberProof,
    Message,
    Refusal,
    read_message,
    verify_member_proof,
)
from gdp.trust.join_token import JOIN_ID_BYTES, JoinRole, join_proof
from gdp.trust.mail import Mail
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.revocation import Revocation

log = logging.getLogger(__name__)

OPENED_MAX: Final = 64  # requests per token, an hour, whose keys are verified; a machine needs one, or a few
_PROOF_BYTES: Final = 32
_EARLY_SHARE: Final = 0.1  # a membership with less of its life used is not renewed
_WHAT: Final = "enrolment"
_KNOWN: Final = "somebody has read its user data"
_MISUSES: Final = (
    Refusal.USED,
    Refusal.WRONG_NODES,
    Refusal.WRONG_PROOF,
    Refusal.IDENTITY_TAKEN,
    Refusal.MALFORMED,
)


@dataclass(frozen=True, slots=True)
class MemberConnection:
    """An authenticated connection of a member.

    Args:
        name: the node that proved its key.
        instance: random for each start of its program.
    """

    name: Name
    machine: int
    instance: bytes


@dataclass(frozen=True, slots=True)
class _Node:
    """Node that receives delegations; its application proved both of its keys."""

    subject: Subject
    kem: KemPublicKey


class EnrolmentDesk:
    """Decisions of one domain, sequential: one thread at a time.

    Raises:
        LocalError: the domain's keys cannot be read.
    """

    def __init__(self, files: DomainFiles, registry: Registry) -> None:
        self._config = files.config
        self._registry = registry
        self._trail = AuditTrail()
        self._trail.begin()
        self._audit = AuditLog(files.config.domain)
        self._revocations: dict[Path, tuple[int, bytes]] = {}  # time of change, fingerprint of the certificate
        self._border: EndpointRecord | None = None
        self._border_certificate = b""
        self._opened = TokenBuckets(OPENED_MAX / HOUR_S, OPENED_MAX)  # requests, by the id of their token

    @property
    def root(self) -> Root:
        """Return the domain's root."""
        return load_root(self._config.domain / ROOT_CERTIFICATE)

    def greeting(self, nonce: bytes, unix_s: float) -> dict[str, object]:
        """Return the server's first message."""
        return Greeting(VERSION, self.root, nonce, int(unix_s)).to_fields()

    def join(self, fields: Message, binding: bytes, nonce: bytes, unix_s: float) -> Message:
        """Return the response to a request to join.

        Raises:
            EnrolmentError: refused.
            StatementError: malformed.
            StoreError, LocalError: files cannot be written now; the same request may be repeated.
        """
        token = self._proven_token(fields, binding, nonce)
        plan = token.plan
        if plan is not None and plan.is_misused:
            raise EnrolmentError(Refusal.USED, "this token was misused, and is good for nothing", token.label)
        try:
            return self._admitted(token, fields, unix_s)
        except (EnrolmentError, StatementError) as error:
            code = error.code if isinstance(error, EnrolmentError) else Refusal.MALFORMED
            if plan is not None and code in _MISUSES:
                self._registry.set_misused(token.id, self._misuse(token, code, error))
            if isinstance(error, EnrolmentError):
                error.about = token.label
            raise

    def _admitted(self, token: TokenRow, fields: Message, unix_s: float) -> Message:
        role, plan = JoinRole(token.role), token.plan
        if role.is_of_cluster and plan is None:
            raise EnrolmentError(Refusal.USED, "the launcher of this machine has withdrawn its token")
        if not self._opened.spend(token.id, time.monotonic()):
            raise EnrolmentError(Refusal.UNAVAILABLE, "too many requests with this token")
        applications, holders = _applications(fields, role, token.id)
        label, keys = holders[0].label, _keys_digest(applications, holders)
        self._check_token(token, keys, label, unix_s)
        if token.keys is None:
            for each in holders:
                if self._registry.machine_of(each.subject.name) is not None:
                    raise EnrolmentError(
                        Refusal.IDENTITY_TAKEN,
                        "a machine with this identity joined before: each machine makes keys of its own",
                    )
        machine = self._registry.use_token(token.id, keys, label, unix_s)
        if token.answer is not None:
            return read_message(token.answer)
        days = self._days(None if plan is None else plan.until_unix_s, unix_s)
        members = [admit(self._config.domain, each.request, days=days, unix_s=unix_s) for each in applications]
        issued: dict[str, object] = {MEMBERS.key: [each.wire for each in members]}
        if plan is not None:
            issued[DELEGATIONS.key] = self._delegations(plan, _Node(members[-1].subject, applications[-1].kem), unix_s)
        answer = encode({"ok": True, **issued, "label": label, **self.news(unix_s).to_fields()})
        if len(answer) > RESPONSE_MAX_BYTES:
            raise LocalError(f"{label}: a response of {len(answer)} bytes; at most {RESPONSE_MAX_BYTES} are allowed")
        self._registry.complete_token(token.id, machine, members, answer)
        self._trail.record(Action.ACCEPTED, _WHAT, who=members[-1].name.to_text(), about=label)
        log.info("machine enrolled role=%s nodes=%d", role.value, len(members))
        return read_message(answer)

    def _delegations(self, plan: Plan, node: _Node, unix_s: float) -> list[bytes]:
        days = (plan.until_unix_s - unix_s) / DAY_S
        return [
            delegate(self._config.owner, node, metadata, [right], days=days, unix_s=unix_s).to_wire()
            for metadata, right in plan.grants
        ]

    def _days(self, until_unix_s: float | None, unix_s: float) -> float:
        """Return how long a membership that begins now is valid."""
        days = self._config.member_days
        return days if until_unix_s is None else min(days, (until_unix_s - unix_s) / DAY_S)

    def _misuse(self, token: TokenRow, code: Refusal | None, error: Exception) -> str:
        """Return for the launcher what happened with the token of one of its machines."""
        if code is not Refusal.USED:
            return f"{_KNOWN}, and asked for what was not planned: {error}"
        machine = None if token.machine is None else self._registry.machine(token.machine)
        nodes = () if machine is None else machine.nodes
        first = f"; enrolled first is {nodes[-1].name.to_text()[:16]}" if nodes else ""
        return f"{_KNOWN}: the token was used again with another key{first}"

    def news(self, unix_s: float) -> DomainNews:
        """Return what every member follows."""
        trusts = tuple(read_public(each) for each in self._config.trusts)
        borders = tuple(each.wire for each in self.borders(unix_s))
        owner = read_public(self._config.owner / OWNER_PUBLIC)
        return DomainNews(self.root, trusts, borders, tuple(self._config.relays), owner)

    def borders(self, unix_s: float) -> list[EndpointRecord]:
        """Return the border's endpoint record, which it signs itself; none: machines have links of their own."""
        switch = self._config.switch
        if switch is None:
            return []
        certificate = read_public(switch / NODE_CERTIFICATE)
        if self._border is None or certificate != self._border_certificate:
            identity = load_identity(switch, unix_s)
            candidates = public_candidates([Endpoint.from_text(each) for each in self._config.public])
            self._border, self._border_certificate = own_record(identity, 1, candidates), certificate
        return [self._border]

    def identify(self, fields: Message, binding: bytes, nonce: bytes, unix_s: float) -> MemberConnection:
        """Return the session of a member that proves its key; its membership may have expired, to be renewed.

        Raises:
            EnrolmentError: NO_MEMBER.
            StatementError: malformed, or the proof is wrong.
        """
        proof = MemberProof.from_fields(fields)
        stranger = Unverified.from_wire(proof.certificate)
        machine = self._registry.machine_of(stranger.subject.name)
        if machine is None or machine.removed_unix_s is not None:
            self.refused("no member", stranger.subject.name)
            gone = "was removed from" if machine is not None else "is no member of"
            raise EnrolmentError(Refusal.NO_MEMBER, f"this machine {gone} the domain; join again with a new token")
        stranger.verify(self.root, min(unix_s, stranger.validity.not_after_unix_s))
        verify_member_proof(stranger.key, proof.signature, binding, nonce, proof.instance)
        return MemberConnection(stranger.subject.name, machine.id, proof.instance)

    def install(self, session: MemberConnection, fields: Message, unix_s: float) -> None:
        """Store a machine's node descriptors, and open the border for its switch.

        Raises:
            EnrolmentError: WRONG_NODES.
            StatementError: a descriptor or the endpoint record is not valid.
        """
        machine = self._member(session.machine)
        nodes = {each.name for each in machine.nodes}
        root, asked = self.root, InstallRequest.from_fields(fields)
        cards = [NodeDescriptor.from_wire(each) for each in asked.cards]
        for each in cards:
            each.member_of(root, unix_s)
        record, _ = EndpointRecord.verified(asked.record, Policy(root, []), unix_s)
        if not {record.name, *(each.name for each in cards)} <= nodes:
            raise EnrolmentError(Refusal.WRONG_NODES, "descriptors or an endpoint record of another machine's nodes")
        if record.candidates:  # else a member could aim the border's packets at any address
            raise EnrolmentError(
                Refusal.WRONG_NODES, "a machine that joins states no endpoints here: it dials the border"
            )
        for each in cards:
            self._registry.set_card(each.name, each.wire)
        peers, borders = self._config.peers, self.borders(unix_s)
        if borders and record.name not in [each.name for each in borders]:
            file = record_file_name(record.name)
            write_all(peers, {file: public(record.wire)}, force=True)
            try:
                self._member(session.machine)
            except EnrolmentError:  # removed in the meantime, perhaps before the file was there to be deleted
                (peers / file).unlink(missing_ok=True)
                raise

    def renew(self, session: MemberConnection, fields: Message, unix_s: float) -> dict[str, object]:
        """Return new memberships of a machine's nodes; one that can gain little is returned as it is.

        Raises:
            EnrolmentError: WRONG_NODES, or NO_MEMBER: it was removed, or the root revoked a membership of it.
            StatementError: malformed, or not issued here.
        """
        self._refuse_revoked(session.machine)
        machine = self._member(session.machine)
        nodes, end_s = {each.name: each for each in machine.nodes}, machine.end_unix_s
        wires, new = list[bytes](), list[Membership]()
        for wire in Keyed("certificates", MEMBERS.form).read(fields):
            stranger = Unverified.from_wire(wire)
            known = nodes.get(stranger.subject.name)
            if known is None:
                raise EnrolmentError(Refusal.WRONG_NODES, "a membership of another machine's node")
            held = Unverified.from_wire(known.certificate).validity
            used_s = unix_s - held.not_before_unix_s
            is_last = end_s is not None and held.not_after_unix_s >= int(end_s)
            if is_last or used_s < _EARLY_SHARE * (held.not_after_unix_s - held.not_before_unix_s):
                wires.append(known.certificate)
                continue
            new.append(renew(self._config.domain, wire, days=self._days(end_s, unix_s), unix_s=unix_s))
            wires.append(new[-1].wire)
        self._registry.renewed(new)
        return {"ok": True, MEMBERS.key: wires}

    def nodes(self, session: MemberConnection, fields: Message, is_online: Callable[[int], bool]) -> dict[str, object]:
        """Return one page of the directory of machines."""
        self._member(session.machine)
        listed = list[object]()
        for each in self._registry.machines(after=Keyed("after", text(64)).read(fields), limit=PAGE):
            cards = tuple(node.card for node in each.nodes if node.card is not None)
            machine = ListedMachine(each.label, each.role, cards, is_online(each.id), int(each.seen_unix_s))
            listed.append(machine.to_fields())
        return {"ok": True, "nodes": listed}

    def send(self, session: MemberConnection, fields: Message, unix_s: float) -> Name:
        """Store a mail and return its recipient.

        Raises:
            EnrolmentError: NO_MEMBER or MAILBOX_FULL.
            StatementError: malformed, not by this member, or EXPIRED: under a membership that its recipient refuses.
        """
        self._member(session.machine)
        mail = Mail.from_wire(Keyed("mail", OCTETS).read(fields))
        if mail.sender.subject.name != session.name:
            raise EnrolmentError(Refusal.WRONG_PROOF, "a mail by another sender")
        mail.sender.validity.check(unix_s, "the membership in a mail")
        self._registry.add_mail(mail.to, session.name, mail.wire)
        return mail.to

    def mail_page(self, session: MemberConnection, fields: Message) -> dict[str, object]:
        """Return a page of the member's mail; what it fetched before is deleted."""
        self._member(session.machine)
        since = Keyed("since", uint((1 << 63) - 1)).read(fields)
        mail = self._registry.mail_of(session.name, since, PAGE)
        return {"ok": True, "mail": [ListedMail(each.id, each.wire).to_fields() for each in mail]}

    def status(self, session: MemberConnection, unix_s: float) -> tuple[dict[str, object], bytes]:
        """Return what a poll answers, and a digest by which the member knows it again.

        Raises:
            EnrolmentError: NO_MEMBER, the machine was removed.
        """
        self._member(session.machine)
        self._registry.saw(session.machine, unix_s)
        news = self.news(unix_s).to_fields()
        digest = hashlib.sha256(encode(news)).digest()
        return {"ok": True, **news, "digest": digest, "mail": self._registry.has_mail(session.name)}, digest

    def has_double(self, session: MemberConnection) -> None:
        """Note that another machine runs with this member's identity."""
        self._registry.set_double(session.machine)
        self.refused("two machines with one identity", session.name)

    def refused(self, reason: str, who: Name | None = None, about: str = "") -> None:
        """Note a refusal in the audit log; ``about``: label of the machine."""
        self._trail.record(Action.REFUSED, _WHAT, who="" if who is None else who.to_text(), about=about, reason=reason)

    def flush(self) -> None:
        """Write the pending lines of the audit log. Raises ``LocalError``: it cannot be written."""
        self._audit.write(self._trail, time.monotonic(), time.time())

    def _proven_token(self, fields: Message, binding: bytes, nonce: bytes) -> TokenRow:
        token = self._registry.find_token(Keyed("id", octets(JOIN_ID_BYTES)).read(fields))
        if token is None:
            raise EnrolmentError(Refusal.UNKNOWN_TOKEN, "this domain did not make the token, or it ended long ago")
        untagged = encode({key: value for key, value in fields.items() if key != "mac"})
        proof = Keyed("mac", octets(_PROOF_BYTES)).read(fields)
        if len(nonce) != NONCE_BYTES or not hmac.compare_digest(join_proof(token.mac, binding, nonce, untagged), proof):
            raise EnrolmentError(Refusal.WRONG_PROOF, "the request is not by the holder of the token")
        return token

    def _check_token(self, token: TokenRow, keys: bytes, label: str, unix_s: float) -> None:
        if token.keys is not None and token.keys != keys:
            machine = "" if token.machine is None else self._label_of(token.machine)
            when = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(token.used_unix_s or 0))
            raise EnrolmentError(
                Refusal.USED,
                f"this token was used already{machine} at {when}; make another one with gdp domain token. If you did"
                " not use it, remove that machine",
            )
        if token.keys is None and unix_s >= token.expires_unix_s:
            when = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(token.expires_unix_s))
            raise EnrolmentError(
                Refusal.EXPIRED, f"this token expired at {when}; make another one with gdp domain token"
            )
        if token.label and token.label != label:
            raise EnrolmentError(Refusal.WRONG_NODES, f"this token is for the label {token.label!r}, not {label!r}")

    def _refuse_revoked(self, machine: int) -> None:
        """Refuse a machine of which any membership was revoked, for example with ``gdp cert revoke``."""
        known, folder = self._revocations, self._config.revocations
        try:
            present = {path: path.stat().st_mtime_ns for path in folder.iterdir()} if folder.exists() else {}
        except OSError as error:
            raise StoreError(f"{folder}: {error.strerror}") from error
        for path, changed_ns in present.items():
            if path not in known or known[path][0] != changed_ns:
                try:
                    known[path] = changed_ns, Revocation.read(parse(read_public(path))).fingerprint
                except StatementError as error:
                    known[path] = changed_ns, b""
                    log.error("revocation not taken file=%s reason=%s", path, error)
        for path in known.keys() - present.keys():
            del known[path]
        if self._registry.fingerprints(machine) & {fingerprint for _, fingerprint in known.values()}:
            raise EnrolmentError(
                Refusal.NO_MEMBER,
                "a membership of this machine was revoked: remove the machine with gdp domain remove, then join again"
                " with a new token",
            )

    def _label_of(self, machine_id: int) -> str:
        machine = self._registry.machine(machine_id)
        return "" if machine is None else f" by {machine.label!r}"

    def _member(self, machine_id: int) -> MachineRow:
        machine = self._registry.machine(machine_id)
        if machine is None or machine.removed_unix_s is not None:
            raise EnrolmentError(Refusal.NO_MEMBER, "this machine was removed from the domain")
        return machine


def _applications(
    fields: Message, role: JoinRole, identifier: bytes
) -> tuple[Sequence[Application], list[SubjectInfo]]:
    """Return the applications and their subjects: exactly the nodes of the role, each with a valid key proof."""
    applications = Keyed("nodes", many(inner(Application), MEMBERS_MAX)).read(fields)
    holders = [read_request(each.request) for each in applications]
    wanted = [(node_role.value, holders[0].label if holders else "") for _, node_role in role.nodes]
    if [(each.unit, each.label) for each in holders] != wanted:
        raise EnrolmentError(Refusal.WRONG_NODES, f"this token allows one machine with the role {role.value}")
    for application, holder, (_, node_role) in zip(applications, holders, role.nodes, strict=True):
        if holder.subject.digest != node_metadata(node_role, holder.label).digest():
            raise EnrolmentError(Refusal.WRONG_NODES, "a node with further metadata")
        try:
            application.verify(holder.key, identifier)
        except StatementError as error:
            raise EnrolmentError(Refusal.WRONG_PROOF, "a node's key did not sign the request") from error
    if len({each.subject.name for each in holders}) != len(holders):
        raise EnrolmentError(Refusal.WRONG_NODES, "two nodes with one identity")
    return applications, holders


def _keys_digest(applications: Sequence[Application], holders: Sequence[SubjectInfo]) -> bytes:
    hashed = hashlib.sha256()
    for application, holder in zip(applications, holders, strict=True):
        hashed.update(holder.key.compressed + application.kem.wire)
    return hashed.digest()


def refusal_of(error: Exception) -> dict[str, object] | None:
    """Return the response to a request that raised; None: an error of this program or of its disk."""
    if isinstance(error, EnrolmentError) and error.code is not None:
        return {"ok": False, "code": error.code.value, "error": str(error)}
    if isinstance(error, RemoteError):
        return {"ok": False, "code": Refusal.MALFORMED.value, "error": f"the request is not valid: {error}"}
    if isinstance(error, LocalError):
        return {"ok": False, "code": Refusal.UNAVAILABLE.value, "error": "the server cannot write its files now"}
    return None
