"""Roaming through real tunnels: a reliable topic and a running call go on while a robot changes its uplink."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field

import pytest

import gdp
from gdp.trust.right import Right
from internet.access import Access
from internet.flow import open_sessions
from internet.host import Host
from internet.laboratory import Laboratory
from internet.overlay import Overlay
from internet.site import Site
from lab.process import until
from netns_tests.lifetimes import LEASE_S

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about tunnels, no lease of a name matters"),
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="wireguard-go needs root for its control socket"),
]

TOPIC, SERVICE = "flow", "plan"
PATIENCE_S = 60.0
OUTAGE_S = 10.0  # longer than the timers of neighbours, trees and readers
RATE = 100  # messages a second
UNREAD = round(4 * OUTAGE_S * RATE)  # the test does not read during the outage


@dataclass(slots=True)
class Field:
    """A robot that publishes and calls, and a server behind another NAT, which know one border only."""

    laboratory: Laboratory
    overlay: Overlay
    border: Host
    robot: Host
    caller: gdp.Session
    publisher: gdp.Publisher
    subscription: gdp.Subscription
    requests: list[bytes] = field(default_factory=list)
    release: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)
    published: int = 0
    read: list[int] = field(default_factory=list)

    def serve(self, request: gdp.Request) -> bytes:
        """Answer when the test says so."""
        self.requests.append(request.payload)
        self.release.wait(PATIENCE_S)
        return request.payload

    def publish(self) -> None:
        """Publish numbers at a rate until the end."""
        while not self.over.wait(1 / RATE):
            self.publisher.put(self.published.to_bytes(8, "big"))
            self.published += 1

    def read_until(self, number: int) -> None:
        """Read until a number came."""
        while number not in self.read[-1:]:
            message = self.subscription.receive(timeout_s=PATIENCE_S)
            self.read.append(int.from_bytes(message.payload, "big"))

    def has_tunnels(self, *to: str) -> bool:
        """Return whether the robot's tunnels to these switches are up."""
        found = self.overlay.tunnels(self.robot)
        return all(found.get(each, {}).get("up") for each in to)

    def wait_for_tunnels(self, *to: str) -> None:
        """Return when the robot's tunnels to these switches are up."""
        until(lambda: self.has_tunnels(*to), f"tunnels to {to}", PATIENCE_S, self.read_one_more)

    def read_one_more(self) -> None:
        """Read until a message comes that was published from now on."""
        self.read_until(self.published)


@pytest.fixture
def roamer(laboratory: Laboratory, request: pytest.FixtureRequest) -> Iterator[Field]:
    """Yield the robot and the server, between which messages flow; a parameter is the lease of their names."""
    lease_s = getattr(request, "param", None)
    robot = laboratory.add_host("robot", laboratory.add_site("home", Access.PORT_RESTRICTED))
    rights = {TOPIC: [Right.PUBLISH], SERVICE: [Right.CALL]}, {TOPIC: [Right.READ], SERVICE: [Right.SERVE]}
    with ExitStack() as stack:
        overlay, _, (caller, callee) = open_sessions(robot, stack, rights, lease_s=lease_s)
        subscription = callee.subscribe(TOPIC, queue=UNREAD)
        publisher = caller.publisher(TOPIC)
        made = Field(laboratory, overlay, laboratory.hosts["border"], robot, caller, publisher, subscription)
        callee.serve(SERVICE, made.serve)
        made.publisher.wait_for_readers(timeout_s=PATIENCE_S)
        publishing = threading.Thread(target=made.publish)
        publishing.start()
        try:
            made.read_one_more()
            yield made
        finally:
            made.release.set()
            made.over.set()
            publishing.join(PATIENCE_S)


def test_a_running_call_and_a_topic_outlive_changes_of_the_address_and_a_dead_access_point(roamer: Field) -> None:
    robot, home = roamer.robot, roamer.robot.site()
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(roamer.caller.call, SERVICE, b"a long plan", timeout_s=3 * PATIENCE_S)
        for change in (robot.renumber, home.renumber, lambda: robot.attach(_cafe(roamer))):
            change()
            roamer.read_one_more()
        cafe = robot.site()
        cafe.power_off()
        time.sleep(OUTAGE_S)  # the outage itself
        cafe.power_on()
        roamer.read_one_more()
        assert not call.done()
        roamer.release.set()
        assert call.result(PATIENCE_S).payload == b"a long plan"
    _check_end(roamer)
    assert roamer.requests == [b"a long plan"]


@pytest.mark.nightly
@pytest.mark.parametrize("roamer", [LEASE_S], indirect=True)
def test_a_topic_and_calls_over_a_direct_tunnel_outlive_a_killed_border(roamer: Field) -> None:
    roamer.release.set()
    roamer.wait_for_tunnels("border", "server")
    roamer.caller.call(SERVICE, b"finds the server", timeout_s=PATIENCE_S)
    roamer.overlay.kill(roamer.border)
    requests, end_s = [b"finds the server"], time.monotonic() + OUTAGE_S
    while time.monotonic() < end_s:
        requests.append(b"%d" % len(requests))
        assert roamer.caller.call(SERVICE, requests[-1], timeout_s=PATIENCE_S).payload == requests[-1]
        roamer.read_one_more()
        assert roamer.has_tunnels("server")
    assert not roamer.has_tunnels("border")
    roamer.overlay.start(roamer.border)
    roamer.wait_for_tunnels("border", "server")
    _check_end(roamer)
    assert roamer.requests == requests


@pytest.mark.nightly
@pytest.mark.parametrize("roamer", [LEASE_S], indirect=True)
def test_a_direct_tunnel_that_an_uplink_cut_ends_comes_back_without_the_border(roamer: Field) -> None:
    roamer.wait_for_tunnels("border", "server")
    roamer.overlay.kill(roamer.border)
    home = roamer.robot.site()
    while roamer.has_tunnels("border"):
        roamer.read_one_more()
    home.cut()
    time.sleep(OUTAGE_S)  # the outage itself
    home.restore()
    roamer.read_one_more()
    _check_end(roamer)


def _check_end(roamer: Field) -> None:
    """Stop publishing, and check that nothing was lost, and nothing came twice."""
    roamer.over.set()
    roamer.read_until(roamer.published - 1)
    assert (roamer.subscription.lost, roamer.subscription.dropped) == (0, 0)
    assert roamer.read == list(range(len(roamer.read)))


def _cafe(roamer: Field) -> Site:
    return roamer.laboratory.add_site("cafe", Access.SYMMETRIC)
