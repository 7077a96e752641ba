"""First bytes of a connection at a border's TLS port: they decide whether the relay or the enrolment server serves it.

I/O. The bytes stay in the kernel. A connection for the enrolment server goes there as a descriptor, through a Unix
datagram socket: that server sees the peer's own address. Source: unix(7), ``SCM_RIGHTS``; socket(7), ``SO_RCVLOWAT``.
"""

from __future__ import annotations

import logging
import select
import socket
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Final

from gdp.links.relay_loop import RelayLoop
from gdp.relay.client_hello import ENROLMENT_ALPN, HELLO_MAX_BYTES, read_client_hello

log = logging.getLogger(__name__)

_OVER: Final = select.EPOLLRDHUP | select.EPOLLHUP | select.EPOLLERR  # no more bytes come


class HelloWait:
    """A new connection until its first bytes say whose it is.

    Args:
        accepted: non-blocking.
        chosen: called once, with the socket and whether the enrolment server serves it; not called after ``end``.
    """

    def __init__(
        self, *, loop: RelayLoop, accepted: socket.socket, chosen: Callable[[HelloWait, socket.socket, bool], None]
    ) -> None:
        self._loop = loop
        self._socket = accepted
        self._chosen = chosen
        self.since_s = time.monotonic()
        loop.register(accepted.fileno(), select.EPOLLIN | select.EPOLLRDHUP, self._handle)

    def end(self, reason: str) -> None:
        """Close the connection."""
        log.info("connection closed before its hello reason=%s", reason)
        self._loop.unregister(self._socket.fileno())
        self._socket.close()

    def _handle(self, events: int) -> None:
        try:
            data = self._socket.recv(HELLO_MAX_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        hello = read_client_hello(data)
        if data and hello.needed_bytes and not events & _OVER:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, hello.needed_bytes)  # wake up with all
            return
        self._loop.unregister(self._socket.fileno())
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)
        self._chosen(self, self._socket, ENROLMENT_ALPN.encode() in hello.protocols)


def hand_over(accepted: socket.socket, path: Path) -> None:
    """Give a connection to the enrolment server that listens at a path, and close it here.

    Raises:
        OSError: no enrolment server runs, or it is busy; the connection is closed.
    """
    with accepted, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array("i", [accepted.fileno()]))
        sender.sendmsg([b"c"], [rights], 0, str(path))  # ``socket.send_fds`` of Python 3.10 leaves the address out
