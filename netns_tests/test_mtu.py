"""Frame size on real links: it follows their MTU in operation, and nothing sent after a change is lost.

::

    robot r0 -- r1 [first] a0 -- a1 [second] e1 -- e0 server          b0 -- b1: the RIB at the second switch
"""

from __future__ import annotations

import os
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing

import pytest

from gdp.client.participant import Participant, Topic
from gdp.client.rib_host import RibHost
from gdp.control.hello import NodeSettings
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.envelope import SIGNATURE_BYTES, fragment_capacity
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.limits import MTU_MIN_BYTES
from gdp.metadata import Metadata
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.plane import MAC_BYTES, Plane
from gdp.ports.raw import RawPlane
from gdp.ports.scapy_plane import ScapyPlane
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.runtime.runtime import Runtime
from gdp.sansio import NodeCore
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.trust.domain import Policy
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.owner import Owner
from gdp.trust.right import Right
from lab.namespaces import Space
from lab.process import until
from netns_tests.test_planes import BURST, changes, far_end, poll_until
from tests.fixtures_forwarding import frame

pytestmark = pytest.mark.netns

LINKS = (("r0", "r1"), ("a0", "a1"), ("e0", "e1"), ("b0", "b1"))
WIDEST, USUAL, JUMBO = 65_000, 1_500, 9_000
MEGABYTE = 1_000_000
PATIENCE_S = 20.0  # limit of a test; the awaited event comes at once
STEP_S = 0.002
RECEIVE_BYTES = 1 << 26
SO_RCVBUFFORCE = 33


def mac_of(ifname: str) -> bytes:
    return b"\x02\x00\x00\x00" + ifname.encode()


class Lab:
    """Two switches, a RIB, a robot and a server on real devices of one namespace, stepped by one thread.

    Attributes:
        heard: the sizes that the robot's publisher received, in order.
    """

    def __init__(self, space: Space) -> None:
        for number, (one, other) in enumerate(LINKS):
            space.veth(one, other, mac_of(one), mac_of(other), USUAL if number == 1 else WIDEST)
        self.space = space
        second = int(time.time())
        self._validity = Validity(second - 3_600, second + 3_600)
        self._authority = CertificateAuthority.create("lab", SigningKey.generate(), self._validity)
        self._policy = Policy(self._authority.root, [self._authority.root])
        self._owner = Owner(SigningKey.generate(), secrets.token_bytes(32))
        self._runtimes: list[Runtime] = []
        self.planes: list[Plane] = []
        self.heard: list[int] = []
        self._add_switch("first", "r1", "a0")
        self._add_switch("second", "a1", "e1", "b1")
        rib = self._identity(Role.RIB, "rib")
        self._run(
            RibHost(rib, self._policy, RibCore(rib, self._policy, MemoryStore(), RibSettings()), settings()), "b0"
        )
        self._robot, robot = self._add_member("robot", "r0")
        self._server, server = self._add_member("server", "e0")
        self.publisher = self._robot.advertise(self._topic(robot, Right.PUBLISH), b"described", reliable=True)
        self._server.subscribe(self._topic(server, Right.READ))

    def until(self, done: Callable[[], bool]) -> None:
        """Step everything until a condition holds."""

        def step() -> None:
            now_s = time.monotonic()
            for runtime in self._runtimes[:-1]:
                runtime.step(now_s)
            self._runtimes[-1].step(now_s + STEP_S)

        until(done, meanwhile=step)

    def publish(self, message: bytes) -> None:
        """Publish now."""
        self.publisher.publish(message)
        self._robot.flush(time.monotonic())

    def received(self, count: int) -> list[bytes]:
        """Return the next messages that the server gets."""
        got: list[bytes] = []

        def is_enough() -> bool:
            got.extend(each.delivered.message for each in self._server.poll_messages())
            return len(got) >= count

        self.until(is_enough)
        return got

    def resize(self, mtu: int, ifnames: Sequence[str], reported: int) -> None:
        """Change devices; return when the publisher has received the new size."""
        for ifname in ifnames:
            self.space.ip("link", "set", ifname, "mtu", str(mtu))
        self.until(lambda: self.heard[-1] == reported)

    def crosses_in(self, message: bytes) -> tuple[int, int]:
        """Send a message; return its largest frame on the middle link, without Ethernet header, and how many."""
        with closing(far_end("a1")) as tap:
            tap.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BYTES)
            self.publish(message)
            assert self.received(1) == [message]
            sizes = [
                len(frame) - ETHER_BYTES for frame in frames_of(tap) if decode(frame, ETHER_BYTES).kind == Kind.DATA
            ]
        return max(sizes), len(sizes)

    def drops(self) -> int:
        """Return how many frames the planes dropped as too big."""
        return sum(plane.counters.drops[DropReason.TOO_BIG] for plane in self.planes)

    def close(self) -> None:
        """Close every socket."""
        for plane in self.planes:
            plane.close()

    def _identity(self, role: Role, label: str) -> Identity:
        return NodeKeys.generate(role, label).join(self._authority, self._validity)

    def _add_switch(self, label: str, *ifnames: str) -> None:
        table = Table()
        self._run(
            SwitchCore(self._identity(Role.SWITCH, label), self._policy, table, settings()), *ifnames, table=table
        )

    def _add_member(self, label: str, ifname: str) -> tuple[Participant, Identity]:
        identity = self._identity(Role.PROXY, label)
        member = Participant(identity, self._policy, settings())
        self._run(member, ifname)
        return member, identity

    def _run(self, machine: NodeCore, *ifnames: str, table: Table | None = None) -> None:
        self.planes.append(RawPlane(ifnames, table))
        self._runtimes.append(Runtime(machine, self.planes[-1]))

    def _topic(self, identity: Identity, right: Right) -> Topic:
        card = NodeDescriptor.from_wire(NodeDescriptor.make(identity))
        metadata = Metadata({"kind": "topic", "name": "/image"})
        delegation = self._owner.delegate(card, metadata, [right], [1], self._validity)
        return Topic(delegation, {epoch: grant.secret for epoch, grant in delegation.open(identity).items()})


