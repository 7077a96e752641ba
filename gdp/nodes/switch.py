"""``gdp-switch``: a switch's machine on real devices.

Place: shell.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name
from gdp.nodes.config import SwitchConfig
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.nodes.pairs import attach_pairs, switch_end
from gdp.nodes.runtime import Runtime, now
from gdp.ports.link import LinkWatch
from gdp.ports.plane import Plane
from gdp.ports.raw import RawPlane
from gdp.switch.machine import Switch
from gdp.switch.table import Table
from gdp.telemetry.metrics import Metrics, Sources

__all__ = ["count_list", "run_switch"]

log = logging.getLogger(__name__)

_MTU_FALLBACK = 1_500


def run_switch(config: SwitchConfig, ready: Callable[[Name, str], None]) -> None:
    """Run a switch until it is told to stop.

    Args:
        ready: called once with the switch's name and its data plane, when it has begun.

    Raises:
        LocalError: keys, devices or ports are not as the configuration says.
    """
    identity, policy = load_member(config.identity, config.domain, Role.SWITCH)
    if not config.ports and not config.attach:
        raise LocalError("a switch needs at least one port: --iface, or ports in the configuration")
    table = Table()
    settings = NodeSettings(
        incarnation(), wall_clock_ms(), secrets.token_bytes, config.hello_s, config.dead_s
    )
    switch = Switch(identity, policy, table, settings)
    ifaces = [port.iface for port in config.ports]
    with contextlib.ExitStack() as stack:
        stack.enter_context(attach_pairs(config.attach, identity.name, _widest(ifaces)))
        plane = _open_plane(config.data_plane, [*ifaces, *map(switch_end, config.attach)], table)
        stack.callback(plane.close)
        runtime = Runtime(switch, plane, {port.iface: port.cost for port in config.ports})
        stack.enter_context(runtime.signals(lambda: _revoke(switch, config.revocations)))
        _revoke(switch, config.revocations)
        if config.metrics is not None:
            metrics = Metrics(_sources(switch, plane))
            metrics.serve(config.metrics.port)
            stack.callback(metrics.close)
        plane_name = "scapy" if config.data_plane == "scapy" else "raw"
        log.info("switch up name=%s plane=%s ports=%d", identity.name.short, plane_name, len(plane.ports))
        ready(identity.name, plane_name)
        runtime.run()


def count_list(counts: Mapping[DropReason, int]) -> list[int]:
    """Return counts by reason as a list in the order of the reasons."""
    return [counts.get(reason, 0) for reason in DropReason]


def _revoke(switch: Switch, directory: Path | None) -> None:
    """Take in, and spread, the revocations that the operator has put into a directory; known ones are no news."""
    for path in sorted(directory.iterdir()) if directory is not None else ():
        try:
            switch.revoke(path.read_bytes(), now())
        except (OSError, StatementError) as error:
            log.error("revocation not taken file=%s reason=%s", path, error)


def _widest(ifaces: Sequence[str]) -> int:
    """Return the largest MTU of these devices; what is not there, opening the port will tell."""
    with contextlib.closing(LinkWatch()) as links:
        mtus = [link.mtu for link in links.all() if link.ifname in ifaces]
    return max(mtus, default=_MTU_FALLBACK)


def _open_plane(kind: str, ifaces: Sequence[str], table: Table) -> Plane:
    if kind == "scapy":
        from gdp.ports.scapy_plane import ScapyPlane

        return ScapyPlane(ifaces, table)
    return RawPlane(ifaces, table)


def _sources(switch: Switch, plane: Plane) -> Sources:
    counters = plane.counters
    return Sources(
        frames=lambda: {
            "in": counters.frames_in,
            "out": counters.frames_out,
            "forwarded": counters.forwarded,
            "handed-up": counters.handed_up,
        },
        drops=[lambda: counters.drops, lambda: count_list(switch.drops())],
        table_entries=lambda: len(switch.table),
        parked_frames=lambda: len(switch.parked),
    )
