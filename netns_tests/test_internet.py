"""Laboratory of networks: each kind of access maps, filters and loses what it claims, by UDP between real sockets."""

from __future__ import annotations

import secrets
import select
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

from gdp.control.endpoints import Endpoint
from gdp.host.run_registry import RunRegistry
from gdp.ports.sockets import large_buffers
from internet.access import TRAITS, Access
from internet.host import ETHERNET, Host
from internet.laboratory import Laboratory
from lab.machine import LabMachine
from lab.process import calling

pytestmark = pytest.mark.netns

NATS = (Access.FULL_CONE, Access.PORT_RESTRICTED, Access.SYMMETRIC, Access.DOUBLE_NAT)
PATIENCE_S = 10.0
PROBED_S = 5.0
SILENCE_S = 0.3  # after which a datagram that is expected to be lost counts as lost
TOKEN_BYTES, DATAGRAM_BYTES = 8, 2_048


class UdpProbe:
    """A UDP socket on a host; a context manager that closes it.

    Args:
        version: of IP, 4 or 6.
        port: 0: any.
        device: the only one to send and receive by (SO_BINDTODEVICE); by default routing decides.

    Attributes:
        local: address of the host's device, and the port.
        sources: source of each datagram that came in, by its content.
    """

    def __init__(self, host: Host, version: int = 4, port: int = 0, *, device: str = "") -> None:
        family = socket.AF_INET if version == 4 else socket.AF_INET6
        self._socket = host.space.inside(lambda: socket.socket(family, socket.SOCK_DGRAM))
        self._socket.setblocking(False)
        large_buffers(self._socket)
        self._socket.bind(("", port))
        if device:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())
        lease = host.lease(device or host.devices[0])
        address = (lease.address if version == 4 else lease.address6).partition("/")[0]
        self.local = Endpoint(address, self._socket.getsockname()[1])
        self.sources: dict[bytes, Endpoint] = {}

    def __enter__(self) -> UdpProbe:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def fileno(self) -> int:
        """Return the descriptor of the socket."""
        return self._socket.fileno()

    def send(self, to: Endpoint, content: bytes) -> bool:
        """Send a datagram; return whether the host has a route."""
        try:
            self._socket.sendto(content, to)
        except OSError:  # unreachable, or an ICMP error of an earlier datagram
            return False
        return True

    def receive(self) -> None:
        """Take the datagrams that wait into ``sources``."""
        while True:
            try:
                content, source = self._socket.recvfrom(DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except OSError:  # an ICMP error, cleared by this call
                continue
            self.sources[content] = Endpoint(source[0], source[1])

    def wait(self, content: bytes, timeout_s: float = SILENCE_S) -> Endpoint | None:
        """Return the source of a datagram with this content; None: none comes in time."""
        deadline_s = time.monotonic() + timeout_s
        while content not in self.sources:
            if not select.select([self], (), (), max(deadline_s - time.monotonic(), 0.0))[0]:
                return None
            self.receive()
        return self.sources[content]


def observe(
    sender: UdpProbe, receiver: UdpProbe, to: Endpoint | None = None, *, timeout_s: float = PROBED_S
) -> Endpoint | None:
    """Send a datagram and return the source that the receiver sees; None: it does not arrive in time.

    ``to``: destination; by default the receiver's own address.
    """
    token = secrets.token_bytes(TOKEN_BYTES)
    sender.send(to or receiver.local, token)
    return receiver.wait(token, timeout_s)


class Internet:
    """A laboratory with two hosts of public addresses."""

    def __init__(self, laboratory: Laboratory) -> None:
        self.laboratory = laboratory
        site = laboratory.add_site("dc", Access.PUBLIC)
        self.borders = laboratory.add_host("border1", site), laboratory.add_host("border2", site)

    def attach(self, access: Access, label: str = "robot", **options: float) -> Host:
        """Attach a host by a site of its own."""
        return self.laboratory.add_host(label, self.laboratory.add_site(f"of-{label}", access, **options))


@pytest.fixture
def net(laboratory: Laboratory) -> Internet:
    return Internet(laboratory)


@pytest.mark.parametrize("access", NATS, ids=lambda each: each.value)
def test_a_nat_maps_a_socket_to_one_endpoint_unless_it_is_symmetric(net: Internet, access: Access) -> None:
    robot = net.attach(access)
    with (
        UdpProbe(robot) as probe,
        UdpProbe(net.borders[0]) as a,
        UdpProbe(net.borders[0]) as b,
        UdpProbe(net.borders[1]) as c,
    ):
        seen = [observe(probe, each) for each in (a, b, c)]
    assert {each.address for each in seen if each} == {robot.site().address}
    assert (len(set(seen)) == 1) is TRAITS[access].is_mapping_stable
    assert len(set(seen)) in (1, 3)


@pytest.mark.parametrize(
    "access",
    [
        Access.FULL_CONE,
        Access.SYMMETRIC,
        *(pytest.param(each, marks=pytest.mark.nightly) for each in (Access.PORT_RESTRICTED, Access.DOUBLE_NAT)),
    ],
    ids=lambda each: each.value,
)
def test_a_nat_lets_in_whom_the_socket_wrote_to_and_a_full_cone_lets_in_all(net: Internet, access: Access) -> None:
    robot = net.attach(access)
    with (
        UdpProbe(robot) as probe,
        UdpProbe(net.borders[0]) as known,
        UdpProbe(net.borders[0]) as port,
        UdpProbe(net.borders[1]) as stranger,
    ):
        public = observe(probe, known)
        assert public is not None
        arrived = [observe(each, probe, public, timeout_s=1.0) is not None for each in (stranger, port, known)]
    assert arrived == [not TRAITS[access].is_filtering, not TRAITS[access].is_filtering, True]


@pytest.mark.nightly
def test_a_full_cone_has_no_mapping_for_a_socket_that_never_sent(net: Internet) -> None:
    robot = net.attach(Access.FULL_CONE)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as stranger:
        assert observe(stranger, probe, Endpoint(robot.site().address, probe.local.port)) is None


def test_where_udp_is_blocked_only_tcp_to_port_443_passes(net: Internet) -> None:
    robot = net.attach(Access.UDP_BLOCKED)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0], port=443) as border:
        assert observe(probe, border, timeout_s=SILENCE_S) is None
    assert connects(robot, net.borders[0], 443)
    assert not connects(robot, net.borders[0], 80, 0.5)


