"""``gdp up --suggest``: writes a commented ``proxy.yaml`` from the live ROS graph."""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Table

from gdp.errors import LocalError
from gdp.extras import install_command
from gdp.ports.readiness import readable
from gdp.printable import printable
from gdp.stores.files import public, write_all
from proxy.check.graph_snapshot import LOOK_S, measured
from proxy.check.suggestion import Offered, offered_names, suggested_file
from proxy.config.graph import RosGraphConfig
from proxy.endpoints.core.endpoint import Graph, RosEndpoint, proxy_node_name
from proxy.endpoints.live import open_endpoint

_FILE: Final = "proxy.yaml"
_SUGGESTED: Final = "proxy.yaml.suggested"
_TRAFFIC_S: Final = 3.0
_EMPTY_LOOKS: Final = 4


def suggest(directory: Path) -> Path:
    """Observe the graph for some seconds, print what it offers, and write the file; return its path.

    It is ``proxy.yaml``, or ``proxy.yaml.suggested`` where there is a ``proxy.yaml`` already.

    Raises:
        LocalError: no ROS is installed, or the file cannot be written.
    """
    has_rclpy = importlib.util.find_spec("rclpy") is not None
    if not has_rclpy and importlib.util.find_spec("cyclonedds") is None:
        raise LocalError(f"gdp up: neither rclpy nor cyclonedds is installed; run: {install_command('dds')}")
    end = RosGraphConfig(endpoint="ros2" if has_rclpy else "dds")
    endpoint = open_endpoint(end, proxy_node_name("0" * 12, "suggest"))
    try:
        graph = _observed(endpoint)
        offered = measured(endpoint, graph, offered_names(graph), _TRAFFIC_S)
        label = endpoint.label
    finally:
        endpoint.shut_down()
    path = directory / (_SUGGESTED if (directory / _FILE).exists() else _FILE)
    text = suggested_file(offered, end.endpoint, label)
    write_all(directory, {path.name: public(text.encode())}, force=path.name == _SUGGESTED)
    _show(offered, label, path)
    return path


def _observed(endpoint: RosEndpoint) -> Graph:
    """Return the graph after a while; one in which nothing shows yet gets more time, for a busy machine."""
    begun_s = time.monotonic()
    for look_s in (LOOK_S, _EMPTY_LOOKS * LOOK_S):
        while (rest_s := begun_s + look_s - time.monotonic()) > 0:
            readable([endpoint], rest_s)
            endpoint.poll_events()  # only the final graph counts
        if offered_names(endpoint.graph()):
            break
    return endpoint.graph()


def _show(offered: list[Offered], label: str, path: Path) -> None:
    console = Console(file=sys.stderr)
    table = Table("kind", "name", "type", "traffic", box=None, title=f"what {label} offers", title_justify="left")
    for each in offered:
        table.add_row(each.kind, printable(each.name), printable(each.type_name), each.note)
    console.print(table)
    console.print(f"wrote {path}: every rule in it is a comment until you delete its '#'", highlight=False)
