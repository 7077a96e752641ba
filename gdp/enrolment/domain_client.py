"""Client of a domain's enrolment server for programs of a member: the directory of machines, and mail between them.

I/O; blocking. ``DomainClient.open(DIR)`` needs only the directory that ``gdp join`` or ``gdp domain create`` made::

    with DomainClient.open(Path("/var/lib/gdp/lab")) as domain:
        server = domain.find("server")
        domain.send(server.name, "delegation-request", body)
        for mail in domain.read_mails(since=0):
            ...

Mail that arrives lies in ``DIR/inbox``, one file each, fetched by the agent or by a program like this one. A
program remembers the number of the last mail that it has handled, and deletes mail that no other program needs.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.closing import ClosedOnExit
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.schema import Keyed, inner, many
from gdp.crypto.statements import parse
from gdp.enrolment.channel import Channel, connect_any
from gdp.enrolment.member_files import MemberFiles
from gdp.errors import GdpError, LocalError, StatementError
from gdp.names import Name
from gdp.nodes.membership import load_policy
from gdp.stores.files import NewFile, private, read_private, write_all
from gdp.stores.keyring import load_identity
from gdp.trust.domain import Policy
from gdp.trust.enrolment_wire import INSTANCE_BYTES, PAGE, ListedMachine, ListedMail
from gdp.trust.mail import Mail
from gdp.trust.node_descriptor import NodeDescriptor

log = logging.getLogger(__name__)

_MACHINES: Final = Keyed("nodes", many(inner(ListedMachine), PAGE))
_MAILS: Final = Keyed("mail", many(inner(ListedMail), PAGE))
INBOX_MAX: Final = 4_096  # files; more mail waits at the server
_MAIL: Final = re.compile(r"([0-9]{16})\.mail")


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A member machine of the domain, as the server lists it; the descriptors were verified here.

    Args:
        role: ``robot``, ``switch``, ``leaf``, or ``border`` for the domain's own machine.
        switch, proxy: descriptors (``node.card``) of its nodes; None: it has no such node.
        is_online: its agent is connected now.
        seen_unix_s: when its agent was last connected, by the server's clock; 0: never.
    """

    label: str
    role: str
    switch: NodeDescriptor | None
    proxy: NodeDescriptor | None
    is_online: bool
    seen_unix_s: int

    @property
    def name(self) -> Name:
        """Return the name to which mail for this machine goes: its proxy's, else its switch's."""
        node = self.proxy or self.switch
        if node is None:
            raise LocalError(f"{self.label}: has not finished joining")
        return node.name


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedMail:
    """Mail whose sender is a member of this domain.

    Args:
        number: rises; of the file in the inbox.
        sender: the verified membership.
    """

    number: int
    sender: Membership
    kind: str
    body: bytes
    sent_unix_ms: int


class DomainClient(ClosedOnExit):
    """A member's authenticated connection to the enrolment server.

    Args:
        files: of the member; its identity is the proxy's, or the switch's where there is no proxy.
    """

    def __init__(self, files: MemberFiles, identity: Identity, policy: Policy, channel: Channel) -> None:
        self._files = files
        self._policy = policy
        self._channel = channel
        self.identity = identity

    @classmethod
    def open(cls, directory: Path, *, timeout_s: float = 10.0) -> DomainClient:
        """Connect as the member whose files are in ``directory``.

        Raises:
            LocalError: the directory is no member's, or its keys cannot be read.
            EnrolmentError: the server cannot be reached, or refuses.
        """
        files = MemberFiles.load(directory)
        identity = load_identity(files.mail_identity, time.time())
        channel = connect_any(files.servers, files.fingerprint, timeout_s=timeout_s)
        try:
            channel.identify(identity, secrets.token_bytes(INSTANCE_BYTES))
        except GdpError:
            channel.close()
            raise
        return cls(files, identity, load_policy(files.domain), channel)

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()

    def nodes(self) -> list[Machine]:
        """Return the machines of the domain, in the order of their labels; removed ones are left out.

        Raises:
            EnrolmentError: as ``Channel.request``.
        """
        found: list[Machine] = []
        after = ""
        while page := _MACHINES.read(self._channel.request({"op": "nodes", "after": after})):
            found += [self._machine(each) for each in page]
            after = found[-1].label
        return found

    def find(self, label: str) -> Machine:
        """Return the machine with this label. Raises ``LocalError``: there is none, with the labels that exist."""
        machines = self.nodes()
        for each in machines:
            if each.label == label:
                return each
        known = ", ".join(each.label for each in machines)
        raise LocalError(f"no machine {label!r} is in the domain; there are {known}")

    def send(self, to: Name, kind: str, body: bytes) -> None:
        """Send mail to a node of the domain; the server keeps it until the node fetches it.

        Args:
            kind: lower-case words joined by ``-``; ``delegation`` is handled by the agent.
            body: at most ``MAIL_BODY_MAX_BYTES``.

        Raises:
            LocalError: kind or body are out of bounds, or the membership has ended.
            EnrolmentError: no such node, its mailbox is full, or as ``Channel.request``.
        """
        self.identity = load_identity(self._files.mail_identity, time.time())  # it may have been renewed
        self._channel.request({"op": "send", "mail": Mail.make(self.identity, to, kind, body, time.time())})

    def read_mails(self, since: int = 0) -> list[ReceivedMail]:
        """Fetch new mail into the inbox, and return what is there after number ``since``, the oldest first.

        Raises:
            EnrolmentError: as ``Channel.request``.
            LocalError: the inbox cannot be written.
        """
        fetch_mail(self._channel, self._files.inbox)
        return list(read_inbox(self._files.inbox, self._policy, self.identity.name, since))

    def delete(self, number: int) -> None:
        """Delete a mail of the inbox that was handled; no effect if it is gone."""
        delete_mail(self._files.inbox, number)

    def _machine(self, listed: ListedMachine) -> Machine:
        cards = [NodeDescriptor.from_wire(each) for each in listed.cards]
        now = time.time()
        for each in cards:
            self._policy.verify_membership(each.stranger.wire, now)
        return Machine(
            label=listed.label,
            role=listed.role,
            switch=next((each for each in cards if each.stranger.role.is_switch), None),
            proxy=next((each for each in cards if not each.stranger.role.is_switch), None),
            is_online=listed.is_online,
            seen_unix_s=listed.seen_unix_s,
        )


