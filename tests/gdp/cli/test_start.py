"""Modules loaded at the start of a node: a machine that replaces another must serve within seconds."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable

import pytest

from gdp.cli.rib import rib
from proxy.cli.proxy import proxy

LARGE = {"networkx", "prometheus_client", "pyroute2", "rich.console", "rosbags.rosbag1", "rosbags.rosbag2", "scapy"}


@pytest.mark.parametrize(
    "modules",
    [
        "gdp.cli.switch, gdp.ports.kernel.plane",
        "gdp.cli.rib",
        "proxy.cli.proxy, proxy.node.bridge_node",
        "fog.host.cli",
    ],
)
def test_a_node_starts_without_large_libraries_that_it_does_not_need(modules: str) -> None:
    code = f"import sys, {modules}; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert LARGE & set(said.split()) == set()


@pytest.mark.parametrize("command", [rib, proxy])
def test_a_node_that_starts_with_its_switch_waits_for_the_device(command: Callable[..., None]) -> None:
    assert inspect.signature(command).parameters["await_iface"].default >= 10
