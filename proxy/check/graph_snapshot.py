"""Snapshot of live graphs: observes them for a while without carrying anything."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from gdp.ports.readiness import readable
from proxy.config.graph import RosGraphConfig
from proxy.endpoints.core.endpoint import Graph, proxy_node_name
from proxy.endpoints.live import open_endpoints

LOOK_S: Final = 4.0  # if the first announcement is missed, Fast DDS repeats it after 3 s


def read_graphs(ends: Sequence[RosGraphConfig], name_hex: str, purpose: str) -> list[tuple[str, Graph]]:
    """Return label and entities of each graph, after ``LOOK_S`` seconds.

    Args:
        purpose: suffix of the observing node's name.

    Raises:
        LocalError: an endpoint is unavailable.
    """
    with open_endpoints(ends, proxy_node_name(name_hex, purpose)) as endpoints:
        end_s = time.monotonic() + LOOK_S
        for endpoint in endpoints:
            while (rest_s := end_s - time.monotonic()) > 0:
                readable([endpoint], rest_s)
                endpoint.poll_events()  # events are ignored, only the final graph counts
        for endpoint in endpoints:
            endpoint.poll_events()
        return [(endpoint.label, endpoint.graph()) for endpoint in endpoints]
