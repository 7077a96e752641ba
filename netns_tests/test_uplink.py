"""Robot's thin uplink, which carries one copy of a request for any number of replicas: real switches and counters.

::

    [robot] ---- [gateway, RIB] ---- [r0]  [r1]  [r2]           one replica at each of r0 to r2
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Final

import pytest
from pyroute2 import IPRoute

from gdp.crypto.certificates import Role
from gdp.host.run_registry import Run
from gdp.metadata import Metadata
from gdp.stores.keyring import ROOT_CERTIFICATE
from gdp.trust.right import Right
from lab.credentials import OverlayCredentials
from lab.machine import LabMachine
from lab.namespaces import Namespaces
from lab.process import LabProcess, calling, new_run
from lab.topology import Attachment, DomainPlan, Link, Topology
from netns_tests import uplink_child

pytestmark = pytest.mark.netns

REPLICAS: Final = ("r0", "r1", "r2")
PATIENCE_S: Final = 60.0
REQUESTS, BYTES = 100, 10_000
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
        self._spaces = Namespaces(TOPOLOGY, run)
        self._machines = {
            name: undo.enter_context(LabMachine(run.directory, self._spaces[name].command([]), run=run))
            for name in TOPOLOGY.nodes
        }
        self._starting: list[LabProcess] = []
        self._credentials = OverlayCredentials(TOPOLOGY, run.directory)
        configs = {name: self._credentials.switch(name, "auto") for name in TOPOLOGY.nodes}
        nodes = [self._machines[name].launch_node("switch", config.stem) for name, config in configs.items()]
        for node in nodes:
            self._machines["gateway"].ready(node)
        (rib,) = TOPOLOGY.attached("rib")
        self._machines[rib.switch].start("rib", self._credentials.rib(rib).stem)

    def wait(self) -> None:
        """Return when all started participants are up."""
        for process in self._starting:
            assert process.read_line(PATIENCE_S) == b"up"
        self._starting.clear()

    def member(self, switch: str, right: Right, *load: int) -> LabProcess:
        """Start a participant at a switch without waiting for it."""
        credentials = self._credentials
        credentials.delegate(switch, SERVICE, right)
        root = credentials.domain("field") / ROOT_CERTIFICATE
        where = (credentials.identity(Role.PROXY, switch), root, "member")
        argv = calling(uplink_child.main, *where, right.value, *load)
        self._starting.append(self._machines[switch].launch(argv, f"member-{switch}", has_orders=right is Right.CALL))
        return self._starting[-1]

    def sent_bytes(self) -> int:
        """Return the traffic of the robot's uplink at its far end; a frame the kernel forwards bypasses our end."""

        def look() -> int:
            with IPRoute() as ipr:
                (link,) = ipr.get_links(ifname="robot")
                return int(link.get_attr("IFLA_STATS64")["rx_bytes"])

        return self._spaces["gateway"].inside(look)


def tell(robot: LabProcess, word: object) -> None:
    """Send the robot a command; return when it is done."""
    robot.tell(word=word)
    assert robot.read_line(PATIENCE_S) == b"done"


@pytest.fixture
def field() -> Iterator[Field]:
    with new_run() as run, ExitStack() as undo:
        yield Field(run, undo)


def test_one_copy_of_a_request_leaves_the_robot_whatever_the_number_of_replicas(field: Field) -> None:
    robot = field.member("robot", Right.CALL, REQUESTS, BYTES)
    sent: dict[int, int] = {}
    started = 0
    for replicas in (1, 3):
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
    assert max(sent.values()) < 1.1 * min(sent.values()), sent  # a busy machine repairs what only waits for a processor
