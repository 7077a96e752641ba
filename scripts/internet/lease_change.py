"""Change of a host's addresses and default routes in one thread, without a process: an instant, as a DHCP client does.

I/O; rtnetlink(7) inside the namespace of the calling thread.
"""

from __future__ import annotations

import ipaddress
import socket
from typing import Final

from pyroute2 import IPRoute
from pyroute2.netlink.exceptions import NetlinkError

from gdp.errors import LocalError
from internet.site import Lease

_IFA_F_NODAD: Final = 0x02
_PERMANENT: Final = 0x80  # NUD_PERMANENT: of a state that no flush removes
_NOARP: Final = 0x40


def change_lease(device: str, old: Lease, new: Lease, metric: int) -> None:
    """Replace the addresses and default routes of a device, and forget its neighbours.

    Args:
        metric: of the default routes.

    Raises:
        LocalError: the kernel refuses.
    """
    try:
        with IPRoute() as netlink:
            index = socket.if_nametoindex(device)
            for address, gateway in _pairs(old):
                netlink.route("del", **_route(gateway, index, metric))
                netlink.addr("del", index=index, **_address(address))
            for each in list(netlink.get_neighbours(ifindex=index)):
                if not each["state"] & (_PERMANENT | _NOARP):
                    netlink.neigh("del", ifindex=index, family=each["family"], dst=each.get_attr("NDA_DST"))
            for address, gateway in _pairs(new):
                netlink.addr("add", index=index, flags=_IFA_F_NODAD if ":" in address else 0, **_address(address))
                netlink.route("add", **_route(gateway, index, metric))
    except (NetlinkError, OSError) as error:
        raise LocalError(f"the addresses of {device} are not changed: {error}") from error


def _pairs(lease: Lease) -> list[tuple[str, str]]:
    both = ((lease.address, lease.gateway), (lease.address6, lease.gateway6))
    return [(address, gateway) for address, gateway in both if address]


def _address(text: str) -> dict[str, object]:
    address, _, bits = text.partition("/")
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    return {"address": str(ipaddress.ip_address(address)), "prefixlen": int(bits), "family": family}


def _route(gateway: str, index: int, metric: int) -> dict[str, object]:
    family = socket.AF_INET6 if ":" in gateway else socket.AF_INET
    return {"dst": "default", "gateway": gateway, "oif": index, "priority": metric, "family": family}
