"""Robot's thin uplink, which carries one copy of a request for any number of replicas: real switches and counters.

::

    [robot] ---- [gateway, RIB] ---- [r0]  [r1]  [r2]  [r3]           one replica at each of r0 to r3
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Final

import pytest
from pyroute2 import IPRoute

from gdp.crypto.certificates import Role
from gdp.host.run_registry import Run, RunRegistry
from gdp.metadata import Metadata
from gdp.stores.keyring import ROOT_CERTIFICATE
from gdp.trust.right import Right
from lab.credentials import OverlayCredentials
from lab.namespaces import Namespaces
from lab.process import LabProcess
from lab.topology import Attachment, DomainPlan, Link, Topology

pytestmark = pytest.mark.netns

REPLICAS: Final = ("r0", "r1", "r2", "r3")
PATIENCE_S: Final = 60.0
REQUESTS, BYTES = 200, 10_000
PARTS, MTU_BYTES, OVERHEAD_BYTES = 8, 1_500, 14 + 96  # Ethernet and our header, in each part
SERVICE: Final = Metadata({"kind": "service", "name": "/plan", "type": "std_srvs/srv/SetBool"})
TOPOLOGY: Final = Topology(
    links=(Link("robot", "gateway"), *(Link("gateway", name) for name in REPLICAS)),
    domains=(DomainPlan("field", ("robot", "gateway", *REPLICAS)),),
    attachments=(
        Attachment("gateway", "rib", "rib"),
        *(Attachment(name, "proxy", "member") for name in ("robot", *REPLICAS)),
    ),
)


class Field:
    """Running processes: switches and the RIB from the start, participants on request."""

    def __init__(self, run: Run, undo: ExitStack) -> None:
        self._folder = run.directory
        self._run = run
        self._undo = undo
        self._spaces = Namespaces(TOPOLOGY, run)
        self._starting: list[LabProcess] = []
        self._credentials = OverlayCredentials(TOPOLOGY, self._folder)
        for name in TOPOLOGY.nodes:
            self._start(name, ["gdp.cli.switch", "--config", str(self._credentials.switch(name, "auto"))])
        self.wait()
        (rib,) = TOPOLOGY.attached("rib")
        self._start(rib.switch, ["gdp.cli.rib", "--config", str(self._credentials.rib(rib))])

    def wait(self) -> None:
        """Return when all started participants are up."""
        for process in self._starting:
            assert b"up" in process.read_line(PATIENCE_S)
        self._starting.clear()

    def member(self, switch: str, right: Right, *load: int) -> LabProcess:
        """Start a participant at a switch without waiting for it."""
        credentials = self._credentials
        name = credentials.delegate(switch, SERVICE, right).to_text()
        root = credentials.domain("field") / ROOT_CERTIFICATE
        where = [name, str(credentials.identity(Role.PROXY, switch)), str(root), "member"]
        return self._start(switch, ["netns_tests.uplink_child", *where, right.value, *map(str, load)])

    def sent_bytes(self) -> int:
        """Return the traffic of the robot's uplink at its far end; a frame the kernel forwards bypasses our end."""

        def look() -> int:
            with IPRoute() as ipr:
                (link,) = ipr.get_links(ifname="robot")
                return int(link.get_attr("IFLA_STATS64")["rx_bytes"])

        return self._spaces["gateway"].inside(look)

    def _start(self, switch: str, argv: list[str]) -> LabProcess:
        words = self._spaces[switch].command([sys.executable, "-m", *argv])
        process = LabProcess(self._run, f"{argv[0]} {switch}", words, has_orders=True)
        self._undo.callback(process.kill_group)
        self._starting.append(process)
        return process


def tell(robot: LabProcess, word: object) -> None:
    """Send the robot a command; return when it is done."""
    robot.tell(word=word)
    assert robot.read_line(PATIENCE_S) == b"done"


@pytest.fixture
def field() -> Iterator[Field]:
    run = RunRegistry().start()
    with ExitStack() as undo:
        undo.callback(run.end)
        yield Field(run, undo)


def test_one_copy_of_a_request_leaves_the_robot_whatever_the_number_of_replicas(field: Field) -> None:
    robot = field.member("robot", Right.CALL, REQUESTS, BYTES)
    sent: dict[int, int] = {}
    started = 0
    for replicas in (1, 2, 4):
        for name in REPLICAS[started:replicas]:
            field.member(name, Right.SERVE)
        field.wait()
        started = replicas
        tell(robot, replicas)
        before = field.sent_bytes()
        tell(robot, "go")
        sent[replicas] = field.sent_bytes() - before
    once = REQUESTS * (BYTES + PARTS * OVERHEAD_BYTES)
    assert all(once < each < 1.15 * once for each in sent.values()), sent
    assert max(sent.values()) < 1.05 * min(sent.values()), sent
    before = field.sent_bytes()
    tell(robot, "ask")
    assert field.sent_bytes() - before < 1.15 * once
