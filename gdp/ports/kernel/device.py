"""Checks of a port's device: whether redirected frames may bypass its egress path, and how many frames it refused.

I/O. ``bpf_redirect_peer`` bypasses everything between the egress of the device and the other end of its pair. It is
correct only if nothing is attached there:

- The device is one end of a veth pair whose other end is in another namespace; otherwise the kernel drops the frame.
- The device has no queue, and no programs or filters at its egress.
- The other end has no XDP program in its driver. A generic one runs all the same, and so does everything after it.

Source: Linux, net/core/filter.c, ``skb_do_redirect``; if_link.h, ``rtnl_link_stats64``; gen_stats.h.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Iterable
from typing import Final

from gdp.ports.kernel.syscall import BpfError, attached
from gdp.ports.netlink import CLSACT_EGRESS, ROOT, LinkAttribute, NetlinkSocket, nested

_INFO_KIND: Final = 1  # IFLA_INFO_KIND
_TCX_EGRESS: Final = 47
_XDP_ATTACHED: Final = 2  # IFLA_XDP_ATTACHED
_PASSED_BY_NO_PEER: Final = (0, 2)  # XDP_ATTACHED_NONE, XDP_ATTACHED_SKB
_NUMBER: Final = struct.Struct("=i")
_STATS2, _STATS_QUEUE = 7, 3  # TCA_STATS2, TCA_STATS_QUEUE
_QUEUE_DROPS_AT: Final = 8
_TX_DROPPED_AT: Final = 7 * 8


def peer_is_bare(ask: NetlinkSocket, ifindex: int) -> bool:
    """Return whether nothing is attached between this device and the other end of its pair, in another namespace.

    Raises:
        LocalError: the kernel refused a query; a query about the other end takes CAP_NET_ADMIN there.
    """
    facts = ask.link(ifindex)
    kind = nested(facts.get(LinkAttribute.LINKINFO, b"")).get(_INFO_KIND, b"")
    return (
        kind.rstrip(b"\0") == b"veth"
        and LinkAttribute.LINK_NETNSID in facts
        and facts.get(LinkAttribute.QDISC, b"").rstrip(b"\0") == b"noqueue"
        and not _has_programs(ifindex)
        and not ask.filters(ifindex, CLSACT_EGRESS)
        and not _has_driver_xdp(ask, facts)
    )


def _has_programs(ifindex: int) -> bool:
    try:
        return bool(attached(ifindex, _TCX_EGRESS))
    except BpfError as error:
        if error.number == errno.EINVAL:  # before Linux 6.6 there are no links
            return False
        raise


def _has_driver_xdp(ask: NetlinkSocket, facts: dict[int, bytes]) -> bool:
    """Return whether the other end has XDP in its driver; True if it cannot be found."""
    if LinkAttribute.LINK not in facts:
        return True
    there, namespace = (_NUMBER.unpack(facts[each])[0] for each in (LinkAttribute.LINK, LinkAttribute.LINK_NETNSID))
    peer = ask.link(there, namespace)
    modes = nested(peer.get(LinkAttribute.XDP, b"")).get(_XDP_ATTACHED, b"\0")
    return not peer or modes[0] not in _PASSED_BY_NO_PEER


class TxDrops:
    """Frames that devices and their queues refused to send; the kernel does not report them to a redirecting program.

    A device counts all senders: if others use it too, their frames are included.

    Attributes:
        total: frames refused since the first query of each device.
    """

    def __init__(self) -> None:
        self._last: dict[int, int] = {}  # by ifindex
        self.total = 0

    def poll(self, ask: NetlinkSocket, ifindexes: Iterable[int]) -> None:
        """Query these devices, and forget the others. Costs a dump of all queues: 4 ms with 32 ports.

        Raises:
            LocalError: the kernel refused a query; the known counts stay.
        """
        asked = {ifindex: ask.link(ifindex) for ifindex in ifindexes}
        now = {ifindex: _dropped(facts) for ifindex, facts in asked.items() if facts}
        for ifindex, parent, facts in ask.queues() if now else ():
            if ifindex in now and parent == ROOT:
                now[ifindex] += _queue_drops(facts)
        self.total += sum(max(count - self._last.get(ifindex, count), 0) for ifindex, count in now.items())
        self._last = now


def _dropped(facts: dict[int, bytes]) -> int:
    stats = facts.get(LinkAttribute.STATS64, b"")
    return int(struct.unpack_from("=Q", stats, _TX_DROPPED_AT)[0]) if stats else 0


def _queue_drops(facts: dict[int, bytes]) -> int:
    queue = nested(facts.get(_STATS2, b"")).get(_STATS_QUEUE, b"")
    return int(struct.unpack_from("=I", queue, _QUEUE_DROPS_AT)[0]) if queue else 0
