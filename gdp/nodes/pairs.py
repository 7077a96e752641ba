"""Veth pairs for nodes attached on the same host: made by the switch's command, gone when it ends.

Place: shell; netlink through pyroute2, imported only here because it is large.

Each pair carries its switch's name as an alias. What a killed run of the same switch left behind is known by it and is
replaced; a device of that name without the alias is somebody else's and is refused.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gdp.errors import LocalError
from gdp.names import Name

if TYPE_CHECKING:
    from pyroute2 import IPRoute

__all__ = ["attach_pairs", "switch_end"]

log = logging.getLogger(__name__)


def switch_end(name: str) -> str:
    """Return the device at the switch's end of a pair."""
    return f"{name}-s"


@contextlib.contextmanager
def attach_pairs(names: Sequence[str], switch: Name, mtu: int) -> Iterator[None]:
    """Make the pairs ``NAME``/``NAME-s`` while within.

    Args:
        mtu: bytes after the Ethernet header.

    Raises:
        LocalError: a device of that name belongs to somebody else, or devices cannot be made here.
    """
    if not names:
        yield
        return
    from pyroute2 import IPRoute
    from pyroute2.netlink.exceptions import NetlinkError

    alias = f"gdp-switch {switch.to_text()}"
    made: list[str] = []
    with IPRoute() as links:
        try:
            try:
                for name in names:
                    _clear(links, switch_end(name), alias)
                    _make(links, name, alias, mtu)
                    made.append(name)
            except NetlinkError as error:
                raise LocalError(f"attach {name}: the veth pair cannot be made: {error}") from error
            yield
        finally:
            for name in made:
                for index in links.link_lookup(ifname=switch_end(name)):
                    links.link("del", index=index)


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
            with contextlib.suppress(OSError):  # read-only in some containers: only a few stray frames
                quiet.write_text("1")
        links.link("set", index=index, ifalias=alias)
        links.link("set", index=index, state="up")
