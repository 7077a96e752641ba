"""Modules that commands and nodes load: a command answers at once, and a machine that replaces another serves soon."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable

import pytest

from gdp.cli.rib import rib
from proxy.cli.proxy import proxy

LARGE = {
    "apsw",
    "networkx",
    "prometheus_client",
    "pyroute2",
    "rich",
    "rosbags.rosbag1",
    "rosbags.rosbag2",
    "rosbags.typesys",
    "ruamel.yaml",
    "scapy",
}
OF_NODES = {
    "asyncio",
    "cryptography.hazmat.primitives.serialization",
    "numpy",
    "pydantic",
    "yaml",
}  # a short command needs none
TUNNELS = {"gdp.links.tunnels", "gdp.ports.tunnel.wireguard"}


@pytest.mark.parametrize(
    ("modules", "needless"),
    [
        (
            "gdp.cli.switch, gdp.nodes.switch, gdp.ports.kernel.plane",
            {"numpy", "gdp.client", "gdp.rib", "gdp.diagnosis.facts", "gdp.config.relay_config", *TUNNELS},
        ),
        ("gdp.cli.rib, gdp.nodes.rib", {"numpy", "gdp.client.participant", "gdp.diagnosis.facts", "gdp.switch.core"}),
        ("proxy.cli.proxy, proxy.node.bridge_node", {"numpy", "gdp.rib", "gdp.diagnosis.facts", "gdp.switch.core"}),
        ("proxy.cli.proxy, proxy.node.recorder", {"numpy", "gdp.rib", "proxy.recordings.reader"}),
        ("gdp.cli.relay, gdp.nodes.relay", {"numpy", "gdp.client", "gdp.rib", "gdp.switch.core"}),
        ("fog.host.cli", set[str]()),
    ],
)
def test_a_node_starts_without_large_libraries_and_parts_of_other_nodes(modules: str, needless: set[str]) -> None:
    code = f"import sys, {modules}; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert (LARGE | needless) & set(said.split()) == set()


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("gdp.cli.gdp", ["--help"]),
        ("gdp.cli.gdp", ["--version"]),
        ("gdp.cli.gdp", ["show", "links"]),
        ("gdp.cli.gdp", ["name", "--kind", "topic", "--name", "/scan"]),
        ("gdp.cli.gdp", ["status", "--help"]),
        ("gdp.cli.gdp", ["topic", "list"]),
        ("gdp.cli.gdp", ["topic", "--help"]),
        ("gdp.cli.gdp", ["service", "--help"]),
        ("gdp.cli.switch", ["--help"]),
        ("gdp.cli.rib", ["--help"]),
        ("gdp.cli.relay", ["--help"]),
        ("proxy.cli.proxy", ["--help"]),
    ],
)
def test_a_short_command_loads_nothing_of_a_node(program: str, words: list[str]) -> None:
    code = (
        f"import atexit, sys\natexit.register(lambda: print(*sys.modules))\nfrom {program} import main\nmain({words})"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout
    assert program in said
    assert (LARGE | OF_NODES) & set(said.split()) == set()


@pytest.mark.parametrize("command", [rib, proxy])
def test_a_node_that_starts_with_its_switch_waits_for_the_device(command: Callable[..., None]) -> None:
    assert inspect.signature(command).parameters["await_iface"].default >= 10


@pytest.mark.parametrize("words", [["topic", "--help"], ["topic", "list", "--help"], ["--version"]])
def test_a_help_text_loads_nothing_that_asks_nodes(words: list[str]) -> None:
    code = (
        f"import atexit, sys\natexit.register(lambda: print(*sys.modules))\nfrom gdp.cli.gdp import main\nmain({words})"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout
    assert "gdp.cli.gdp" in said
    assert {"gdp.management.control_socket", "gdp.state.control_protocol"} & set(said.split()) == set()