def fetch_mail(channel: Channel, inbox: Path) -> int:
    """Move the mail that waits at the server into the inbox; return how many mails came.

    A mail is deleted at the server only after it is on the disk here. Of one sender at most a quarter of ``INBOX_MAX``
    mails are kept, so that mail of a kind that no program here handles displaces no other; more is dropped and logged.

    Raises:
        EnrolmentError: as ``Channel.request``.
        LocalError: the inbox cannot be written, or holds ``INBOX_MAX`` mails already.
    """
    held = _held_by_sender(inbox)
    since = fetched = 0
    while page := _MAILS.read(channel.request({"op": "receive", "since": since})):
        if held.total() + len(page) > INBOX_MAX:
            raise LocalError(f"{inbox}: holds {INBOX_MAX} mails; delete those that were handled")
        files = dict[str, NewFile]()
        for each in page:
            sender = _sender_of(each.mail)
            if held[sender] >= INBOX_MAX // 4:
                log.warning(
                    "mail dropped sender=%s reason=it has %d mails here already", sender.hex()[:6], held[sender]
                )
                continue
            held[sender] += 1
            files[_mail_path(inbox, each.number).name] = private(each.mail)
        write_all(inbox, files, force=True)
        since = max(each.number for each in page)
        fetched += len(files)
    return fetched


def read_inbox(inbox: Path, policy: Policy, recipient: Name, since: int) -> Iterator[ReceivedMail]:
    """Yield the mails after a number; what is not for ``recipient`` or by no member is deleted.

    Raises:
        LocalError: a file cannot be read.
    """
    numbered = [(int(match[1]), path) for path in inbox.glob("*.mail") if (match := _MAIL.fullmatch(path.name))]
    for number, path in sorted(numbered):
        if number <= since:
            continue
        try:
            mail = Mail.from_wire(read_private(path))
            sender = policy.verify_membership(mail.sender.wire, time.time())
        except StatementError as error:
            log.warning("mail deleted file=%s reason=%s", path.name, error)
            path.unlink(missing_ok=True)
            continue
        if mail.to != recipient:
            path.unlink(missing_ok=True)
            continue
        yield ReceivedMail(number=number, sender=sender, kind=mail.kind, body=mail.body, sent_unix_ms=mail.sent_unix_ms)


def delete_mail(inbox: Path, number: int) -> None:
    """Delete a mail that was handled; no effect if it is gone."""
    _mail_path(inbox, number).unlink(missing_ok=True)


def _held_by_sender(inbox: Path) -> Counter[bytes]:
    """Return how many mails of each sender an inbox holds."""
    held = Counter[bytes]()
    for path in inbox.glob("*.mail"):
        try:
            held[_sender_of(read_private(path))] += 1
        except LocalError:
            if path.exists():  # else another program has handled and deleted it
                raise
    return held


def _sender_of(wire: bytes) -> bytes:
    """Return the name under which a mail is signed, unverified; empty if it is no mail."""
    try:
        return bytes(parse(wire).signer)
    except StatementError:
        return b""


def _mail_path(inbox: Path, number: int) -> Path:
    return inbox / f"{number:016d}.mail"
