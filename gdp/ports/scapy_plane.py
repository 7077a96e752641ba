"""Data plane with Scapy: sniff, dissect, decide, build, send. It is the reference, for learning and for tests.

I/O; the only plane that imports Scapy, and imported only when chosen.
Source: docs/explanation/design.md, section 7.
It uses the same ``decide`` that the other planes are tested against. It leaves the bytes of a frame unchanged except
for addresses and hops left, because Scapy rebuilds only changed layers.
"""

from __future__ import annotations

import socket
from collections.abc import Collection, Sequence
from functools import partial
from typing import Final

from scapy.arch.linux import L2Socket
from scapy.error import Scapy_Exception
from scapy.layers.l2 import Ether
from scapy.packet import Packet
from scapy.sendrecv import sendp, sniff
from scapy.utils import str2mac

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import ETHER_BYTES, ETHERTYPE
from gdp.frame.layers import GDP
from gdp.ports.mmsg import send_failure
from gdp.ports.netdev import NetdevPlane
from gdp.ports.plane import MAC_BYTES, Port
from gdp.ports.readiness import readable
from gdp.ports.sockets import NO_RAW_SOCKETS, attach_ethertype_filter, kernel_drops, large_buffers
from gdp.sansio import ReceivedFrame
from gdp.switch.forwarder import Drop, Forward, decide
from gdp.switch.table import Table

_BURST: Final = 64  # frames of one port before the next port is read


class ScapyPlane(NetdevPlane):
    """``Plane`` over one Scapy socket per port. Raises ``LocalError``: as ``add_port``."""

    def __init__(self, ifnames: Sequence[str] = (), table: Table | None = None) -> None:
        self._sockets: dict[int, tuple[L2Socket, int]] = {}  # with the file descriptor, which is needed after a close
        super().__init__(ifnames, table)

    def _open(self, port: Port) -> None:
        try:
            opened = L2Socket(iface=port.ifname, type=ETHERTYPE, promisc=False)
        except PermissionError as error:
            raise LocalError(NO_RAW_SOCKETS) from error
        except (OSError, Scapy_Exception) as error:
            raise LocalError(f"port {port.ifname}: {error}") from error
        attach_ethertype_filter(opened.ins)
        large_buffers(opened.ins)
        self._sockets[port.index] = opened, opened.fileno()
        self.watch(opened, partial(self._sniff, port.index))

    def _widen(self, port: Port) -> None:
        """Do nothing: Scapy's sockets take frames of any size."""

    def _shut(self, port: Port) -> None:
        opened, fd = self._sockets.pop(port.index, (None, -1))
        if opened is None:
            return
        if opened.closed:  # closed by Scapy after an error; the kernel has released the descriptor
            self._ready.pop(fd, None)
        else:
            self.unwatch(opened)
            opened.close()

    def _is_open(self, index: int) -> bool:
        return index in self._sockets

    def _kernel_drops(self) -> int:
        return sum(kernel_drops(opened.ins) for opened, _ in self._sockets.values() if not opened.closed)

    def transmit(self, port: int, destination_mac: bytes, frames: Sequence[bytes]) -> int:
        """Send frames to one neighbour, one by one; return how many were sent, as ``Plane.transmit``."""
        drops, facts, left = self._counters.drops, self._ports.get(port), 0
        if facts is None or not facts.up:
            drops[DropReason.PORT_DOWN] += len(frames)
            return 0
        for frame in frames:
            if len(frame) > facts.mtu:
                drops[DropReason.TOO_BIG] += 1
            else:
                ether = Ether(dst=str2mac(destination_mac), src=str2mac(facts.mac), type=ETHERTYPE)
                left += self._send(port, ether / GDP(frame))
        return left

    def set_neighbours(self, port: int, macs: Collection[bytes]) -> None:
        """Do nothing: one socket per port receives frames in order of arrival."""

    def _sniff(self, index: int) -> None:
        """Read a burst from one port that is ready; return when it is empty."""
        opened, _ = self._sockets[index]
        if opened.ins.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            return  # the device went down: the read cleared the error, and the link monitor reports it
        sniff(
            opened_socket=opened,
            prn=partial(self._consider, index),
            store=False,
            count=_BURST,
            stop_filter=lambda _: not readable([opened], 0),
            chainCC=True,
        )
        if opened.closed:  # Scapy closed it because of an error
            self._shut(self._ports[index])
            self._know(self._reopen_if_needed(self._ports[index], self._ports[index]))

    def _consider(self, index: int, packet: Packet) -> None:
        """Decide on one frame, and act on the decision."""
        counters, frame = self._counters, bytes(packet)
        counters.frames_in += 1
        self._came[index] += 1
        if self._entries is None:
            self._punt(index, frame)
            return
        decision = decide(frame, self._entries, self._mtus, self._sides, index, self._paces)
        if isinstance(decision, Drop):
            counters.drops[decision.reason] += 1
        elif isinstance(decision, Forward):
            for reason in decision.lost:
                counters.drops[reason] += 1
            packet[GDP].hops_left -= 1
            for port, macs in decision.hops:
                packet[Ether].dst, packet[Ether].src = str2mac(macs[:MAC_BYTES]), str2mac(macs[MAC_BYTES:])
                counters.forwarded += self._send(port, packet)
        else:
            self._punt(index, frame)

    def _punt(self, index: int, frame: bytes) -> None:
        self._keep([ReceivedFrame(index, frame[MAC_BYTES : 2 * MAC_BYTES], frame[ETHER_BYTES:])])

    def _send(self, port: int, packet: Packet) -> int:
        """Send one packet; return 1, or 0 when it is lost and counted."""
        try:
            sendp(packet, socket=self._sockets[port][0], verbose=False)
        except OSError as error:
            self._counters.drops[send_failure(error.errno or 0)[0]] += 1
            return 0
        self._counters.frames_out += 1
        return 1
