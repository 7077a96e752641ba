"""Agent of a member machine: it keeps a connection to the enrolment server and does what must not be forgotten.

I/O; blocking, one thread. It renews memberships after two thirds of their life, writes endpoint records of borders,
fetches mail, and makes the nodes reload. Nothing that it does is urgent: while it does not run, or no server can be
reached, the nodes go on until their memberships end.
"""

from __future__ import annotations

import contextlib
import json
import logging
import random
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Final

from gdp.config.config import SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.control.endpoints import EndpointRecord
from gdp.crypto.certificates import Membership, Unverified
from gdp.crypto.identity import Identity
from gdp.crypto.schema import FLAG, OCTETS, Keyed
from gdp.enrolment.channel import Channel, connect_any
from gdp.enrolment.domain_client import ReceivedMail, delete_mail, fetch_mail, read_inbox
from gdp.enrolment.member_files import MemberFiles
from gdp.enrolment.member_setup import RELAY_FILE, record_file_name, update_relays
from gdp.errors import GdpError, LocalError, RemoteError
from gdp.host_port import split_host_port
from gdp.intervals import RELOAD_S
from gdp.links.endpoint_files import RECORD_SUFFIX, own_record
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket
from gdp.names import Name
from gdp.nodes.membership import load_policy
from gdp.requests import Backoff
from gdp.state.control_protocol import Command
from gdp.stores.files import public, read_public, write_all
from gdp.stores.issue import install_delegation
from gdp.stores.keyring import (
    CARD,
    NODE_CERTIFICATE,
    OWNER_PUBLIC,
    ROOT_CERTIFICATE,
    load_card,
    load_identity,
    load_node_keys,
    load_public_key,
    load_root,
    parsed,
    save_identity,
)
from gdp.trust.delegation import Delegation
from gdp.trust.domain import Policy
from gdp.trust.enrolment_wire import (
    INSTANCE_BYTES,
    MEMBERS,
    DomainNews,
    EnrolmentError,
    InstallRequest,
    UnreachableError,
)

log = logging.getLogger(__name__)

DELEGATION_KIND: Final = "delegation"  # the body is the content of a delegation's file
POLL_S: Final = 45.0
_BACKOFF: Final = Backoff(1.0, 60.0)
_REFUSED_S: Final = 300.0  # after a refusal, which rarely changes by itself
_RENEW_SHARE: Final = 2 / 3

MailHandler = Callable[[MemberFiles, ReceivedMail], None]


