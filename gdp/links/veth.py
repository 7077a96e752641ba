"""Veth pairs for nodes attached on the same host: the switch's command makes them and removes them when it ends.

I/O; netlink through pyroute2, imported only here because it is large.

Each pair carries its switch's name as an alias. The alias identifies the pairs of a killed run of the same switch,
which are replaced. A device of that name without the alias belongs to another program and is refused. The switch's ends
are locked while the pairs exist (``single_instance.py``), so the pair of a running switch is never touched.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gdp.errors import LocalError
from gdp.host.single_instance import own_devices
from gdp.names import Name
from gdp.ports.sockets import AS_ROOT

if TYPE_CHECKING:
    from pyroute2 import IPRoute
    from pyroute2.netlink.exceptions import NetlinkError

__all__ = ["attach_pairs", "switch_end"]

log = logging.getLogger(__name__)


def switch_end(name: str) -> str:
    """Return the device at the switch's end of a pair."""
    return f"{name}-s"


@contextlib.contextmanager
def attach_pairs(names: Sequence[str], switch: Name, mtu: int) -> Iterator[None]:
    """Make the pairs ``NAME``/``NAME-s`` until the context ends, and hold the locks of the switch's ends.

    Args:
        mtu: bytes after the Ethernet header.

    Raises:
        LocalError: a device of that name belongs to another program or to a running switch, or the system refuses to
            make devices.
    """
    if not names:
        yield
        return
    from pyroute2 import IPRoute
    from pyroute2.netlink.exceptions import NetlinkError

    alias = f"gdp-switch {switch.to_text()}"
    made: list[str] = []
    with own_devices(map(switch_end, names)), IPRoute() as links:
        try:
            try:
                for name in names:
                    _clear(links, switch_end(name), alias)
                    _make(links, name, alias, mtu)
                    made.append(name)
            except NetlinkError as error:
                raise LocalError(f"attach {name}: the veth pair cannot be made: {_reason(error, mtu)}") from error
            yield
        finally:
            for name in made:
                for index in links.link_lookup(ifname=switch_end(name)):
                    links.link("del", index=index)


def _reason(error: NetlinkError, mtu: int) -> str:
    """Return what the kernel refused and how to proceed."""
    if error.code in (errno.EPERM, errno.EACCES):
        return f"not permitted; {AS_ROOT}"
    if error.code == errno.EINVAL:
        return f"invalid argument (MTU {mtu}, which it takes from the widest port)"
    return os.strerror(error.code) if error.code else str(error)


def _clear(links: IPRoute, ifname: str, alias: str) -> None:
    for link in links.get_links():
        if link.get_attr("IFLA_IFNAME") == ifname:
            if link.get_attr("IFLA_IFALIAS") != alias:
                raise LocalError(f"attach: the device {ifname} exists and is not ours")
            log.warning("a dead run left a device ifname=%s", ifname)
            links.link("del", index=link["index"])


def _make(links: IPRoute, name: str, alias: str, mtu: int) -> None:
    end = switch_end(name)
    links.link("add", ifname=name, kind="veth", mtu=mtu, peer={"ifname": end, "mtu": mtu})
    for ifname in (name, end):
        (index,) = links.link_lookup(ifname=ifname)
        quiet = Path(f"/proc/sys/net/ipv6/conf/{ifname}/disable_ipv6")
        if quiet.exists():
            with contextlib.suppress(OSError):  # read-only in some containers; the cost is only a few stray frames
                quiet.write_text("1")
        links.link("set", index=index, ifalias=alias)
        links.link("set", index=index, state="up")
