"""Routes of one uplink: marked packets leave by this device, whatever the main routing table prefers.

I/O. Source: rtnetlink(7), ip-rule(8); ``include/uapi/linux/fib_rules.h``. Policy routing needs a rule and a table for
each uplink. The table holds copies of the main table's routes through the uplink, and follows them::

    rule   fwmark MARK -> table MARK
    table  each route of the main table through the uplink; then: unreachable

So a tunnel over an uplink that is down stays down, and does not share the other one. The mark follows from the name of
the tunnel device; what a dead run of the same switch left has the same number, and is replaced.
"""

from __future__ import annotations

import errno
import hashlib
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from gdp.errors import LocalError
from gdp.ports.netlink import (
    LINK_GROUP,
    READ_BYTES,
    DeviceInfo,
    LinkAttribute,
    NetlinkSocket,
    RefusedError,
    attribute,
    listen,
    nested,
)

__all__ = ["ADDRESS_GROUPS", "ROUTE_GROUPS", "UplinkRoutes", "mark_of"]

ADDRESS_GROUPS: Final = 0x10 | 0x100  # RTMGRP_IPV4_IFADDR, RTMGRP_IPV6_IFADDR
ROUTE_GROUPS: Final = 0x40 | 0x400  # RTMGRP_IPV4_ROUTE, RTMGRP_IPV6_ROUTE
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)
_RTM_NEWROUTE, _RTM_DELROUTE, _RTM_GETROUTE = 24, 25, 26
_RTM_NEWRULE, _RTM_DELRULE = 32, 33
_CREATE, _EXCLUSIVE = 0x400, 0x200  # NLM_F_CREATE, NLM_F_EXCL
_ROUTE: Final = struct.Struct("=BBBBBBBBI")  # family, bits of destination and source, tos, table, protocol, scope, type
_RULE: Final = struct.Struct("=BBBBBBBBI")
_NUMBER: Final = struct.Struct("=I")
_RTA_DST, _RTA_OIF, _RTA_GATEWAY, _RTA_PRIORITY, _RTA_PREFSRC, _RTA_METRICS = 1, 4, 5, 6, 7, 8
_RTA_TABLE, _RTA_VIA = 15, 18
_COPIED: Final = (_RTA_DST, _RTA_OIF, _RTA_GATEWAY, _RTA_PRIORITY, _RTA_PREFSRC, _RTA_METRICS, _RTA_VIA)
_FRA_PRIORITY, _FRA_FWMARK, _FRA_TABLE = 6, 10, 15
_TO_TABLE: Final = 1  # FR_ACT_TO_TBL
_RULE_PRIORITY: Final = 9_000  # before the main table at 32,766
_TABLE_MAIN: Final = 254
_STATIC: Final = 4  # RTPROT_STATIC
_UNICAST, _UNREACHABLE = 1, 7
_ON_LINK: Final = 4  # RTNH_F_ONLINK
_METRIC_LAST: Final = 0xFFFFFFFF
_MARKS: Final = 0x67000000
_STRICT: Final = 1


class _Entry(NamedTuple):
    """A route without its table: comparable, and enough to make it."""

    family: int
    bits: int
    tos: int
    scope: int
    type: int
    flags: int
    attributes: tuple[tuple[int, bytes], ...]

    def message(self, table: int) -> bytes:
        """Return the body of a request about this route in a table."""
        head = _ROUTE.pack(self.family, self.bits, 0, self.tos, 0, _STATIC, self.scope, self.type, self.flags)
        body = b"".join(attribute(kind, value) for kind, value in self.attributes)
        return head + body + attribute(_RTA_TABLE, _NUMBER.pack(table))

    @property
    def has_gateway(self) -> bool:
        """Return whether the route needs another one, to its gateway."""
        return any(kind in (_RTA_GATEWAY, _RTA_VIA) for kind, _ in self.attributes)


def mark_of(ifname: str) -> int:
    """Return the mark, and the table, of the tunnel device with this name."""
    digest = hashlib.sha256(b"gdp-uplink" + ifname.encode()).digest()
    return _MARKS | int.from_bytes(digest[:3], "big")


