"""Nodes at rest in namespaces: the kernel runs their keepalives at both ends of a link, or they do it themselves."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from gdp.errors import LocalError
from gdp.intervals import KEEPALIVE_MS
from gdp.management.control_client import NodeConnection, control_path, find_control_socket
from gdp.names import Name
from gdp.ports.kernel.keepalives import KeepaliveSessions
from lab.credentials import Carried
from lab.machine import PROGRAMS
from lab.machines import BenchNodes, Lab
from lab.process import LabProcess, new_run, until
from lab.topology import chain

pytestmark = pytest.mark.netns

PATIENCE_S = 30.0
LOOK_S = 2.0
KEEPALIVES = 1_000 * LOOK_S / KEEPALIVE_MS  # of one neighbour in that time
NO_BPF = ("setpriv", "--bounding-set=-bpf,-sys_admin", "--inh-caps=-bpf,-sys_admin", "--")


@pytest.fixture
def nodes() -> Iterator[BenchNodes]:
    """A switch and its RIB."""
    try:
        KeepaliveSessions().close()
    except LocalError as error:
        pytest.skip(str(error).partition("\n")[0])
    with new_run() as run:
        lab = Lab(run, chain(1))
        with BenchNodes(lab, lab.topology.nodes, plane="auto") as running:
            yield running


def start(nodes: BenchNodes, role: str, file: str, *first: str) -> tuple[LabProcess, NodeConnection]:
    """Start a RIB or a proxy after these words; return it and the connection to it."""
    argv = [*first, sys.executable, "-m", PROGRAMS[role], "--json", "--config", file]
    process = nodes.running[role, "s1"] = nodes.lab.machines["s1"].launch(argv, f"{role}-again")
    return process, connection(str(process.read(PATIENCE_S)["name"]))


def connection(name: str) -> NodeConnection:
    return NodeConnection(control_path(Name.from_text(name)))


def recorder(nodes: BenchNodes) -> str:
    """Return the configuration of a proxy that records."""
    at, carried = nodes.lab.topology.attached("proxy")[0], Carried("/rest", "std_msgs/msg/String")
    record = {"path": str(nodes.lab.directory / "rest.mcap")}
    return str(nodes.credentials.proxy(at, {"import": [carried]}, record=record))


def frames(node: NodeConnection) -> int:
    """Return the frames that have come to the process of a node."""
    counters = node.status()["counters"]
    assert isinstance(counters, dict)
    return int(counters["frames"]["in"])


def came(node: NodeConnection) -> int:
    begun = frames(node)
    time.sleep(LOOK_S)
    return frames(node) - begun


def wait_for_kernel(node: NodeConnection, role: str) -> None:
    until(lambda: came(node) < KEEPALIVES / 4, f"keepalives of the {role} in the kernel", PATIENCE_S)


def end_rib(nodes: BenchNodes) -> str:
    """End the RIB; return its configuration."""
    process = nodes.running.pop(("rib", "s1"))
    with process:
        process.finish(signal.SIGTERM, PATIENCE_S)
    return str(nodes.credentials.file("rib", "s1"))


def test_keepalives_wake_no_end_of_a_link_to_receive_them(nodes: BenchNodes) -> None:
    file = end_rib(nodes)
    for role, config in (("rib", file), ("proxy", recorder(nodes))):
        _, node = start(nodes, role, config)
        with closing(node):
            wait_for_kernel(node, role)


def test_an_end_that_may_load_no_program_receives_them_itself(nodes: BenchNodes) -> None:
    _, node = start(nodes, "rib", end_rib(nodes), *NO_BPF)
    with closing(node):
        until(lambda: came(node) > KEEPALIVES / 2, "keepalives of the RIB in its process", PATIENCE_S)


def test_a_frozen_end_is_lost_and_comes_back(nodes: BenchNodes) -> None:
    process, node = start(nodes, "rib", end_rib(nodes))
    with closing(node), closing(NodeConnection(find_control_socket(nodes.files / "nodes" / "switch-s1"))) as switch:
        wait_for_kernel(node, "rib")
        process.send(signal.SIGSTOP)
        until(lambda: switch.status()["neighbours"] == 0, "the loss of a frozen RIB", PATIENCE_S)
        process.send(signal.SIGCONT)
        until(lambda: switch.status()["neighbours"] == 1, "the return of the RIB", PATIENCE_S)
        wait_for_kernel(node, "rib")
