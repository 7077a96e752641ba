"""Base of the planes over network devices: ports that follow their devices, one epoll, the counters.

I/O. A subclass defines how a frame is read, decided on and sent.
A port outlives its device. The port goes down when the device is deleted or moved away. When a device of that name
appears, the port reopens it. The kernel's link messages (netlink) decide, so a port detects a cut link within
milliseconds. If a device cannot be opened (another process may still use it), the port retries until it can.

States of a port::

    add_port -> open, up or down <-> up or down (carrier) -> absent (device deleted) -> open (device of that name) ...
       `-----> absent, where it may be
"""

from __future__ import annotations

import logging
import select
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Final

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import ETHER_BYTES
from gdp.intervals import PACE_S, TICK_S
from gdp.limits import FRAME_MAX_BYTES, MTU_MIN_BYTES
from gdp.ports.plane import MAC_BYTES, Counters, HasFileno, Keepalives, LinkCallback, Port
from gdp.ports.rtnetlink import Link, LinkMonitor
from gdp.sansio import ReceivedFrame
from gdp.switch.table import Hops, Paces, Table

log = logging.getLogger(__name__)

_MTU_MAX_BYTES: Final = FRAME_MAX_BYTES - ETHER_BYTES
_AUDIT_POLLS: Final = 256  # a busy plane reads the kernel's drops every so many polls
_AUDIT_FRAMES: Final = 16  # ... an idle one after so many frames, and each ``TICK_S``: a question for each socket


class NoDeviceError(LocalError):
    """There is no device of that name."""


