"""Live endpoints: opens those that a configuration names.

I/O. Only the named ones are imported, because each endpoint needs packages of its own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from gdp.extras import Seam
from proxy.config.graph import RosGraphConfig
from proxy.endpoints.core.endpoint import RosEndpoint

_ENDPOINTS: Final[Seam[Callable[[int, str], RosEndpoint]]] = Seam("gdp.endpoint")


def open_endpoint(end: RosGraphConfig, node: str) -> RosEndpoint:
    """Join a graph as a node of this name.

    Raises:
        LocalError: a package that the endpoint needs is not installed; the text states how to get it.
    """
    if end.endpoint == "ros1":
        from proxy.endpoints.ros1 import Ros1Endpoint

        return Ros1Endpoint(end.master_uri, node)
    if end.endpoint == "dds":
        return _ENDPOINTS.get("dds", "endpoint dds")(end.domain_id, node)
    from proxy.endpoints.ros2 import Ros2Endpoint

    return Ros2Endpoint(end.domain_id, node)


@contextlib.contextmanager
def open_endpoints(ends: Sequence[RosGraphConfig], node: str) -> Iterator[list[RosEndpoint]]:
    """Join all graphs; leave them on leaving."""
    with contextlib.ExitStack() as stack:
        opened = list[RosEndpoint]()
        for end in ends:
            opened.append(open_endpoint(end, node))
            stack.callback(opened[-1].shut_down)
        yield opened
