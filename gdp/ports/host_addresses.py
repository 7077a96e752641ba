"""Addresses of this host's devices at which a peer may reach it.

I/O; rtnetlink through pyroute2, imported only here because it is large.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection
from typing import Final

__all__ = ["host_addresses"]

_UNIVERSE: Final = 0  # RT_SCOPE_UNIVERSE: neither of a link nor of the host alone; rtnetlink(7)
_NOT_READY: Final = 0x08 | 0x20 | 0x40  # IFA_F_DADFAILED, IFA_F_DEPRECATED, IFA_F_TENTATIVE


def host_addresses(excluded: Collection[str] = (), only: str | None = None) -> list[str]:
    """Return the numeric addresses of global scope, IPv6 last.

    Args:
        excluded: names of devices that do not count.
        only: name of the one device that counts; None: all do.
    """
    from pyroute2 import IPRoute

    found: list[str] = []
    with IPRoute() as routes:
        names = {link["index"]: link.get_attr("IFLA_IFNAME") for link in routes.get_links()}
        for each in routes.get_addr():
            flags = each.get_attr("IFA_FLAGS") or 0
            name = names.get(each["index"])
            is_counted = name not in excluded and only in (None, name)
            if is_counted and each["scope"] == _UNIVERSE and not flags & _NOT_READY:
                found.append(each.get_attr("IFA_LOCAL") or each.get_attr("IFA_ADDRESS"))
    return sorted(found, key=lambda text: (ipaddress.ip_address(text).version, ipaddress.ip_address(text).packed))
