"""One relay connection on a TCP socket, and the TAP device that it serves.

I/O. Source: tcp(7) for ``TCP_USER_TIMEOUT`` and ``TCP_NOTSENT_LOWAT``; ``linux/sockios.h`` for ``SIOCOUTQNSD``. The
kernel gets little more than the network takes, so that waiting frames stay in the queue that knows urgent ones.
"""

from __future__ import annotations

import fcntl
import logging
import math
import select
import socket
import struct
import time
from collections.abc import Callable
from typing import Final

from gdp.intervals import LINGER_S
from gdp.links.relay_loop import RelayLoop
from gdp.ports.tap import TapDevice
from gdp.relay.connection import ConnectionCounters, ConnectionState, RelayConnection
from gdp.runtime.runtime import now

log = logging.getLogger(__name__)

_SIOCOUTQNSD: Final = 0x894B
_INT: Final = struct.Struct("=i")
_UNSENT_BYTES: Final = 128 << 10
_BATCHES: Final = 4  # of ``data_to_send`` before other connections have their turn
_FRAMES: Final = 64  # of the device before other connections have their turn
_WRITE: Final = select.EPOLLOUT
_READ: Final = select.EPOLLIN
_BROKEN: Final = select.EPOLLERR | select.EPOLLHUP


def prepare_socket(opened: socket.socket, dead_ms: int) -> None:
    """Make a TCP socket non-blocking, with few unsent bytes in the kernel, and dead ``dead_ms`` after the path is."""
    opened.setblocking(False)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, dead_ms)


class RelayPort:
    """A TAP device in the loop, and the connection that serves it at present.

    Attributes:
        ended: counters of former connections of this device.
    """

    def __init__(self, loop: RelayLoop, device: TapDevice) -> None:
        self._loop = loop
        self.device = device
        self.link: RelayLink | None = None
        self.ended = ConnectionCounters()
        self.is_removed = False  # by another program
        loop.register(device.fileno(), _READ, self._handle)

    def attach(self, link: RelayLink) -> None:
        """Pass frames to and from this open connection; the device then has a carrier.

        Raises:
            LocalError: the system refuses the MTU or the carrier.
        """
        self.device.set_mtu(link.connection.mtu)
        self.link = link
        self.device.set_carrier(on=True)

    def detach(self, link: RelayLink) -> None:
        """End the service of this connection; the carrier goes off."""
        if self.link is link:
            self.link = None
            self.ended.add(link.connection.counters)
            if not self.is_removed:
                self.device.set_carrier(on=False)

    def close(self) -> None:
        """Remove the device."""
        if not self.is_removed:
            self._loop.unregister(self.device.fileno())
        self.device.close()

    def _handle(self, events: int) -> None:
        if events & _BROKEN:
            self.is_removed = True
            self._loop.unregister(self.device.fileno())
            log.error("TAP device removed by another program ifname=%s", self.device.ifname)
            if self.link is not None:
                self.link.end(f"the device {self.device.ifname} was removed")
            return
        read, link = self.device.read, self.link
        try:
            for _ in range(_FRAMES):
                frame = read()
                if link is not None:
                    link.connection.queue_frame(frame)
        except OSError:  # there are no more frames
            pass
        if link is not None:
            link.flush()