def connects(client: Host, server: Host, port: int, timeout_s: float = 5.0) -> bool:
    """Return whether a TCP connection is made."""
    with server.space.inside(socket.socket) as listener, client.space.inside(socket.socket) as caller:
        listener.bind(("", port))
        listener.listen()
        caller.settimeout(timeout_s)
        try:
            caller.connect((server.lease().address.partition("/")[0], port))
        except TimeoutError:
            return False
        return True


def test_an_ipv6_only_host_shows_its_own_address_and_lets_no_stranger_in(net: Internet) -> None:
    robot = net.attach(Access.IPV6_ONLY)
    assert not robot.lease().has(4)
    with UdpProbe(robot, 6) as probe, UdpProbe(net.borders[0], 6) as border, UdpProbe(net.borders[1], 6) as stranger:
        assert observe(stranger, probe, timeout_s=SILENCE_S) is None
        assert observe(probe, border) == probe.local
        assert observe(border, probe) == border.local


def test_a_public_host_is_reached_by_a_stranger_over_both_ip_versions(net: Internet) -> None:
    one, other = (net.attach(Access.PUBLIC, label) for label in ("one", "other"))
    for version in (4, 6):
        with UdpProbe(one, version) as a, UdpProbe(other, version) as b:
            assert observe(a, b) == a.local


@pytest.mark.nightly
@pytest.mark.parametrize("access", [Access.FULL_CONE, Access.DOUBLE_NAT], ids=lambda each: each.value)
def test_a_nat_that_forgets_its_mappings_lets_its_peer_in_after_the_next_datagram_from_inside(
    net: Internet, access: Access
) -> None:
    robot = net.attach(access)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        before = observe(probe, border)
        robot.site().flush_mappings()
        assert observe(border, probe, before, timeout_s=SILENCE_S) is None
        after = observe(probe, border)
        assert observe(border, probe, after) is not None


@pytest.mark.nightly
def test_a_symmetric_nat_that_forgets_a_mapping_makes_another(net: Internet) -> None:
    robot = net.attach(Access.SYMMETRIC)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        before = observe(probe, border)
        assert observe(probe, border) == before
        robot.site().flush_mappings()
        assert observe(probe, border) not in (before, None)


@pytest.mark.nightly
@pytest.mark.parametrize("access", [*NATS, Access.PUBLIC], ids=lambda each: each.value)
def test_a_renumbered_site_shows_a_new_address_to_the_same_socket(net: Internet, access: Access) -> None:
    robot = net.attach(access)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        before = observe(probe, border)
        robot.site().renumber()
        after = observe(probe, border)
        assert before is not None
        assert after is not None
        assert before.address != after.address
        assert observe(border, probe, after) is not None
        assert observe(border, probe, before, timeout_s=SILENCE_S) is None


@pytest.mark.nightly
def test_a_renumbered_ipv6_site_gives_its_hosts_another_prefix(net: Internet) -> None:
    robot = net.attach(Access.IPV6_ONLY)
    with UdpProbe(robot, 6) as probe, UdpProbe(net.borders[0], 6) as border:
        before = observe(probe, border)
        robot.site().renumber()
        assert observe(probe, border) not in (before, None)


@pytest.mark.nightly
def test_a_new_lease_gives_a_host_another_address_behind_the_same_nat(net: Internet) -> None:
    robot = net.attach(Access.PORT_RESTRICTED)
    before = robot.lease().address
    robot.renumber()
    assert robot.lease().address != before
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        seen = observe(probe, border)
        assert seen is not None
        assert seen.address == robot.site().address


