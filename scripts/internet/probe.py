"""UDP probes of a laboratory: which endpoint a host has in the eyes of another.

I/O. All sockets belong to this process, each in the namespace of its host, so no datagram of a signalling channel
crosses the laboratory. Source: RFC 4787 and RFC 5128, section 3.
"""

from __future__ import annotations

import secrets
import select
import socket
import time
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.ports.sockets import large_buffers
from internet.host import Host

_PATIENCE_S: Final = 5.0
SILENCE_S: Final = 0.3  # after which a datagram that is expected to be lost counts as lost
_TOKEN_BYTES: Final = 8
_DATAGRAM_BYTES: Final = 2_048


class UdpProbe:
    """A UDP socket on a host; a context manager that closes it.

    Args:
        version: of IP, 4 or 6.
        port: 0: any.
        device: the only one to send and receive by (SO_BINDTODEVICE); by default routing decides.

    Attributes:
        local: address of the host's device, and the port.
        sources: source of each datagram that came in, by its content.
    """

    def __init__(self, host: Host, version: int = 4, port: int = 0, *, device: str = "") -> None:
        family = socket.AF_INET if version == 4 else socket.AF_INET6
        self._socket = host.space.inside(lambda: socket.socket(family, socket.SOCK_DGRAM))
        self._socket.setblocking(False)
        large_buffers(self._socket)
        self._socket.bind(("", port))
        if device:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())
        lease = host.lease(device or host.devices[0])
        address = (lease.address if version == 4 else lease.address6).partition("/")[0]
        self.local = Endpoint(address, self._socket.getsockname()[1])
        self.sources: dict[bytes, Endpoint] = {}

    def __enter__(self) -> UdpProbe:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def fileno(self) -> int:
        """Return the descriptor of the socket."""
        return self._socket.fileno()

    def send(self, to: Endpoint, content: bytes) -> bool:
        """Send a datagram; return whether the host has a route."""
        try:
            self._socket.sendto(content, to)
        except OSError:  # unreachable, or an ICMP error of an earlier datagram
            return False
        return True

    def receive(self) -> None:
        """Take the datagrams that wait into ``sources``."""
        while True:
            try:
                content, source = self._socket.recvfrom(_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except OSError:  # an ICMP error, cleared by this call
                continue
            self.sources[content] = Endpoint(source[0], source[1])

    def wait(self, content: bytes, timeout_s: float = SILENCE_S) -> Endpoint | None:
        """Return the source of a datagram with this content; None: none comes in time."""
        deadline_s = time.monotonic() + timeout_s
        while content not in self.sources:
            if not select.select([self], (), (), max(deadline_s - time.monotonic(), 0.0))[0]:
                return None
            self.receive()
        return self.sources[content]


def observe(
    sender: UdpProbe, receiver: UdpProbe, to: Endpoint | None = None, *, timeout_s: float = _PATIENCE_S
) -> Endpoint | None:
    """Send a datagram and return the source that the receiver sees; None: it does not arrive in time.

    ``to``: destination; by default the receiver's own address.
    """
    token = secrets.token_bytes(_TOKEN_BYTES)
    sender.send(to or receiver.local, token)
    return receiver.wait(token, timeout_s)
