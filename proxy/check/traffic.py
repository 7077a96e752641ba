"""Traffic of topics, measured by reading them for a while.

I/O. Each topic is read with the profile that all its publishers fulfil, so no publisher waits for this reader longer
than for any other.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace

from gdp.errors import LocalError
from gdp.ports.readiness import readable
from proxy.check.suggestion import Offered, Traffic
from proxy.endpoints.core.endpoint import Graph, MessageReceived, Role, RosEndpoint
from proxy.endpoints.core.qos import request


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
