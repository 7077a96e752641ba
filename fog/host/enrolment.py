"""Enrolment of a machine at its first start: it generates keys, and requests memberships with its ticket's token.

I/O. Keys are on disk before they are sent, so a restarted machine uses the same keys. After enrolment the ticket is
deleted; a machine without a ticket does not enrol.
"""

from __future__ import annotations

import logging
import os
import secrets
import socket
import time
from contextlib import closing
from pathlib import Path
from typing import Final

from fog.host.bundle import TICKET_FILE
from gdp.crypto.certificates import Root
from gdp.errors import LocalError, StatementError
from gdp.stores.files import read_private, read_public
from gdp.stores.issue import install_delegation, install_membership, make_node_keys
from gdp.stores.keyring import REQUEST, load_node_keys
from gdp.trust.bootstrap_ticket import (
    ANSWER_HEAD_BYTES,
    ANSWER_SECRET_BYTES,
    REFUSED,
    Application,
    EnrolmentResponse,
    Ticket,
    answer_bytes,
    apply,
    open_answer,
    seal_request,
)
from gdp.trust.delegation import Delegation

__all__ = ["enrol"]

log = logging.getLogger(__name__)

_PATIENCE_S: Final = 900.0  # the launcher stops waiting at the same time
_TRY_S: Final = 10.0
_PAUSE_MIN_S: Final = 0.2
_PAUSE_MAX_S: Final = 5.0


def enrol(home: Path, *, patience_s: float = _PATIENCE_S) -> bool:
    """Enrol the machine if its folder has a ticket; return whether it had one.

    Raises:
        LocalError: the ticket is invalid; the responder refuses it; no response arrives within ``patience_s``; or the
            response does not match the machine's keys.
    """
    path = home / TICKET_FILE
    if not path.exists():
        return False
    ticket = Ticket.from_json(read_private(path))
    applications = [_application(home, ticket, index) for index in range(len(ticket.seats))]
    answer = _ask(ticket, applications, patience_s)
    if len(answer.granted) != len(ticket.seats):
        raise LocalError(f"{path}: answered for {len(answer.granted)} members of {len(ticket.seats)}")
    try:
        root = Root.from_wire(answer.root)
        for seat, granted in zip(ticket.seats, answer.granted, strict=True):
            install_membership(home / seat.folder, granted.member, root, force=True)
            for each in granted.delegations:
                install_delegation(home / seat.folder, Delegation.from_wire(each), force=True)
    except StatementError as error:
        raise LocalError(f"{path}: the answer does not hold: {error}") from error
    path.unlink()
    log.info("machine enrolled members=%d", len(ticket.seats))
    return True


def _application(home: Path, ticket: Ticket, index: int) -> Application:
    """Generate a member's keys, or load those of an earlier start, and return an application with them."""
    seat = ticket.seats[index]
    folder = home / seat.folder
    if not (folder / REQUEST).exists():  # this file is written last
        make_node_keys(folder, seat.role, seat.label, force=True)
    keys = load_node_keys(folder)
    return apply(ticket.token, keys.key, read_public(folder / REQUEST), keys.kem.public)


def _ask(ticket: Ticket, applications: list[Application], patience_s: float) -> EnrolmentResponse:
    """Send the request until a response arrives."""
    end_s, pause_s, reason = time.monotonic() + patience_s, _PAUSE_MIN_S, ""
    secret = secrets.token_bytes(ANSWER_SECRET_BYTES)
    request = seal_request(ticket, applications, secret)  # the same for each attempt
    while True:
        for address in ticket.addresses:
            try:
                return open_answer(ticket.token, request, secret, _exchange(address, request))
            except (OSError, StatementError) as error:
                said = f"{address}: {error}"
                if said != reason:
                    log.warning("not enrolled yet reason=%s", said)
                reason = said
        if time.monotonic() + pause_s >= end_s:
            raise LocalError(f"this machine was not enrolled within {patience_s:.0f} s: {reason}")
        time.sleep(pause_s)  # no event reports that the launcher is reachable again
        pause_s = min(2 * pause_s, _PAUSE_MAX_S)


def _exchange(address: str, request: bytes) -> bytes:
    """Return the body of the response."""
    with closing(_connected(address)) as peer:
        peer.settimeout(_TRY_S)
        peer.sendall(request)
        head = _received(peer, 1)
        if head == REFUSED:
            raise LocalError(f"{address} refuses this machine's ticket")
        return _received(peer, answer_bytes(head + _received(peer, ANSWER_HEAD_BYTES - 1)))


def _connected(address: str) -> socket.socket:
    if address.startswith("unix:"):
        path = Path(address.removeprefix("unix:"))
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                peer.settimeout(_TRY_S)
                peer.connect(f"/proc/self/fd/{folder}/{path.name}")  # a socket's path has at most 107 bytes
            finally:
                os.close(folder)
        except OSError:
            peer.close()
            raise
        return peer
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    if not port.isdecimal():
        raise LocalError(f"{address!r} is no address of a launcher: expected tcp://HOST:PORT or unix:PATH")
    return socket.create_connection((host.strip("[]"), int(port)), _TRY_S)


def _received(peer: socket.socket, size: int) -> bytes:
    end_s = time.monotonic() + _TRY_S
    found = bytearray()
    while len(found) < size:
        peer.settimeout(max(end_s - time.monotonic(), 0.001))
        data = peer.recv(size - len(found))
        if not data:
            raise ConnectionResetError("the connection was closed")
        found += data
    return bytes(found)
