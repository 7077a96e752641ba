"""UDP probes of a laboratory: which endpoint a host has in the eyes of another, and which pairs can open a direct path.

I/O. All sockets belong to this process, each in the namespace of its host, so no datagram of a signalling channel
crosses the laboratory. Source: RFC 4787 and RFC 5128, section 3.
"""

from __future__ import annotations

import secrets
import select
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.ports.sockets import large_buffers
from internet.host import Host

__all__ = ["SILENCE_S", "UdpProbe", "observe", "open_paths"]

_PATIENCE_S: Final = 5.0
SILENCE_S: Final = 0.3  # after which a datagram that is expected to be lost counts as lost
_QUIET_S: Final = 1.0  # ... and one that may come or not
_ROUNDS: Final = 3
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

    Args:
        to: destination; by default the receiver's own address.
    """
    token = secrets.token_bytes(_TOKEN_BYTES)
    sender.send(to or receiver.local, token)
    return receiver.wait(token, timeout_s)


class _Attempt:
    """Two sockets, one on each host of a pair, that try to reach each other."""

    def __init__(self, pair: int, version: int, probes: tuple[UdpProbe, UdpProbe]) -> None:
        self.pair, self.version, self.probes = pair, version, probes
        self.tokens = tuple(secrets.token_bytes(_TOKEN_BYTES) for _ in probes)
        self.observed: list[Endpoint | None] = [None, None]

    @property
    def is_observed(self) -> bool:
        """Whether a third host sees both sockets."""
        return None not in self.observed

    def send(self, number: int) -> None:
        """Send from both ends to where the other one was seen: by itself, else by the third host."""
        for own, other in ((0, 1), (1, 0)):
            seen = [
                source for content, source in self.probes[own].sources.items() if content[:-1] == self.tokens[other]
            ]
            for to in (self.observed[other], *seen[-1:]):
                if to is not None:
                    self.probes[own].send(to, self.tokens[own] + bytes([number]))

    def has_arrived(self, number: int) -> bool:
        """Return whether both ends received a datagram of this round."""
        return all(self.tokens[1 - own] + bytes([number]) in probe.sources for own, probe in enumerate(self.probes))


def open_paths(pairs: Sequence[tuple[Host, Host]], border: Host) -> list[bool]:
    """Return for each pair whether its hosts reach each other by UDP without the border, in both directions.

    Both ends learn from the border where it sees the other, and send there at once.
    """
    with ExitStack() as stack:
        reflectors = {version: stack.enter_context(UdpProbe(border, version)) for version in (4, 6)}
        attempts = [
            _Attempt(
                pair, version, (stack.enter_context(UdpProbe(a, version)), stack.enter_context(UdpProbe(b, version)))
            )
            for pair, (a, b) in enumerate(pairs)
            for version in (4, 6)
            if all(host.lease().has(version) for host in (a, b))
        ]
        _observe_all(attempts, reflectors)
        attempts = [each for each in attempts if each.is_observed]
        for number in range(_ROUNDS):
            for attempt in attempts:
                attempt.send(number)
            _fence(attempts, reflectors, number)
        direct = {each.pair for each in attempts if each.has_arrived(_ROUNDS - 1)}
    return [pair in direct for pair in range(len(pairs))]


def _observe_all(attempts: Sequence[_Attempt], reflectors: dict[int, UdpProbe]) -> None:
    for attempt in attempts:
        for probe, token in zip(attempt.probes, attempt.tokens, strict=True):
            probe.send(reflectors[attempt.version].local, token)
    while ready := select.select(list(reflectors.values()), (), (), _QUIET_S)[0]:
        for reflector in ready:
            reflector.receive()
    for attempt in attempts:
        attempt.observed = [reflectors[attempt.version].sources.get(token) for token in attempt.tokens]


def _fence(attempts: Sequence[_Attempt], reflectors: dict[int, UdpProbe], number: int) -> None:
    """Return when each socket has received what was sent to it before: the reflector's datagram comes after that."""
    fence = b"fence %d" % number
    waiting = []
    for attempt in attempts:
        for probe, to in zip(attempt.probes, attempt.observed, strict=True):
            if to is not None:
                reflectors[attempt.version].send(to, fence)
                waiting.append(probe)
    deadline_s = time.monotonic() + _PATIENCE_S
    while waiting := [probe for probe in waiting if fence not in probe.sources]:
        ready = select.select(waiting, (), (), max(deadline_s - time.monotonic(), 0.0))[0]
        if not ready:
            raise TimeoutError("a mapping towards the border was lost")
        for probe in ready:
            probe.receive()
