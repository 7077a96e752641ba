"""Ports of a switch on the TAP devices of its relay, which come and go with the relay's clients.

I/O. The alias of a device states whose relay made it; only root or CAP_NET_ADMIN can set it. A port on it costs far
more than a tunnel, so that frames prefer UDP where both lead to a border.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from gdp.errors import LocalError
from gdp.intervals import FORGET_S
from gdp.names import Name
from gdp.ports.netlink import LINK_GROUP, LinkAttribute, NetlinkSocket, Notifications
from gdp.ports.tap import relay_alias
from gdp.runtime.runtime import Runtime
from gdp.sansio import Timestamps

if TYPE_CHECKING:  # a relay, which knows the devices by their mark, loads no switch
    from gdp.switch.core import SwitchCore

log = logging.getLogger(__name__)

RELAY_COST: Final = 1_000
VIA: Final = "tls (slower)"


class RelayPorts:
    """The relay's ports of a running switch.

    Args:
        excluded: devices that the configuration names as ports.
        cost: of each port.

    Raises:
        LocalError: the kernel opens no netlink sockets.
    """

    def __init__(
        self, *, name: Name, switch: SwitchCore, runtime: Runtime, excluded: frozenset[str], cost: int = RELAY_COST
    ) -> None:
        self._alias = relay_alias(name)
        self._switch = switch
        self._runtime = runtime
        self._excluded = excluded
        self._cost = cost
        self._questions = NetlinkSocket()
        self._news = Notifications(LINK_GROUP)
        self._has_news = True
        self._ports: dict[str, int] = {}
        self._closed: deque[tuple[float, int]] = deque()  # ports that the control plane may still name
        runtime.watch(self._news, self._take_news)

    @property
    def ports(self) -> frozenset[int]:
        """Return the port indices of the relay's devices."""
        return frozenset(self._ports.values())

    def status(self) -> list[dict[str, object]]:
        """Return the JSON fields of each port, with the neighbour that is up there."""
        neighbours = {each.port: each for each in self._switch.hello_protocol.neighbours.all_up()}
        rows: list[dict[str, object]] = []
        for ifname, port in self._ports.items():
            found = neighbours.get(port)
            peer = None if found is None else found.name.to_text()
            rows.append({"peer": peer, "device": ifname, "via": VIA, "cost": self._cost, "up": found is not None})
        return rows

    def handle_timer(self, now: Timestamps) -> None:
        """Add ports for new devices of the relay, and remove those whose device is gone."""
        while self._closed and now.mono_s >= self._closed[0][0]:
            self._switch.hello_protocol.remove_port(self._closed.popleft()[1])
        if not self._has_news:
            return
        self._has_news = False
        try:
            present = self._devices()
        except LocalError as error:
            log.warning("devices of the relay not listed reason=%s", error)
            self._has_news = True
            return
        for ifname in self._ports.keys() - present:
            self._remove(ifname)
        for ifname in sorted(present - self._ports.keys()):
            try:
                self._ports[ifname] = self._runtime.add_port(ifname, self._cost)
            except LocalError as error:
                log.error("relay's device not used ifname=%s reason=%s", ifname, error)
                continue
            log.info("port of the relay ifname=%s via=tls cost=%d", ifname, self._cost)

    def close(self) -> None:
        """Stop following the devices."""
        self._runtime.unwatch(self._news)
        self._news.close()
        self._questions.close()

    def _remove(self, ifname: str) -> None:
        port = self._ports.pop(ifname)
        self._runtime.remove_port(port)
        self._closed.append((time.monotonic() + FORGET_S, port))
        log.info("port of the relay removed ifname=%s", ifname)

    def _devices(self) -> frozenset[str]:
        ours = (each for each in self._questions.links() if each.text(LinkAttribute.IFALIAS) == self._alias)
        return frozenset(each.text(LinkAttribute.IFNAME) for each in ours) - self._excluded

    def _take_news(self) -> None:
        self._has_news = True
        self._news.has_news()