@pytest.mark.nightly
def test_a_socket_outlives_the_move_of_its_host_to_another_site(net: Internet) -> None:
    robot = net.attach(Access.PORT_RESTRICTED)
    mobile = net.laboratory.add_site("mobile", Access.SYMMETRIC)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        assert observe(probe, border) is not None
        robot.attach(mobile)
        after = observe(probe, border)
    assert after is not None
    assert after.address == mobile.address
    robot.attach(net.laboratory.add_site("v6", Access.IPV6_ONLY))
    with UdpProbe(robot, 6) as probe, UdpProbe(net.borders[0], 6) as border:
        assert observe(probe, border) == probe.local


@pytest.mark.nightly
def test_a_host_with_two_uplinks_uses_the_first_and_may_choose(net: Internet) -> None:
    home, mobile = (net.laboratory.add_site(label, Access.PORT_RESTRICTED) for label in ("home", "mobile"))
    robot = net.laboratory.add_host("robot", home, "wlan0")
    robot.attach(mobile, "wwan0")
    with UdpProbe(net.borders[0]) as border:
        for device, address in (("", home.address), ("wlan0", home.address), ("wwan0", mobile.address)):
            with UdpProbe(robot, device=device) as probe:
                seen = observe(probe, border)
                assert seen is not None
                assert seen.address == address


@pytest.mark.nightly
def test_a_silent_cut_loses_datagrams_without_an_error_until_it_ends(net: Internet) -> None:
    robot = net.attach(Access.PORT_RESTRICTED)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        public = observe(probe, border)
        robot.site().cut()
        assert observe(probe, border, timeout_s=SILENCE_S) is None
        assert observe(border, probe, public, timeout_s=SILENCE_S) is None
        assert all(probe.send(border.local, b"no error") for _ in range(3))
        robot.site().restore()
        assert observe(probe, border) == public


@pytest.mark.nightly
def test_an_unplugged_host_sees_its_carrier_go_and_come(net: Internet) -> None:
    robot = net.attach(Access.PORT_RESTRICTED)
    seen = []
    for action in (robot.unplug, robot.plug):
        action()
        link = subprocess.run(robot.space.command(["ip", "link", "show", ETHERNET]), capture_output=True, check=True)
        seen.append(b"NO-CARRIER" in link.stdout)
    assert seen == [True, False]


@pytest.mark.nightly
@pytest.mark.parametrize("access", [Access.SYMMETRIC, Access.DOUBLE_NAT, Access.IPV6_ONLY], ids=lambda each: each.value)
def test_a_router_that_restarts_forgets_its_mappings_and_serves_again(net: Internet, access: Access) -> None:
    robot = net.attach(access)
    version = min(TRAITS[access].versions)
    with UdpProbe(robot, version) as probe, UdpProbe(net.borders[0], version) as border:
        public = observe(probe, border)
        robot.site().power_off()
        assert observe(probe, border, timeout_s=SILENCE_S) is None
        robot.site().power_on()
        assert observe(border, probe, public, timeout_s=SILENCE_S) is None
        assert observe(probe, border) is not None


@pytest.mark.nightly
def test_a_delay_line_delays_both_directions_and_loses_nothing(net: Internet) -> None:
    robot = net.attach(Access.PORT_RESTRICTED, delay_ms=30.0)
    with UdpProbe(robot) as probe, UdpProbe(net.borders[0]) as border:
        public = observe(probe, border)
        started_s = time.monotonic()
        probe.send(border.local, b"there")
        assert border.wait(b"there", PATIENCE_S) == public
        assert public is not None
        border.send(public, b"back")
        assert probe.wait(b"back", PATIENCE_S) is not None
        assert time.monotonic() - started_s >= 0.06
        send_many(probe, border, 500)
        assert border.wait(b"499", PATIENCE_S) is not None
        assert len(border.sources) == 502


def send_many(sender: UdpProbe, receiver: UdpProbe, count: int) -> None:
    for number in range(count):
        sender.send(receiver.local, b"%d" % number)


def keep_laboratory(runs: str) -> None:
    """Make a laboratory with a host, print what it left, and wait; a process of its own."""
    run = RunRegistry(Path(runs)).start()
    made = Laboratory(run)
    made.add_host("robot", made.add_site("home", Access.DOUBLE_NAT, delay_ms=1.0))
    print(run.directory, *run.record.namespaces, flush=True)
    signal.pause()


def test_what_a_killed_laboratory_left_is_removed_by_the_next_start(
    laboratory: Laboratory, machine: LabMachine
) -> None:
    runs = machine.folder / "runs"
    process = machine.launch(calling(keep_laboratory, runs))
    left = [Path(word) for word in process.read_line(60.0).decode().split()]
    machine.kill(process)
    assert len(left) == 6
    assert all(path.exists() for path in left[1:])
    assert len(RunRegistry(runs).sweep()) == 1
    assert not any(path.exists() for path in left)
    assert laboratory.core.path.exists()
