"""Snapshot of live graphs and traffic of their topics: both are observed for a while, and nothing is carried.

I/O. Each topic is read with the profile that all its publishers fulfil, so no publisher waits for this reader longer
than for any other.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gdp.errors import LocalError
from gdp.ports.readiness import readable
from proxy.check.suggestion import Offered, Traffic
from proxy.config.graph import RosGraphConfig
from proxy.endpoints.core.endpoint import Graph, MessageReceived, Role, RosEndpoint, proxy_node_name
from proxy.endpoints.core.qos import request
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


def measured(endpoint: RosEndpoint, graph: Graph, offered: Sequence[Offered], seconds: float) -> list[Offered]:
    """Return the same names, topics with their traffic; a topic whose type is unknown here has none."""
    handles = dict[int, int]()
    counted = dict[int, list[int]]()
    for at, each in enumerate(offered):
        if each.kind != "topic":
            continue
        offers = [
            entity.qos
            for entity in graph
            if entity.role is Role.PUBLISHES and entity.name == each.name and entity.qos is not None
        ]
        with contextlib.suppress(LocalError):  # the type is not installed here: the name is shown without a rate
            handles[endpoint.subscribe(each.name, each.type_name, request(offers) if offers else None)] = at
            counted[at] = [0, 0]
    end_s = time.monotonic() + seconds
    while (rest_s := end_s - time.monotonic()) > 0:
        readable([endpoint], rest_s)
        for event in endpoint.poll_events():
            if isinstance(event, MessageReceived) and event.handle in handles:
                count = counted[handles[event.handle]]
                count[0] += 1
                count[1] += len(event.raw)
    for handle in handles:
        endpoint.close(handle)
    return [
        replace(each, traffic=Traffic(counted[at][0], counted[at][1], seconds)) if at in counted else each
        for at, each in enumerate(offered)
    ]
