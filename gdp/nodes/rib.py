"""``gdp-rib``: a RIB's machine on a real device, with the embedded store.

Place: shell.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
from collections.abc import Callable

from gdp.client.rib_host import RibHost
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.names import Name
from gdp.nodes.config import RibConfig
from gdp.nodes.counts import count_list
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.nodes.runtime import Runtime
from gdp.ports.plane import Plane
from gdp.ports.raw import RawPlane
from gdp.rib.machine import Rib, RibSettings
from gdp.rib.store import MemoryStore
from gdp.telemetry.sources import Sources

__all__ = ["run_rib"]

log = logging.getLogger(__name__)


def run_rib(config: RibConfig, ready: Callable[[Name], None]) -> None:
    """Run a RIB until it is told to stop.

    Args:
        ready: called once with the RIB's name, when its switch has been found.

    Raises:
        LocalError: keys or the device are not as the configuration says.
    """
    identity, policy = load_member(config.identity, config.domain, Role.RIB)
    quotas = config.quotas
    settings = RibSettings(
        config.upper, config.allow_unowned, quotas.names_per_sender, quotas.watches, quotas.lease_max_s
    )
    rib = Rib(identity, policy, MemoryStore(), settings)
    attachment = NodeSettings(incarnation(), wall_clock_ms(), secrets.token_bytes)
    host = RibHost(identity, policy, rib, attachment)
    with contextlib.ExitStack() as stack:
        plane = RawPlane([config.iface])
        stack.callback(plane.close)
        runtime = Runtime(host, plane)
        stack.enter_context(runtime.signals())
        if config.metrics is not None:
            from gdp.telemetry.metrics import Metrics

            metrics = Metrics(_sources(host, plane))
            metrics.serve(config.metrics.port)
            stack.callback(metrics.close)
        log.info("rib up name=%s iface=%s", identity.name.short, config.iface)
        if runtime.run(lambda: host.attachment.switch is not None):
            ready(identity.name)
        runtime.run()


def _sources(host: RibHost, plane: Plane) -> Sources:
    counters, rib = plane.counters, host.rib
    return Sources(
        frames=lambda: {"in": counters.frames_in, "out": counters.frames_out, "handed-up": counters.handed_up},
        drops=[lambda: counters.drops, lambda: count_list(host.drops())],
        table_entries=lambda: rib.names,
        rib_answers=lambda: {
            "found": rib.answers,
            "nobody": rib.negative_answers,
            "accepted": rib.accepted,
        },
        rib_refusals=lambda: {reason.label: count for reason, count in list(rib.refusals.items())},
    )
