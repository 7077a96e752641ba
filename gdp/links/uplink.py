"""Uplink device of a RIB or proxy: awaited, locked against a second node, and opened with advice in the error."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TypeAlias

from gdp.config.config import UplinkPlane
from gdp.errors import LocalError
from gdp.extras import require_extra
from gdp.host.single_instance import own_devices
from gdp.ports.netdev import NetdevPlane, NoDeviceError
from gdp.ports.readiness import readable
from gdp.ports.rtnetlink import LinkMonitor

log = logging.getLogger(__name__)

MakePlane: TypeAlias = Callable[[Sequence[str]], NetdevPlane]  # opens devices


@contextlib.contextmanager
def open_uplink(ifname: str, make: MakePlane) -> Iterator[NetdevPlane]:
    """Open a node's device; close it on leaving.

    Args:
        make: as from ``load_plane``.

    Raises:
        LocalError: the device does not exist, another node uses it, or the process may not open raw sockets.
    """
    refuse_loopback([ifname])
    with own_devices([ifname]):
        try:
            plane = make([ifname])
        except NoDeviceError as error:
            raise LocalError(
                f"{ifname}: no such device; start gdp-switch with attach: [{ifname}] first, or wait for it with"
                " --await-iface SECONDS"
            ) from error
        try:
            yield plane
        finally:
            plane.close()


def load_plane(data_plane: UplinkPlane, stack: contextlib.ExitStack) -> MakePlane:
    """Return what opens a data plane. A confined process calls this before: it reads files and loads programs.

    Args:
        stack: closes what the plane would have closed, if none is opened.

    Raises:
        MissingExtraError: Scapy is requested and not installed.
    """
    if data_plane == "raw":
        from gdp.ports.kernel.keepalive_plane import KeepalivePlane
        from gdp.ports.kernel.keepalives import open_sessions

        sessions = open_sessions()
        if sessions is not None:
            stack.callback(sessions.close)
        return partial(KeepalivePlane, sessions=sessions)
    require_extra("scapy", ("scapy",), "data plane scapy")
    from gdp.ports.scapy_plane import ScapyPlane

    return ScapyPlane


def refuse_loopback(ifnames: Iterable[str]) -> None:
    """Refuse the loopback device as a port, with a ``LocalError``."""
    if "lo" in ifnames:
        raise LocalError("lo is the loopback device, which leads to no neighbour; name a network device such as eth0")


def wait_for_device(ifname: str, patience_s: float) -> None:
    """Return when a device of this name exists, or after ``patience_s``; opening it then reports its absence."""
    end_s = time.monotonic() + patience_s
    with contextlib.closing(LinkMonitor()) as links:
        found, is_logged = links.all(), False
        while not any(link.ifname == ifname and not link.gone for link in found):
            rest_s = end_s - time.monotonic()
            if rest_s <= 0:
                return
            if not is_logged:
                log.info("waiting for device ifname=%s timeout_s=%g", ifname, patience_s)
                is_logged = True
            readable([links], rest_s)
            found = links.poll()