class UplinkRoutes:
    """Rule and table of one uplink, until it is closed.

    Args:
        uplink: device that marked packets leave by; it may be absent for a time.
        mark: of the packets, and number of the table.

    Raises:
        LocalError: the kernel has no policy routing, or this user may not change routes.
    """

    def __init__(self, uplink: str, mark: int) -> None:
        self._uplink = uplink
        self._mark = mark
        self._netlink = NetlinkSocket()
        self._news = listen(LINK_GROUP | ADDRESS_GROUPS | ROUTE_GROUPS)
        self._families = [family for family in _FAMILIES if self._add_rule(family)]
        self.sync()

    def fileno(self) -> int:
        """Return a descriptor that is readable when routes may have changed."""
        return self._news.fileno()

    @property
    def warning(self) -> str:
        """Return why packets of this uplink may be lost; empty if nothing is known."""
        filters = (Path(f"/proc/sys/net/ipv4/conf/{each}/rp_filter") for each in ("all", self._uplink))
        strictest = max((int(path.read_text(encoding="ascii")) for path in filters if path.exists()), default=0)
        if strictest != _STRICT:
            return ""
        setting = f"sysctl net.ipv4.conf.{self._uplink}.rp_filter=2"
        return f"{self._uplink} drops packets from where the main table prefers another uplink: {setting}"

    def sync(self) -> None:
        """Let the table hold the main table's routes through the uplink. Raises ``RefusedError``."""
        self._read_news()
        ifindex = self._ifindex()
        for family in self._families:
            wanted, present = {_last(family)}, set[_Entry]()
            for table, oif, entry in self._routes(family):
                if table == _TABLE_MAIN and ifindex and oif == ifindex:
                    wanted.add(entry)
                elif table == self._mark:
                    present.add(entry)
            for entry in present - wanted:
                self._change(_RTM_DELROUTE, entry.message(self._mark), 0, errno.ESRCH)
            for entry in sorted(wanted - present, key=lambda each: each.has_gateway):
                # ENETUNREACH, EHOSTUNREACH: the route to the gateway went away; a notification follows
                body = entry.message(self._mark)
                self._change(
                    _RTM_NEWROUTE, body, _CREATE, errno.EEXIST, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENODEV
                )

    def close(self) -> None:
        """Remove rule and table."""
        for family in self._families:
            self._remove_rules(family)
            for table, _, entry in list(self._routes(family)):
                if table == self._mark:
                    self._change(_RTM_DELROUTE, entry.message(self._mark), 0, errno.ESRCH)
        self._news.close()
        self._netlink.close()

    def _add_rule(self, family: int) -> bool:
        """Add the rule; return False for a family that this system does not have."""
        try:
            self._remove_rules(family)
            self._netlink.change(_RTM_NEWRULE, self._rule(family), _CREATE | _EXCLUSIVE)
        except RefusedError as error:
            if error.number not in (errno.EOPNOTSUPP, errno.EAFNOSUPPORT):
                raise
            if family == socket.AF_INET6:
                return False
            raise LocalError("this kernel has no policy routing (ip rule), which uplinks need") from error
        return True

    def _remove_rules(self, family: int) -> None:
        """Remove the rule, also that of a dead run."""
        while True:
            try:
                self._netlink.change(_RTM_DELRULE, self._rule(family))
            except RefusedError as error:
                if error.number != errno.ENOENT:
                    raise
                return

    def _rule(self, family: int) -> bytes:
        head = _RULE.pack(family, 0, 0, 0, 0, 0, 0, _TO_TABLE, 0)
        priority = attribute(_FRA_PRIORITY, _NUMBER.pack(_RULE_PRIORITY))
        mark = _NUMBER.pack(self._mark)
        return head + priority + attribute(_FRA_FWMARK, mark) + attribute(_FRA_TABLE, mark)

    def _routes(self, family: int) -> Iterator[tuple[int, int, _Entry]]:
        """Yield table, device and content of each route."""
        for message in self._netlink.dump(_RTM_GETROUTE, _ROUTE.pack(family, 0, 0, 0, 0, 0, 0, 0, 0)):
            _, bits, _, tos, table, _, scope, kind, flags = _ROUTE.unpack_from(message.body)
            values = nested(message.body[_ROUTE.size :])
            if message.kind != _RTM_NEWROUTE or kind not in (_UNICAST, _UNREACHABLE):
                continue
            table = int.from_bytes(values.get(_RTA_TABLE, bytes([table])), sys.byteorder)
            oif = int.from_bytes(values.get(_RTA_OIF, b""), sys.byteorder)
            copied = tuple((each, values[each]) for each in _COPIED if each in values)
            if kind == _UNREACHABLE:  # IPv6 reports the loopback device
                copied = tuple(each for each in copied if each[0] == _RTA_PRIORITY)
            yield table, oif, _Entry(family, bits, tos, scope, kind, flags & _ON_LINK, copied)

    def _ifindex(self) -> int:
        for message in self._netlink.link_named(self._uplink):
            info = DeviceInfo.from_body(message.body)
            if LinkAttribute.IFNAME in info.attributes:
                return info.ifindex
        return 0

    def _change(self, kind: int, body: bytes, flags: int, *tolerated: int) -> None:
        try:
            self._netlink.change(kind, body, flags)
        except RefusedError as error:
            if error.number not in tolerated:
                raise

    def _read_news(self) -> None:
        while True:
            try:
                self._news.recv(READ_BYTES)
            except BlockingIOError:
                return
            except OSError as error:  # some were lost; everything is read below
                if error.errno != errno.ENOBUFS:
                    raise


def _last(family: int) -> _Entry:
    """Return the route for what no other one leads to."""
    return _Entry(family, 0, 0, 0, _UNREACHABLE, 0, ((_RTA_PRIORITY, _NUMBER.pack(_METRIC_LAST)),))
