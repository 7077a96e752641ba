"""Uplink device of a RIB or proxy: locked against a second node, and opened with advice in the error.

I/O.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator

from gdp.errors import LocalError
from gdp.nodes.single_instance import own_devices
from gdp.ports.netdev import NoDeviceError
from gdp.ports.raw import RawPlane

__all__ = ["open_uplink", "refuse_loopback"]


@contextlib.contextmanager
def open_uplink(ifname: str) -> Iterator[RawPlane]:
    """Open a node's device; close it on leaving.

    Raises:
        LocalError: the device does not exist, another node uses it, or the process may not open raw sockets.
    """
    refuse_loopback([ifname])
    with own_devices([ifname]):
        try:
            plane = RawPlane([ifname])
        except NoDeviceError as error:
            raise LocalError(
                f"{ifname}: no such device; start gdp-switch with attach: [{ifname}] first, or wait for it with"
                " --await-iface SECONDS"
            ) from error
        try:
            yield plane
        finally:
            plane.close()


def refuse_loopback(ifnames: Iterable[str]) -> None:
    """Refuse the loopback device as a port, with a ``LocalError``."""
    if "lo" in ifnames:
        raise LocalError("lo is the loopback device, which leads to no neighbour; name a network device such as eth0")
