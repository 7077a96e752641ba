"""Looking at live graphs for a while, without carrying anything.

Place: shell.
"""

from __future__ import annotations

import select
import time
from collections.abc import Sequence
from typing import Final

from proxy.config.graph import RosGraphConfig
from proxy.endpoints.endpoint import Graph, proxy_node_name
from proxy.endpoints.live import open_endpoints

__all__ = ["LOOK_S", "look"]

LOOK_S: Final = 4.0  # where a first announcement is missed, Fast DDS repeats it after 3 s


def look(ends: Sequence[RosGraphConfig], name_hex: str, purpose: str) -> list[tuple[str, Graph]]:
    """Return what each graph is called, and who is in it after a while.

    Args:
        name_hex: GDP name of the proxy.
        purpose: a word that ends the name of the node that looks.

    Raises:
        LocalError: an endpoint cannot be had.
    """
    with open_endpoints(ends, proxy_node_name(name_hex, purpose)) as endpoints:
        end_s = time.monotonic() + LOOK_S
        for endpoint in endpoints:
            while (rest_s := end_s - time.monotonic()) > 0:
                select.select([endpoint], [], [], rest_s)
                endpoint.poll_events()  # what happens is of no interest, only how it is in the end
        for endpoint in endpoints:
            endpoint.poll_events()
        return [(endpoint.label, endpoint.graph()) for endpoint in endpoints]
