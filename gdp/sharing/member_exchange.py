"""Exchange through the enrolment server of the domain, as a machine that has joined uses it.

I/O; blocking. The connection opens when the first call needs it. Where an agent runs in the same process, the agent
fetches the mail, and this exchange reads what lies in the inbox.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, TypeVar

from gdp.enrolment.domain_client import DomainClient, delete_mail, read_inbox
from gdp.enrolment.member_files import MemberFiles
from gdp.errors import GdpError
from gdp.intervals import CACHE_S
from gdp.names import Name
from gdp.nodes.membership import load_policy
from gdp.sharing.exchange import Mail, MailKind
from gdp.stores.keyring import CARD, load_card
from gdp.trust.enrolment_wire import UnreachableError
from gdp.trust.node_descriptor import NodeDescriptor

_KINDS: Final = frozenset(each.value for each in MailKind)
_T = TypeVar("_T")


class MemberExchange:
    """Exchange of one machine.

    Args:
        directory: of the machine, as ``gdp join`` or ``gdp domain create`` made it.
        fetches: whether mail is asked for at the server; else an agent puts it into the inbox.
        clock: monotonic seconds.

    Raises:
        LocalError: the directory is no member's.
    """

    def __init__(self, directory: Path, *, fetches: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._files = MemberFiles.load(directory)
        self._fetches = fetches
        self._clock = clock
        self._client: DomainClient | None = None
        self._nodes: Sequence[NodeDescriptor] = ()
        self._nodes_until_s: float | None = None
        self._failure: tuple[float, GdpError] | None = None  # until then, and why
        self._seen = 0  # number of the last mail that needs no further look

    def close(self) -> None:
        """Close the connection, if there is one."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def nodes(self) -> Sequence[NodeDescriptor]:
        """Return the proxies of the domain, as the server listed them less than half a minute ago.

        Raises:
            EnrolmentError: the server cannot be reached, or refuses.
        """
        if self._nodes_until_s is None or self._clock() >= self._nodes_until_s:
            machines = self._request(lambda client: client.nodes())
            self._nodes = [each.proxy for each in machines if each.proxy is not None]
            self._nodes_until_s = self._clock() + CACHE_S
        return self._nodes

    def send(self, to: Name, kind: str, data: bytes) -> None:
        """Leave a mail for a node at the server.

        Raises:
            LocalError: it is too large.
            EnrolmentError: the server cannot be reached, or refuses.
        """
        self._request(lambda client: client.send(to, kind, data))

    def receive_mail(self) -> Iterator[Mail]:
        """Yield the mails of a ``MailKind``; each is removed when the next one is asked for.

        Raises:
            EnrolmentError: the server cannot be reached, or refuses; what the inbox holds was yielded before.
        """
        failure = None
        if self._fetches:
            try:
                self._request(lambda client: client.read_mails(self._seen))
            except GdpError as error:
                failure = error
        recipient = load_card(self._files.mail_identity / CARD).name
        inbox = self._files.inbox
        for mail in list(read_inbox(inbox, load_policy(self._files.domain), recipient, self._seen)):
            if mail.kind in _KINDS:
                yield Mail(sender=mail.sender.label, kind=mail.kind, data=mail.body)
                delete_mail(inbox, mail.number)
            self._seen = mail.number
        if failure is not None:
            raise failure

    def _request(self, ask: Callable[[DomainClient], _T]) -> _T:
        """Return an answer of the server; a connection that broke since the last call is opened again."""
        if self._failure is not None and self._clock() < self._failure[0]:
            raise self._failure[1]
        self._failure = None
        try:
            if self._client is not None:
                try:
                    return ask(self._client)
                except UnreachableError:
                    self.close()
            self._client = DomainClient.open(self._files.directory)
            return ask(self._client)
        except UnreachableError as error:
            self.close()
            self._failure = self._clock() + CACHE_S, error
            raise