class RelayLink:
    """A connection on its socket.

    Args:
        opened: called when the connection is open; returns its device, or None if there can be none.
        closed: called once, when the connection has ended.
    """

    def __init__(
        self,
        *,
        loop: RelayLoop,
        connected: socket.socket,
        connection: RelayConnection,
        opened: Callable[[RelayLink], RelayPort | None],
        closed: Callable[[RelayLink], None],
    ) -> None:
        self._loop = loop
        self._socket = connected
        self._opened = opened
        self._closed = closed
        self._pending = memoryview(b"")
        self._events = _READ
        self._paused_until_s: float | None = None
        self._linger_until_s: float | None = None
        self._unsent = bytearray(_INT.size)
        self.connection = connection
        self.port: RelayPort | None = None
        self.since_s = time.monotonic()
        self.is_ended = False
        self.remote = _address(connected.getpeername())
        self.local = _address(connected.getsockname())
        loop.register(connected.fileno(), _READ, self._handle)
        loop.add_timed(self)  # the first call sends what is ready

    def handle_timer(self, now_s: float) -> float:
        """Do what is due at a monotonic second; return the second of the next call."""
        if self.is_ended:
            until_s = self._linger_until_s
            if until_s is not None and now_s >= until_s:
                self._release_socket()
            return math.inf if until_s is None else until_s
        if self._paused_until_s is not None and now_s >= self._paused_until_s:
            self._paused_until_s = None
            self._wait_for(self._events | _READ)
        self.connection.handle_timer(now_s)
        self.flush()
        return now_s + LINGER_S if self.is_ended else self._next_s(now_s)

    def flush(self) -> None:
        """Send what is ready, as far as the network takes it; end a connection that has closed."""
        if self.is_ended:
            return
        try:
            self._send()
        except OSError as error:
            self.connection.close(f"connection lost: {error.strerror or error}")
        if self.connection.state is ConnectionState.CLOSED:
            self._end()

    def end(self, reason: str, *, is_refusal: bool = False) -> None:
        """Close the connection; a refusal reaches the other end."""
        if is_refusal:
            self.connection.refuse(reason)
        else:
            self.connection.close(reason)
        self.flush()

    def _handle(self, events: int) -> None:
        if self._linger_until_s is not None:
            self._discard()
            return
        if events & (_READ | _BROKEN):
            self._read()
        self.flush()

    def _read(self) -> None:
        connection = self.connection
        try:
            data = self._socket.recv(connection.receive_size)
        except BlockingIOError:
            return
        except OSError as error:
            connection.close(f"connection lost: {error.strerror or error}")
            return
        moment = now()
        frames = connection.receive_bytes(data, moment)
        if self.port is None and connection.state is ConnectionState.OPEN:
            self.port = self._opened(self)
        if self.port is not None:  # a connection that has just opened may owe what an earlier one of its client sent
            write = self.port.device.write
            for frame in frames:
                if not write(frame):
                    connection.counters.refused += 1
            resume_s = connection.pause_until_s(moment.mono_s)
            if resume_s > moment.mono_s:
                self._paused_until_s = resume_s
                self._loop.wake_at(resume_s)
                self._wait_for(self._events & ~_READ)

    def _send(self) -> None:
        for _ in range(_BATCHES):
            if not self._pending:
                fcntl.ioctl(self._socket, _SIOCOUTQNSD, self._unsent)
                if _INT.unpack(self._unsent)[0] >= _UNSENT_BYTES:
                    break
                now_s = time.monotonic()
                self._pending = memoryview(self.connection.data_to_send(now_s))
                if not self._pending:
                    self._wait_for(self._events & ~_WRITE)
                    if self.connection.queued_bytes:  # the rate allows no more at present
                        self._loop.wake_at(self._next_s(now_s))
                    return
            try:
                sent = self._socket.send(self._pending)
            except BlockingIOError:
                break
            self._pending = self._pending[sent:]
        self._wait_for(self._events | _WRITE)

    def _next_s(self, now_s: float) -> float:
        next_s = self.connection.get_timer(now_s)
        return next_s if self._paused_until_s is None else min(next_s, self._paused_until_s)

    def _wait_for(self, events: int) -> None:
        if events != self._events:
            self._events = events
            self._loop.modify(self._socket.fileno(), events)

    def _end(self) -> None:
        """Report the end; a refused end gets time to read why."""
        self.is_ended = True
        if self.port is not None:
            self.port.detach(self)
        if self.connection.was_refused and not self._pending:
            self._linger_until_s = time.monotonic() + LINGER_S
            self._wait_for(_READ)
            try:
                self._socket.shutdown(socket.SHUT_WR)
            except OSError:
                self._release_socket()
        else:
            self._release_socket()
        self._closed(self)

    def _discard(self) -> None:
        """Read what a refused end still sends: bytes that stay unread would reset the connection under the reason."""
        try:
            if self._socket.recv(1 << 16):
                return
        except BlockingIOError:
            return
        except OSError as error:
            log.debug("refused end gone reason=%s", error.strerror)
        self._release_socket()

    def _release_socket(self) -> None:
        self._linger_until_s = None
        self._loop.remove_timed(self)
        self._loop.unregister(self._socket.fileno())
        self._socket.close()


def _address(name: object) -> str:
    """Return the numeric address of a socket name, IPv4 in its own form."""
    host = name[0] if isinstance(name, tuple) else ""
    return str(host).removeprefix("::ffff:")
