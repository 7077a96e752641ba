"""Responder to enrolment requests: verifies them, issues memberships and stores the responses.

I/O, through ``tickets`` and ``members``; no socket, and times are arguments.
A request without a valid tag costs a look-up and a few hashes. A request with a valid tag costs a decapsulation and
four verifications, at most ``OPENED_MAX`` times per ticket. A repeat of the same bytes costs only the tag.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from typing import Final, TypeVar

from fog.bootstrap.members import Authority
from fog.bootstrap.tickets import Kept, Tickets
from fog.credentials import IssuedCredentials
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import node_metadata
from gdp.crypto.x509_profile import SubjectInfo, read_request
from gdp.errors import DropReason, StatementError
from gdp.stores.audit_log import AuditLog
from gdp.stores.keyring import ROOT_CERTIFICATE, load_root
from gdp.trust.audit import Action, AuditTrail
from gdp.trust.bootstrap_ticket import (
    REFUSED,
    Application,
    EnrolmentResponse,
    Request,
    has_tag,
    open_request,
    request_head,
    seal_answer,
)

__all__ = ["OPENED_MAX", "Responder"]

OPENED_MAX: Final = 64  # opened requests per ticket; a machine needs one, or a few if responses are lost
_REMEMBERED: Final = 1_024  # tickets
_WHAT: Final = "enrolment"
_KNOWN: Final = "somebody has read its user data"

_T = TypeVar("_T")


class Responder:
    """Handler of requests, sequential, for one thread; the domain's audit log records each refusal.

    Raises:
        LocalError: other users can access the domain's folder.
    """

    def __init__(self, tickets: Tickets, authority: Authority) -> None:
        self._tickets = tickets
        self._authority = authority
        self._trail = AuditTrail()
        self._trail.begin()
        self._audit = AuditLog(authority.domain)
        self._opened: OrderedDict[bytes, int] = OrderedDict()
        self._answered: OrderedDict[bytes, tuple[bytes, bytes]] = OrderedDict()  # SHA-256 of the request, response

    def is_expected(self, identifier: bytes) -> bool:
        """Return whether a ticket has this id; the rest of its request may then be read.

        Raises:
            StoreError: the tickets cannot be read now.
        """
        if self._tickets.knows(identifier):
            return True
        self._refuse("no such ticket")
        return False

    def answer(self, request: bytes, unix_s: float) -> bytes:
        """Return the response to a complete request; empty: no response.

        Raises:
            StoreError, LocalError: tickets or keys cannot be read or written now; the machine retries.
        """
        try:
            head = request_head(request)
        except StatementError:
            head = None
        if head is None or head[1] != len(request):
            self._refuse("not a request")
            return b""
        identifier = head[0]
        kept = self._tickets.find(identifier)
        if kept is None or not has_tag(kept.token, request):
            self._refuse("wrong token" if kept is not None else "no such ticket")
            return b""
        digest = hashlib.sha256(request).digest()
        if self._answered.get(identifier, (b"", b""))[0] == digest and not kept.is_reported:
            return self._answered[identifier][1]
        about = f"{kept.cluster}/{kept.machine}"
        if kept.is_reported or not self._may_open(identifier):
            self._refuse("a token that was misused" if kept.is_reported else "too many requests", about)
            return REFUSED
        try:
            sent = self._granted(identifier, kept, request, unix_s)
        except StatementError as error:
            self._misused(identifier, f"{_KNOWN}, and asked for what was not planned: {error}", about)
            return REFUSED
        if sent == REFUSED:
            return sent
        _remember(self._answered, identifier, (digest, sent))
        return sent

    def flush(self) -> None:
        """Write the pending entries of the audit log.

        Raises:
            LocalError: the log cannot be written; the pending entries are lost.
        """
        self._audit.write(self._trail, time.monotonic(), time.time())

    def _granted(self, identifier: bytes, kept: Kept, request: bytes, unix_s: float) -> bytes:
        asked = open_request(self._tickets.responder, request)
        holders = _verified(identifier, kept, asked)
        keys = _keys_digest(asked, holders)
        about = f"{kept.cluster}/{kept.machine}"
        if kept.keys is not None and kept.keys != keys:
            enrolled = (
                f"; enrolled first is {kept.issued_credentials.proxy[:16]}"
                if kept.issued_credentials is not None
                else ""
            )
            self._misused(identifier, f"{_KNOWN}: the token was used again with another key{enrolled}", about)
            return REFUSED
        if unix_s >= kept.expires_unix_s:
            self._refuse("a token that has run out", about)
            return REFUSED
        if kept.answer is not None:
            return seal_answer(kept.token, request, asked.answer_secret, kept.answer)
        if not self._tickets.use(identifier, keys):
            self._refuse("a ticket that was taken back", about)
            return REFUSED
        answer, issued_credentials = self._issue(kept, asked.applications, unix_s)
        sealed = seal_answer(kept.token, request, asked.answer_secret, answer)
        if not self._tickets.complete(identifier, answer, issued_credentials, f"as {issued_credentials.proxy[:16]}"):
            self._refuse("a ticket that was taken back", about)
            return REFUSED
        self._trail.record(Action.ACCEPTED, _WHAT, who=issued_credentials.proxy, about=about)
        return sealed

    def _issue(
        self, kept: Kept, applications: tuple[Application, ...], unix_s: float
    ) -> tuple[bytes, IssuedCredentials]:
        granted, members = [], list[Membership]()
        for planned, application in zip(kept.seats, applications, strict=True):
            member, given = self._authority.grant(
                application, planned.carried, until_unix_s=kept.until_unix_s, unix_s=unix_s
            )
            granted.append(given)
            members.append(member)
        root = load_root(self._authority.domain / ROOT_CERTIFICATE)
        serves = next((each for each in members if each.role is Role.PROXY), members[0])
        until_s = float(min(each.not_after_unix_s for each in members))
        issued_credentials = IssuedCredentials(
            serves.name.to_text(), until_s, tuple(each.fingerprint.hex() for each in members)
        )
        return EnrolmentResponse(root.to_pem(), tuple(granted)).to_wire(), issued_credentials

    def _may_open(self, identifier: bytes) -> bool:
        opened = self._opened.get(identifier, 0)
        _remember(self._opened, identifier, opened + 1)
        return opened < OPENED_MAX

    def _misused(self, identifier: bytes, detail: str, about: str) -> None:
        self._tickets.misused(identifier, detail)
        self._answered.pop(identifier, None)
        self._refuse("a token that somebody else knows", about)

    def _refuse(self, reason: str, about: str = "") -> None:
        self._trail.record(Action.REFUSED, _WHAT, about=about, reason=reason)


def _verified(identifier: bytes, kept: Kept, asked: Request) -> list[SubjectInfo]:
    """Return the subjects of the applications: exactly the planned ones, each with a valid key proof."""
    if len(asked.applications) != len(kept.seats):
        raise StatementError(DropReason.WRONG_NAME, "another number of members")
    holders = []
    for planned, application in zip(kept.seats, asked.applications, strict=True):
        seat, holder = planned.seat, read_request(application.request)
        digest = node_metadata(seat.role, seat.label).digest()
        if (holder.unit, holder.label, holder.subject.digest) != (seat.role.value, seat.label, digest):
            raise StatementError(DropReason.WRONG_NAME, f"{holder.unit[:16]!r} {holder.label!r}, not {seat.label!r}")
        application.verify(holder.key, identifier)
        holders.append(holder)
    return holders


def _keys_digest(asked: Request, holders: list[SubjectInfo]) -> bytes:
    hashed = hashlib.sha256()
    for application, holder in zip(asked.applications, holders, strict=True):
        hashed.update(holder.key.compressed + application.kem.wire)
    return hashed.digest()


def _remember(kept: OrderedDict[bytes, _T], identifier: bytes, value: _T) -> None:
    kept[identifier] = value
    kept.move_to_end(identifier)
    if len(kept) > _REMEMBERED:
        kept.popitem(last=False)
