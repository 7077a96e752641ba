"""Kernel data plane: a program in the kernel decides, and punts the frames that it is unsure of to the raw plane.

I/O. The raw plane below uses the same table, so a frame or entry that the kernel cannot take is not lost.
Source: docs/explanation/design.md, section 7.
A frame that the kernel takes wakes no process. A frame that the kernel punts costs as much as in the raw plane::

    device -> program -> redirected | dropped and counted
                 `-> up: packet socket -> decide() -> sent | dropped and counted | punted
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Final

from gdp.errors import DropReason, LocalError
from gdp.intervals import RETRY_S, UPKEEP_S, SoftState
from gdp.ports.kernel.abi import ENTRIES_DEFAULT, PortFlag
from gdp.ports.kernel.attach import Attachment, FilterAttachment, LinkAttachment, has_links
from gdp.ports.kernel.device import TxDrops, peer_is_bare
from gdp.ports.kernel.keepalive_plane import KeepalivePlane
from gdp.ports.kernel.keepalives import open_sessions
from gdp.ports.kernel.loaded_program import LoadedProgram
from gdp.ports.kernel.map_sync import EntryCounts, MapSync
from gdp.ports.netlink import TRAFFIC_GROUP, NetlinkSocket, Notifications
from gdp.ports.plane import Counters, Port
from gdp.sansio import ReceivedFrame
from gdp.switch.table import Table

_COUNTED_MAX: Final = 100
_FILTER: Final = SoftState(1.0, periods=3)  # the filter of a process that died forwards no longer than this


class KernelPlane(KeepalivePlane):
    """``Plane`` with a program on the ingress of every port.

    Args:
        entries_max: most entries that the kernel holds; Python forwards by the others.
        peer: redirect to the other end of a veth pair where that is correct.
        clsact: attach by filters even if the kernel has links.

    Raises:
        LocalError: as ``add_port``; or the kernel refuses the program, with the reason.
    """

    def __init__(
        self,
        ifnames: Sequence[str] = (),
        table: Table | None = None,
        *,
        entries_max: int = ENTRIES_DEFAULT,
        peer: bool = True,
        clsact: bool = False,
    ) -> None:
        self._peer = peer
        self._attachments: dict[int, Attachment] = {}
        self._table = table
        self._next_upkeep_s = self._next_look_s = 0.0
        self._forwarded = 0  # frames at the last look at the devices
        self._refusals = TxDrops()
        self._unread = 0  # punted frames that the kernel dropped at a full socket
        with ExitStack() as opened:
            self._loaded = opened.enter_context(closing(LoadedProgram(entries_max, leased=clsact or not has_links())))
            self._questions = opened.enter_context(closing(NetlinkSocket()))
            self._queues = opened.enter_context(closing(Notifications(TRAFFIC_GROUP)))
            self._mirror = MapSync(table, *self._loaded.of_entries)
            sessions = None if self._loaded.is_leased else open_sessions()
            super().__init__(ifnames, table, sessions=sessions)
            opened.pop_all()  # from now on ``close`` closes them
        self.watch(self._queues, self._review_queues)
        if table is not None:
            table.observe(self._mirror)
        self._keep_up()

    @property
    def counters(self) -> Counters:
        """The present counts of the kernel and of this process together.

        A device does not report that it refused a redirected frame. Such a frame counts as forwarded, and as
        ``PORT_FULL`` after the next query of the devices. ``poll`` makes it each second while frames are forwarded.
        """
        here, there = self._counters, self._loaded.counters()
        drops = [a + b for a, b in zip(here.drops, there.drops, strict=True)]
        counted = drops[DropReason.PORT_FULL] - self._unread
        drops[DropReason.PORT_FULL] += max(self._refusals.total - counted, 0)
        return Counters(
            here.frames_in + there.frames_in,
            here.frames_out + there.frames_out,
            here.forwarded + there.forwarded,
            here.punted,
            drops,
        )

    def frames_from(self, port: int) -> int:
        """Return how many frames have come from a port, as ``Plane.frames_from``.

        Of a port above the 63rd only the punted ones are counted.
        """
        return super().frames_from(port) + self._loaded.frames_from(port)

    @property
    def left_out(self) -> int:
        """Number of the table's entries that Python alone forwards by."""
        return self._mirror.left_out

    def entry_counts(self, most: int = _COUNTED_MAX) -> EntryCounts:
        """Return frames and bytes that the kernel forwarded by the busiest entries. Safe in any thread."""
        return self._mirror.counts(most)

    def poll(self, timeout_s: float | None) -> Sequence[ReceivedFrame]:
        """Renew the lease of the program and read its counts when due; then as ``Plane.poll``."""
        if self._loaded.is_leased:
            timeout_s = _FILTER.refresh_s if timeout_s is None else min(timeout_s, _FILTER.refresh_s)
        if time.monotonic() >= self._next_upkeep_s:
            self._keep_up()
        return super().poll(timeout_s)

    def close(self) -> None:
        """Detach the programs and close every socket and map."""
        if self._table is not None:
            self._table.observe(None)
        super().close()
        self._queues.close()
        self._questions.close()
        self._loaded.close()

    def remove_port(self, index: int) -> None:
        """Detach the program from a port and close it, as ``Plane.remove_port``."""
        self._look_at_devices()  # while the drop count of the port's device can still be read
        super().remove_port(index)

    # ports

    def _open(self, port: Port) -> None:
        super()._open(port)
        try:
            ifindex = _ifindex(port.ifname)
            attach = FilterAttachment if self._loaded.is_leased else LinkAttachment
            self._attachments[port.index] = attach(self._loaded.program_of(port.index), ifindex, self._questions)
        except LocalError as error:
            self._shut(port)
            raise LocalError(f"port {port.ifname}: {error}") from error

    def _shut(self, port: Port) -> None:
        self._loaded.set_port(port.index, 0, 0, 0)
        attachment = self._attachments.pop(port.index, None)
        if isinstance(attachment, LinkAttachment):
            self._closing.close(port.ifname, [attachment.close])
        elif attachment is not None:
            attachment.close()
        super()._shut(port)

    def _know(self, port: Port) -> None:
        self._tell_kernel(port)
        self._look_at_devices()  # drops are counted from now on
        super()._know(port)

    def _kernel_drops(self) -> int:
        unread = super()._kernel_drops()
        self._unread += unread
        return unread

    def _tell_kernel(self, port: Port) -> None:
        ifindex = next((ifindex for ifindex, index in self._devices.items() if index == port.index), 0)
        if port.up and ifindex:
            flags = PortFlag.PEER if self._peer and self._has_free_peer(ifindex) else 0
            self._loaded.set_port(port.index, ifindex, port.mtu, flags)
        else:
            self._loaded.set_port(port.index, 0, 0, 0)

    def _has_free_peer(self, ifindex: int) -> bool:
        try:
            return peer_is_bare(self._questions, ifindex)
        except LocalError:  # unknown: redirect is always correct; the next upkeep queries again
            return False

    def _look_at_devices(self) -> None:
        try:
            self._refusals.poll(self._questions, self._devices)
        except LocalError:  # nothing is lost: devices continue to count, and the next upkeep queries again
            return

    def _review_queues(self) -> None:
        """Check again on which ports redirected frames may bypass the egress path."""
        self._queues.has_news()
        for port in self._ports.values():
            self._tell_kernel(port)

    def _keep_up(self) -> None:
        """Do what no notification triggers: renew the lease, check each port's egress, and read refusals."""
        self._loaded.renew(_FILTER.lease_s)
        now_s, forwarded = time.monotonic(), self._loaded.counters().forwarded
        self._next_upkeep_s = now_s + (_FILTER.refresh_s / 2 if self._loaded.is_leased else UPKEEP_S)
        if forwarded == self._forwarded and now_s < self._next_look_s:
            return  # no device had to send
        self._forwarded, self._next_look_s = forwarded, now_s + RETRY_S
        self._review_queues()
        self._look_at_devices()


def _ifindex(ifname: str) -> int:
    try:
        return socket.if_nametoindex(ifname)
    except OSError as error:
        raise LocalError("no such device") from error
