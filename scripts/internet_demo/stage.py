"""Stage of the demonstration: an internet with four machines, of which three join the domain of the fourth by tokens.

I/O. ::

    robot   wlan0 -- home, port-restricted NAT ----+
            wwan0 -- 5G, symmetric NAT ------------+-- internet -- cloud-b, public: border, RIB, enrolment
    cloud-a ------- provider, port-restricted NAT -+
    edge    ------- office, IPv6 only -------------+
"""

from __future__ import annotations

from typing import Final

from internet.access import Access
from internet.laboratory import Laboratory
from internet.overlay import Overlay
from internet.site import Site

WIFI: Final = "wlan0"
WWAN: Final = "wwan0"


class Stage(Overlay):
    """Networks, and machines with their programs.

    ``delay_ms``: of each uplink, in each direction; 0: none, and no process for it.
    """

    def __init__(self, laboratory: Laboratory, delay_ms: float) -> None:
        self._laboratory, self._delay_ms = laboratory, delay_ms
        self.cloud_b = laboratory.add_host("cloud-b", self.add_site("dc", Access.PUBLIC))
        super().__init__(laboratory, self.cloud_b)
        self._add_members()

    def _add_members(self) -> None:
        """Make the machines that join."""
        self.home, self.mobile = self.add_site("home", Access.PORT_RESTRICTED), self.add_site("5g", Access.SYMMETRIC)
        self.robot = self._laboratory.add_host("robot", self.home, WIFI)
        self.robot.attach(self.mobile, WWAN)
        self.cloud_a = self._laboratory.add_host("cloud-a", self.add_site("provider", Access.PORT_RESTRICTED))
        self.edge = self._laboratory.add_host("edge", self.add_site("office", Access.IPV6_ONLY))

    def add_site(self, label: str, access: Access) -> Site:
        """Attach one more network."""
        return self._laboratory.add_site(label, access, delay_ms=self._delay_ms)
