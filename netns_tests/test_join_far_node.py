"""Machines that have just joined: how soon the first far node is in the graph of one that starts again."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import datetime
from typing import Final

import pytest

from lab.internet.access import Access
from lab.internet.fresh_machine import FreshMachine
from lab.internet.laboratory import Laboratory
from lab.process import LabProcess, until
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs")
pytestmark = [pytest.mark.netns, pytest.mark.nightly, pytest.mark.momentary("about a beginning, no lease matters")]

FIRST_S: Final = 2.0  # from the moment when the tunnel stands
PATIENCE_S: Final = 120.0
NODE: Final = "far_talker"
SITES: Final = {"border": Access.PUBLIC, "robot": Access.PORT_RESTRICTED, "server": Access.PORT_RESTRICTED}
UP: Final = "tunnels are up"
_STANDS: Final = r"neighbour up port=g\S+ role=switch"
_WATCH = """
import threading, time
shown = []
def watch():
    before = False
    while True:
        now = 'far_talker' in node.get_node_names()
        if now != before:
            shown.append([now, time.time()])
        before = now
        time.sleep(0.01)
threading.Thread(target=watch, daemon=True).start()
"""


class Internet:
    """A border, a robot and a server behind NATs, all fresh, with a real node at the last two."""

    def __init__(self, laboratory: Laboratory, stack: ExitStack) -> None:
        self.machines: dict[str, FreshMachine] = {}
        for label, access in SITES.items():
            host = laboratory.add_host(label, laboratory.add_site(f"at-{label}", access))
            self.machines[label] = stack.enter_context(FreshMachine(host, laboratory.run.directory))
        address = self.machines["border"].host.lease().address.partition("/")[0]
        border = self.type("border", f"gdp domain create lab --public {address} --tokens 2")
        border.until_logged("listening on TCP port", patience_s=PATIENCE_S)
        self.joined: dict[str, LabProcess] = {}
        tokens = re.findall(r"^gdp1\S+$", border.logged, re.MULTILINE)
        for label, token in zip(("robot", "server"), tokens, strict=True):
            self.joined[label] = self.type(label, f"gdp join --label {label}", token)
            self.joined[label].until_logged(UP, patience_s=PATIENCE_S)
        self.talker, self.watcher = (
            self.node(stack, label, name) for label, name in (("robot", NODE), ("server", "here"))
        )
        self.watcher.tell("!" + _WATCH)

    def type(self, label: str, command: str, answer: str = "") -> LabProcess:
        """Type a command on a machine."""
        return self.machines[label].type(command, answer)

    def node(self, stack: ExitStack, label: str, name: str) -> Peer:
        """Start a node on a machine."""
        made = Peer(name, self.machines[label]._enter, {"ROS_DOMAIN_ID": "0"})
        stack.callback(made.end)
        return made

    def changes(self) -> list[tuple[bool, float]]:
        """Return when the far node appeared at the server, and disappeared, in Unix seconds."""
        found = self.watcher.tell("shown")
        assert isinstance(found, list)
        return [(bool(is_there), float(at_s)) for is_there, at_s in found]

    def until_changed(self, count: int) -> float:
        """Return the second of the last of so many changes."""
        until(lambda: len(self.changes()) >= count, lambda: f"{self.changes()}", PATIENCE_S)
        return self.changes()[count - 1][1]


@pytest.fixture
def internet(laboratory: Laboratory) -> Iterator[Internet]:
    with ExitStack() as stack:
        yield Internet(laboratory, stack)


def logged_s(line: str) -> float:
    """Return the Unix second at which a line was logged."""
    (stamp,) = re.findall(r"\| (\S+ \S+) INFO", line)
    return datetime.strptime(stamp, "%Y-%m-%d %H:%M:%S,%f").timestamp()


def test_the_first_far_node_is_there_soon_after_the_tunnel_stands(internet: Internet) -> None:
    internet.type("robot", f"gdp expose --node /{NODE} --to server").output(PATIENCE_S)
    internet.type("server", f"gdp import /{NODE} --from robot").output(PATIENCE_S)
    typed_s = time.time()
    took_s = internet.until_changed(1) - typed_s
    internet.joined["server"].finish()
    internet.until_changed(2)
    again = internet.type("server", "gdp up /var/lib/gdp/lab")
    stands_s = logged_s(again.until_logged(_STANDS, patience_s=PATIENCE_S))
    shown_s = internet.until_changed(3) - stands_s
    print(f"after gdp import {took_s:.2f} s; after the tunnel {shown_s:.2f} s")
    assert shown_s <= FIRST_S