class NetdevPlane(ABC):
    """Base of the planes whose ports are Linux devices.

    Args:
        ifnames: devices to open at once.
        table: entries to forward by; None punts every frame.

    Raises:
        LocalError: as ``add_port``.
    """

    def __init__(self, ifnames: Sequence[str] = (), table: Table | None = None) -> None:
        self._entries: Mapping[bytes, Hops] | None = None if table is None else table.entries
        self._sides: Mapping[bytes, int] = {} if table is None else table.sides
        self._paces: Mapping[bytes, Paces] = {} if table is None else table.paces
        self._ports: dict[int, Port] = {}
        self._mtus: dict[int, int] = {}  # of the ports that are up
        self._devices: dict[int, int] = {}  # ifindex of an open device -> port index
        self._unopened: dict[int, str] = {}  # port index to why its device cannot be opened
        self._open_again_s = 0.0
        self._counters = Counters()
        self._came: Counter[int] = Counter()  # frames, by port
        self._polls = 0
        self._audited_at = 0  # frames that had come by the last audit
        self._audit_s = 0.0
        self._next_index = 0
        self._epoll = select.epoll()
        self._ready: dict[int, Callable[[], None]] = {}
        self._ranks: dict[int, int] = {}  # the lowest are served first
        self._arrivals: Sequence[ReceivedFrame] = []
        self._on_link: list[LinkCallback] = []
        self._links = LinkMonitor()
        self.watch(self._links, self._hear)
        try:
            for ifname in ifnames:
                self.add_port(ifname)
        except LocalError:
            self.close()
            raise

    # implemented by a plane

    @abstractmethod
    def _open(self, port: Port) -> None:
        """Open the port's device and watch it; a device that cannot be opened raises ``LocalError``."""

    @abstractmethod
    def _shut(self, port: Port) -> None:
        """Close everything that ``_open`` opened; nothing may be open."""

    @abstractmethod
    def _is_open(self, index: int) -> bool: ...

    def _widen(self, port: Port) -> None:
        """Prepare an open device for larger frames; reopening it loses the frames that wait at its socket."""
        self._close_device(port)
        self._open(port)

    @abstractmethod
    def _kernel_drops(self) -> int:
        """Return the frames that the kernel dropped at open ports since the last call."""

    @abstractmethod
    def transmit(self, port: int, destination_mac: bytes, frames: Sequence[bytes]) -> int:
        """Send frames to one neighbour; return how many were sent, as ``Plane.transmit``."""

    # the Plane protocol

    @property
    def ports(self) -> Mapping[int, Port]:
        """Return the ports by index, up or not."""
        return self._ports

    @property
    def counters(self) -> Counters:
        """Return the live counts, as ``Plane.counters``."""
        return self._counters

    @property
    def keepalives(self) -> Keepalives | None:
        """Return None: the node runs its keepalive sessions itself."""
        return None

    def poll(self, timeout_s: float | None) -> Sequence[ReceivedFrame]:
        """Wait for events and serve them, the lowest rank first; return the punted frames, as ``Plane.poll``."""
        if self._unopened:
            timeout_s = self._open_again(timeout_s)
        events = self._wait(timeout_s)
        self._polls += 1
        has_come = self._counters.frames_in >= self._audited_at + _AUDIT_FRAMES
        is_due = not events and (has_come or (timeout_s != 0 and time.monotonic() >= self._audit_s))
        if is_due or not self._polls % _AUDIT_POLLS:
            self._audit()
        if len(events) > 1:
            events.sort(key=lambda event: self._ranks[event[0]])
        for fd, _ in events:
            ready = self._ready.get(fd)
            if ready is not None:  # an earlier callback of this round may have closed it
                ready()
        arrivals, self._arrivals = self._arrivals, []
        self._counters.punted += len(arrivals)
        return arrivals

    def _wait(self, timeout_s: float | None) -> list[tuple[int, int]]:
        """Wait for events; return each as a descriptor and its flags."""
        return self._epoll.poll(timeout_s)

    def _keep(self, arrivals: Sequence[ReceivedFrame]) -> None:
        """Let the next ``poll`` return these frames; those of one system call alone stay as they are."""
        self._arrivals = [*self._arrivals, *arrivals] if self._arrivals else arrivals

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll`` has work, for another event loop."""
        return self._epoll.fileno()

    def watch(self, source: HasFileno, ready: Callable[[], None], *, rank: int = 0) -> None:
        """Call ``ready`` from within ``poll`` whenever ``source`` is readable; a lower ``rank`` comes first."""
        fd = source.fileno()
        self._epoll.register(fd, select.EPOLLIN)
        self._ready[fd] = ready
        self._ranks[fd] = rank

    def unwatch(self, source: HasFileno) -> None:
        """Undo ``watch``; does nothing if the source is not watched."""
        fd = source.fileno()
        if self._ready.pop(fd, None) is not None:
            del self._ranks[fd]
            self._epoll.unregister(fd)

    def add_port(self, ifname: str, *, may_be_absent: bool = False) -> int:
        """Open a device and return its port index; a device that may be absent is opened when it appears.

        Raises:
            NoDeviceError: the device does not exist.
            LocalError: as ``Plane.add_port``.
        """
        if any(port.ifname == ifname for port in self._ports.values()):
            raise LocalError(f"port {ifname}: given twice")
        link = self._links.get(ifname)
        if link is None and may_be_absent:
            self._know(Port(self._next_index, ifname, bytes(MAC_BYTES), MTU_MIN_BYTES, up=False))
            self._next_index += 1
            return self._next_index - 1
        if link is None:
            raise NoDeviceError(f"port {ifname}: no such device")
        if link.mtu < MTU_MIN_BYTES:
            raise LocalError(f"port {ifname}: MTU {link.mtu} is below {MTU_MIN_BYTES}")
        if len(link.mac) != MAC_BYTES:
            raise LocalError(f"port {ifname}: not an Ethernet device")
        port = Port(self._next_index, ifname, link.mac, min(link.mtu, _MTU_MAX_BYTES), link.up)
        self._open(port)
        self._next_index += 1
        self._devices[link.ifindex] = port.index
        self._know(port)
        return port.index

    def remove_port(self, index: int) -> None:
        """Close a port; does nothing if no port has this index."""
        port = self._ports.pop(index, None)
        if port is not None:
            self._unopened.pop(index, None)
            self._close_device(port)
            self._mtus.pop(index, None)
            self._came.pop(index, None)
            self._devices = {ifindex: port for ifindex, port in self._devices.items() if port != index}

    def port_state(self, index: int) -> bool:
        """Return whether the port exists, is up and has a carrier."""
        return index in self._mtus

    def frames_from(self, port: int) -> int:
        """Return how many frames have come from a port, as ``Plane.frames_from``."""
        return self._came[port]

    def on_link(self, callback: LinkCallback) -> None:
        """Call ``callback(port, up)`` when a port goes up or down, as ``Plane.on_link``."""
        self._on_link.append(callback)

    @abstractmethod
    def set_neighbours(self, port: int, macs: Collection[bytes]) -> None:
        """Store the addresses of a port's neighbours, as ``Plane.set_neighbours``."""

    def close(self) -> None:
        """Close every port, the link monitor and the epoll."""
        for index in list(self._ports):
            self.remove_port(index)
        self._links.close()
        self._epoll.close()

    # links

    def _close_device(self, port: Port) -> None:
        """Close a device after adding the kernel's drops to the counters."""
        self._audit()
        self._shut(port)

    def _audit(self) -> None:
        """Add the kernel's own drops to the counters."""
        self._audited_at, self._audit_s = self._counters.frames_in, time.monotonic() + TICK_S
        self._counters.drops[DropReason.PORT_FULL] += self._kernel_drops()

    def _know(self, port: Port) -> None:
        """Store the state of a port, and report if it went up or down, or changed its address while up."""
        before = self._ports.get(port.index)
        self._ports[port.index] = port
        if port.up:
            self._mtus[port.index] = port.mtu
        else:
            self._mtus.pop(port.index, None)
        if before is None or before == port or not (before.up or port.up):
            return
        is_moved = before.up and port.up and before.mac != port.mac
        for up in (False, True) if is_moved else (port.up,):
            for callback in self._on_link:
                callback(port.index, up)

    def _hear(self) -> None:
        for link in self._links.poll():
            index = self._devices.get(link.ifindex)
            if index is None:
                index = next((port.index for port in self._ports.values() if port.ifname == link.ifname), None)
                if index is None or index in self._devices.values() or link.gone:
                    continue
            self._follow(self._ports[index], link)

    def _open_again(self, timeout_s: float | None) -> float:
        """Retry the devices that could not be opened, if it is time; return the longest wait in seconds."""
        now_s = time.monotonic()
        if now_s >= self._open_again_s:
            self._open_again_s = now_s + PACE_S
            for index in list(self._unopened):
                link = self._links.get(self._ports[index].ifname)
                if link is not None:
                    self._follow(self._ports[index], link)
        left_s = self._open_again_s - now_s
        return left_s if timeout_s is None else min(timeout_s, left_s)

    def _follow(self, port: Port, link: Link) -> None:
        """Synchronise a port with its device."""
        if link.gone:
            self._unopened.pop(port.index, None)
            self._close_device(port)
            del self._devices[link.ifindex]
        after = replace(port, up=False)
        if not link.gone and link.mtu >= MTU_MIN_BYTES and len(link.mac) == MAC_BYTES:
            self._devices[link.ifindex] = port.index
            after = replace(port, mac=link.mac, mtu=min(link.mtu, _MTU_MAX_BYTES), up=link.up)
            after = self._reopen_if_needed(port, after)
        self._know(after)

    def _reopen_if_needed(self, before: Port, after: Port) -> Port:
        """Open a new device, or prepare an open one for larger frames."""
        is_open = self._is_open(before.index)
        if is_open and after.mtu <= before.mtu:
            return after
        try:
            self._widen(after) if is_open else self._open(after)
        except LocalError as error:  # gone again, not ready, or in use by another process
            if before.index not in self._unopened:
                log.warning("%s; it is tried again", error)
            self._unopened[before.index] = str(error)
            return replace(after, up=False)
        if self._unopened.pop(before.index, None) is not None:
            log.info("port opened ifname=%s", after.ifname)
        return after