class Agent:
    """The agent of one machine.

    Args:
        directory: of the machine, as ``gdp join`` made it.
        handlers: by kind of mail; a handler that returns, or raises ``RemoteError``, has handled the mail, which is
            deleted then. Other mail stays in the inbox.
        poll_s: seconds that the server may keep a question.
        jitter: returns a factor from 0 to 1.

    Raises:
        LocalError: the directory is no member's.
    """

    def __init__(
        self,
        directory: Path,
        handlers: Mapping[str, MailHandler] | None = None,
        *,
        poll_s: float = POLL_S,
        clock: Callable[[], float] = time.time,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        self._files = MemberFiles.load(directory)
        self._handlers: dict[str, MailHandler] = {DELEGATION_KIND: _install_delegation, **(handlers or {})}
        self._poll_s = poll_s
        self._clock = clock
        self._jitter = jitter
        self._instance = secrets.token_bytes(INSTANCE_BYTES)
        self._ended = threading.Event()
        self._channel: Channel | None = None
        self._tries = 0
        self._last_success_unix_s: float | None = None

    def stop(self) -> None:
        """Make ``run`` return soon; any thread may call it."""
        self._ended.set()
        channel = self._channel
        if channel is not None:
            channel.interrupt()

    def run(self) -> None:
        """Serve until ``stop``; no error of a server or of a file ends it."""
        while not self._ended.is_set():
            try:
                self._serve_connection()
            except UnreachableError as error:
                self._pause("unreachable", error, self._next_backoff_s())
            except EnrolmentError as error:
                self._pause("refused", error, _REFUSED_S)
            except GdpError as error:
                self._pause("failed", error, self._next_backoff_s())

    def _serve_connection(self) -> None:
        identity = load_identity_at_any_time(self._files.mail_identity)
        with connect_any(self._files.servers, self._files.fingerprint) as channel:
            self._channel = channel
            try:
                channel.identify(identity, self._instance)
                self._announce(channel)
                digest = b""
                while not self._ended.is_set():
                    self._renew(channel)
                    request = {"op": "poll", "digest": digest, "wait_s": self._poll_s if digest else 0.0}
                    answer = channel.request(request, timeout_s=self._poll_s + RELOAD_S)
                    if (current := Keyed("digest", OCTETS).read(answer)) != digest:
                        self._take_news(DomainNews.from_fields(answer))
                        digest = current
                    if Keyed("mail", FLAG).read(answer):
                        self._take_mail(channel)
                    self._succeeded(channel)
            except RemoteError as error:
                raise UnreachableError(f"{channel.server}: a response that is not valid: {error}") from error
            finally:
                self._channel = None

    def _announce(self, channel: Channel) -> None:
        """Send the descriptors and the endpoint record, which the border keeps as long as they are valid."""
        switch = load_identity_at_any_time(self._files.config.switch)
        if switch.member.not_after_unix_s < self._clock():
            return  # after the renewal
        record = own_record(switch, _uplinks(self._files.directory), ())
        cards = tuple(read_public(each / CARD) for each in self._files.nodes)
        channel.request({"op": "install", **InstallRequest(cards, record.wire).to_fields()})

    def _renew(self, channel: Channel) -> None:
        """Renew the memberships that have little left; the nodes keep their keys and names."""
        due = [each for each in self._files.nodes if _is_due(each, self._clock())]
        if not due:
            return
        certificates = [_certificate(each).wire for each in due]
        answer = channel.request({"op": "renew", "certificates": certificates})
        changed = False
        for node, certificate in zip(due, MEMBERS.read(answer), strict=True):
            if certificate != _certificate(node).wire:
                member = Membership.from_wire(certificate, channel.root, self._clock())
                save_identity(node, load_node_keys(node).admitted(member, channel.root), force=True)
                log.info("membership renewed node=%s until_unix_s=%d", node.name, member.not_after_unix_s)
                reload_node(node)
                changed = True
        if changed:
            self._announce(channel)

    def _take_news(self, news: DomainNews) -> None:
        root, known = news.root, load_root(self._files.domain.root)
        roots, present = [each.wire for each in root.lineage], [each.wire for each in known.lineage]
        if len(roots) > len(present) and roots[: len(present)] == present:
            for node in self._files.nodes:
                write_all(node, {ROOT_CERTIFICATE: public(root.to_pem())}, force=True)
                reload_node(node)
        if self._files.is_border:
            return  # its folder of peers is the enrolment server's
        policy = Policy(root, [])
        borders = [EndpointRecord.verified(each, policy, self._clock())[0] for each in news.borders]
        peers = self._files.config.peers
        files = {record_file_name(each.name): public(each.wire) for each in borders}
        changed = {name: file for name, file in files.items() if not _holds(peers / name, file.data)}
        write_all(peers, changed, force=True)
        for path in peers.glob(f"*{RECORD_SUFFIX}"):
            if borders and path.name not in files:
                path.unlink(missing_ok=True)
        self._follow_relays({each.name: news.relays for each in borders})

    def _follow_relays(self, relays: Mapping[Name, Sequence[str]]) -> None:
        """Dial the relays where they are now: the relay ends, and whatever runs it starts it again."""
        for endpoint in chain.from_iterable(relays.values()):
            split_host_port(endpoint)
        if not update_relays(self._files.directory, relays):
            return
        log.info("relays changed borders=%d", len(relays))
        path = self._files.directory / RELAY_FILE
        with contextlib.suppress(NotRunningError):
            config = RelayConfig.load(path)
            from gdp.nodes.relay import relay_control_path

            ask_node(relay_control_path(config, load_card(config.identity / CARD).name), Command.DRAIN, RELOAD_S)

    def _take_mail(self, channel: Channel) -> None:
        fetch_mail(channel, self._files.inbox)
        policy, identity = load_policy(self._files.domain), load_identity_at_any_time(self._files.mail_identity)
        for mail in list(read_inbox(self._files.inbox, policy, identity.name, 0)):
            handler = self._handlers.get(mail.kind)
            if handler is None:
                continue
            try:
                handler(self._files, mail)
            except RemoteError as error:
                log.error("mail not valid kind=%s sender=%s reason=%s", mail.kind, mail.sender.name.short, error)
            except GdpError as error:
                log.error("mail kept kind=%s sender=%s reason=%s", mail.kind, mail.sender.name.short, error)
                continue
            delete_mail(self._files.inbox, mail.number)

    def _succeeded(self, channel: Channel) -> None:
        self._tries = 0
        self._last_success_unix_s = self._clock()
        self._write_status("connected", channel.server, "")

    def _pause(self, state: str, error: GdpError, pause_s: float) -> None:
        if self._ended.is_set():
            return
        log.warning("enrolment server %s reason=%s next_s=%.0f", state, error, pause_s)
        self._write_status(state, "", str(error))
        self._ended.wait(pause_s)

    def _next_backoff_s(self) -> float:
        self._tries += 1
        return _BACKOFF.random_pause_s(self._tries, self._jitter())

    def _write_status(self, state: str, server: str, error: str) -> None:
        ends = {each.name: _certificate(each).validity.not_after_unix_s for each in self._files.nodes}
        last = self._last_success_unix_s
        status = {
            "state": state,
            "server": server,
            "error": error,
            "last_success_unix_s": None if last is None else int(last),
            "membership_until_unix_s": ends,
        }
        path = self._files.status_file
        try:
            write_all(path.parent, {path.name: public(json.dumps(status).encode() + b"\n")}, force=True)
        except LocalError as failure:
            log.error("status not written reason=%s", failure)


def reload_node(node: Path) -> None:
    """Make a running node read its files again; one that does not run reads them at its start."""
    with contextlib.suppress(NotRunningError):
        response = ask_node(find_control_socket(node), Command.RELOAD, RELOAD_S)
        if not response.is_ok:
            log.error("node not reloaded node=%s reason=%s", node.name, response.error)


def load_identity_at_any_time(directory: Path) -> Identity:
    """Return a node whose membership may have expired, to be renewed. Raises ``LocalError``: as ``load_identity``."""
    validity = _certificate(directory).validity
    return load_identity(directory, min(time.time(), validity.not_after_unix_s))


def _certificate(node: Path) -> Unverified:
    path = node / NODE_CERTIFICATE
    return parsed(path, Unverified.from_wire, read_public(path))


def _is_due(node: Path, unix_s: float) -> bool:
    validity = _certificate(node).validity
    whole_s = validity.not_after_unix_s - validity.not_before_unix_s
    return unix_s >= validity.not_before_unix_s + _RENEW_SHARE * whole_s


def _holds(path: Path, data: bytes) -> bool:
    return path.exists() and read_public(path) == data


def _uplinks(directory: Path) -> int:
    config = SwitchConfig.load(directory / "switch.yaml").links
    return 1 if config is None else max(len(config.uplinks), 1)


def _install_delegation(files: MemberFiles, mail: ReceivedMail) -> None:
    """Store a delegation by the domain's owner that came by mail, and make the proxy read it.

    Raises:
        LocalError: it is of another owner: a person decides about that.
        StatementError: it is not valid, or for another node.
    """
    delegation = Delegation.from_wire(mail.body)
    owner = load_public_key(files.directory / OWNER_PUBLIC)
    if delegation.subject.owner_key != owner.compressed:
        raise LocalError("a delegation of another owner than the domain's")
    install_delegation(files.mail_identity, delegation, force=True)
    reload_node(files.mail_identity)