def settings() -> NodeSettings:
    return NodeSettings(
        incarnation=secrets.randbits(64), first_sequence=int(time.time() * 1_000), random_bytes=secrets.token_bytes
    )


def frames_of(tap: socket.socket) -> Iterator[bytes]:
    """Yield the frames that a socket holds."""
    tap.setblocking(False)
    while True:
        try:
            yield tap.recv(1 << 16)
        except BlockingIOError:
            return


@pytest.fixture
def lab(space: Space, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    """Running nodes with a reader that the publisher knows."""
    with closing(Lab(space)) as made:
        tell = made.publisher.tree_stands

        def note(mtu: int) -> bool:
            made.heard.append(mtu)
            return tell(mtu)

        monkeypatch.setattr(made.publisher, "tree_stands", note)
        made.until(lambda: made.publisher.readers > 0)
        yield made


def test_a_megabyte_crosses_in_frames_that_follow_the_link_while_it_runs(lab: Lab) -> None:
    seen = []
    for mtu in (USUAL, JUMBO, WIDEST, 1_200, MTU_MIN_BYTES, USUAL):
        lab.resize(mtu, ("a0", "a1"), mtu)
        seen.append(lab.crosses_in(os.urandom(MEGABYTE)))
    for mtu, (largest, count) in zip((USUAL, JUMBO, WIDEST, 1_200, MTU_MIN_BYTES, USUAL), seen, strict=True):
        assert largest == mtu
        assert count >= -(-(MEGABYTE + SIGNATURE_BYTES) // fragment_capacity(mtu))
    assert lab.drops() == 0


@pytest.mark.parametrize("ifname", ["a0", "a1", "r0", "r1", "e0", "e1"])
def test_one_end_that_becomes_narrow_is_enough(lab: Lab, ifname: str) -> None:
    lab.resize(1_200, (ifname,), 1_200)
    assert lab.crosses_in(os.urandom(MEGABYTE))[0] == 1_200
    lab.resize(WIDEST if ifname[0] != "a" else USUAL, (ifname,), USUAL)
    assert lab.crosses_in(os.urandom(MEGABYTE))[0] == USUAL


def test_a_stream_under_which_the_link_changes_loses_nothing(lab: Lab) -> None:
    lab.resize(JUMBO, ("a0", "a1"), JUMBO)
    messages = [os.urandom(200_000) for _ in range(30)]
    got: list[bytes] = []
    for at, mtu in enumerate((USUAL, WIDEST, 1_200)):
        for message in messages[at * 10 : at * 10 + 10]:
            lab.publish(message)
        lab.resize(mtu, ("a0", "a1"), mtu)
        got += lab.received(10)
    assert got == messages


def test_a_link_too_narrow_for_any_node_is_down_until_it_is_wider_again(lab: Lab) -> None:
    for ifname in ("a0", "a1"):
        lab.space.ip("link", "set", ifname, "mtu", str(MTU_MIN_BYTES - 1))
    lab.until(lambda: not lab.planes[0].ports[1].up)
    lab.resize(JUMBO, ("a0", "a1"), JUMBO)
    assert lab.crosses_in(os.urandom(MEGABYTE))[0] == JUMBO


PLANES = pytest.mark.parametrize("make", [RawPlane, ScapyPlane, KernelPlane])


@PLANES
def test_a_port_tells_of_another_mtu(make: type[RawPlane] | type[ScapyPlane], space: Space) -> None:
    space.veth("p0", "q0", mac_of("p0"), mac_of("q0"))
    with closing(make(["p0"])) as plane:
        heard = changes(plane)
        for mtu in (JUMBO, 1_200):
            space.ip("link", "set", "p0", "mtu", str(mtu))
            poll_until(plane, lambda mtu=mtu: plane.ports[0].mtu == mtu)  # type: ignore[misc]
        assert heard == [(0, True), (0, True)]


@PLANES
def test_what_waits_at_a_port_while_its_mtu_changes_is_not_lost(
    make: type[RawPlane] | type[ScapyPlane], space: Space
) -> None:
    space.veth("p0", "q0", mac_of("p0"), mac_of("q0"))
    with closing(make(["p0"])) as plane, closing(far_end("q0")) as end:
        for mtu in (JUMBO, 1_200):
            sent = [frame(bytes(32), bytes([number])) for number in range(BURST)]
            for each in sent:
                end.send(mac_of("p0") + each[MAC_BYTES:])
            space.ip("link", "set", "p0", "mtu", str(mtu))
            arrivals = poll_until(plane, lambda mtu=mtu: plane.ports[0].mtu == mtu)  # type: ignore[misc]
            while len(arrivals) < BURST and (more := plane.poll(0)):
                arrivals += more
            assert [arrival.frame for arrival in arrivals] == [each[ETHER_BYTES:] for each in sent]


@PLANES
def test_a_port_with_another_address_is_another_port(make: type[RawPlane] | type[ScapyPlane], space: Space) -> None:
    space.veth("p0", "q0", mac_of("p0"), mac_of("q0"))
    with closing(make(["p0"])) as plane:
        heard = changes(plane)
        space.ip("link", "set", "p0", "address", mac_of("z0").hex(":"))
        poll_until(plane, lambda: plane.ports[0].mac == mac_of("z0"))
        assert heard == [(0, False), (0, True)]


def test_a_switch_with_another_address_is_found_again(lab: Lab) -> None:
    lab.space.ip("link", "set", "a0", "address", mac_of("z0").hex(":"))
    lab.until(lambda: lab.planes[0].ports[1].mac == mac_of("z0"))
    message = os.urandom(MEGABYTE)
    lab.publish(message)
    assert lab.received(1) == [message]
