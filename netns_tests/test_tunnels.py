"""Tunnel devices between two namespaces: traffic, restarts, changes of addresses, and what a dead owner leaves."""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.limits import FLIGHT_MAX_BYTES
from gdp.ports.tunnel import uapi
from gdp.ports.tunnel.devices import find_device
from gdp.ports.tunnel.path_mtu import RouteMonitor, route_mtu
from gdp.ports.tunnel.uapi import UserspaceControl, socket_path
from gdp.ports.tunnel.vxlan import make_vxlan, remove_link, set_link_mtu
from gdp.ports.tunnel.wireguard import WireGuardDevice, open_wireguard
from lab import process
from netns_tests.tunnel_sites import PATIENCE_S, PORT, Site, crosses, numbers, payload, two_sites, until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about devices, no lease matters"),
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="wireguard-go needs root for its control socket"),
]

Ends = tuple[WireGuardDevice, WireGuardDevice]


@pytest.fixture
def sites() -> Iterator[tuple[Site, Site]]:
    with two_sites() as made:
        yield made


@pytest.fixture
def ends(sites: tuple[Site, Site]) -> Ends:
    """Devices of both sites, the second dials, with a VXLAN link between them."""
    one, two = sites
    first, second = one.open(), two.open()
    one.connect(first, two, is_dialling=False)
    two.connect(second, one, is_dialling=True)
    return first, second


def process_of(ifname: str) -> int:
    """Return the process id of the wireguard-go of a device."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.connect(str(socket_path(ifname)))
        credentials = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
    return int.from_bytes(credentials[:4], sys.byteorder)


def is_alive(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def test_frames_cross_a_link_in_both_directions(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites[0].frames(), sites[1].frames()
    until(crosses(one, two), *ends)
    until(crosses(two, one), *ends)
    ends[0].poll()
    assert ends[0].path_mtu(sites[1].public_key) == 1500
    assert ends[0].backend == "wireguard-go"
    assert ends[0].reason
    assert ends[0].peers()[sites[1].public_key].endpoint == sites[1].endpoint


def test_a_link_sends_nothing_by_itself(sites: tuple[Site, Site], ends: Ends) -> None:
    with sites[0].entered(), socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) as every:
        every.bind((sites[0].link, 3))
        every.setblocking(False)
        until(crosses(sites[0].frames(), sites[1].frames()), *ends)
        heard = []
        while select.select([every], [], [], 1.0)[0]:
            heard.append(every.recv(2_000))
    assert {frame[12:14].hex() for frame in heard} == {"88b5"}


@pytest.mark.parametrize(
    "is_dialler",
    [
        pytest.param(False, id="the end that answers", marks=pytest.mark.nightly),
        pytest.param(True, id="the end that dials"),
    ],
)
def test_a_session_survives_a_change_of_address(sites: tuple[Site, Site], ends: Ends, is_dialler: bool) -> None:
    one, two = sites[0].frames(), sites[1].frames()
    until(crosses(one, two), *ends)
    before = ends[1].peers()[sites[0].public_key].handshake_unix_s
    for end in ends:
        end.poll()
    site = sites[is_dialler]
    site.ip("address", "add", "10.9.0.50/24", "dev", "u0")
    site.ip("address", "del", f"{site.address}/24", "dev", "u0")
    until(crosses(one, two), *ends)
    until(crosses(two, one), *ends)
    assert ends[1].peers()[sites[0].public_key].handshake_unix_s == before
    assert ends[not is_dialler].peers()[site.public_key].endpoint == Endpoint("10.9.0.50", PORT)


def test_a_killed_wireguard_go_heals_and_the_link_stays(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites[0].frames(), sites[1].frames()
    until(crosses(one, two), *ends)
    for end in ends:
        end.poll()
    for site in sites:
        pid = process_of(site.ifname)
        os.kill(pid, signal.SIGKILL)
        until(lambda pid=pid: not is_alive(pid))  # type: ignore[misc]
        until(crosses(one, two), *ends)  # the same packet sockets: the devices are the same
        until(crosses(two, one), *ends)


def test_no_thread_of_wireguard_go_interrupts_a_sender_also_after_a_restart(
    sites: tuple[Site, Site], ends: Ends
) -> None:
    def classes() -> set[int]:
        """Return the scheduling classes of all threads of the program of the first site."""
        return {
            os.sched_getscheduler(int(each.name))
            for each in Path(f"/proc/{process_of(sites[0].ifname)}/task").iterdir()
        }

    frames = [site.frames() for site in sites]
    until(crosses(*frames), *ends)
    assert classes() == {os.SCHED_BATCH}
    pid = process_of(sites[0].ifname)
    os.kill(pid, signal.SIGKILL)
    until(lambda: not is_alive(pid))
    until(crosses(*frames), *ends)
    assert classes() == {os.SCHED_BATCH}


def test_wireguard_go_gets_large_receive_buffers_also_after_a_rebind(sites: tuple[Site, Site], ends: Ends) -> None:
    def has_large_buffers() -> bool:
        with sites[0].entered():
            listed = subprocess.run(["ss", "-OHlnum"], check=True, capture_output=True, text=True).stdout
        own = [line for line in listed.splitlines() if f":{ends[0].listen_port} " in line]
        return bool(own) and all(int(re.findall(r",rb(\d+)", line)[0]) > (7 << 20) for line in own)

    until(has_large_buffers, *ends)
    ends[0].rebind()
    until(has_large_buffers, *ends)


def test_each_second_rebind_returns_to_the_first_port(sites: tuple[Site, Site], ends: Ends) -> None:
    ports = [ends[0].listen_port]
    for _ in range(4):
        ends[0].rebind()
        ports.append(ends[0].listen_port)
    assert ports[0::2] == 3 * [PORT]
    assert PORT not in ports[1::2]
    until(crosses(sites[0].frames(), sites[1].frames()), *ends)


def test_a_rebind_takes_another_port_if_the_first_one_is_taken(sites: tuple[Site, Site], ends: Ends) -> None:
    ends[0].rebind()
    with sites[0].entered(), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as other:
        other.bind(("", PORT))
        ends[0].rebind()
        assert ends[0].listen_port not in (0, PORT)
        until(crosses(sites[0].frames(), sites[1].frames()), *ends)


def test_changes_during_a_restart_are_applied_after_it(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites
    until(crosses(one.frames(), two.frames()), *ends)
    os.kill(process_of(two.ifname), signal.SIGKILL)
    with two.entered():
        ends[1].remove_peer(one.public_key)
        ends[1].set_peer(one.public_key, inner=one.inner, endpoint=one.endpoint, keepalive_s=25)
    until(crosses(one.frames(), two.frames()), *ends)


def test_changes_while_wireguard_go_hangs_are_applied_when_it_goes_on(
    sites: tuple[Site, Site], ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = sites
    until(crosses(one.frames(), two.frames()), *ends)
    monkeypatch.setattr(uapi, "RETRY_S", 0.5)
    pid = process_of(two.ifname)
    os.kill(pid, signal.SIGSTOP)
    try:
        with two.entered():
            ends[1].remove_peer(one.public_key)
            ends[1].set_peer(bytes(32), inner="fd00::77", endpoint=None, keepalive_s=0)
    finally:
        os.kill(pid, signal.SIGCONT)

    def has_changed() -> bool:
        with two.entered():
            ends[1].poll()
        return set(UserspaceControl(two.ifname).state().peers) == {bytes(32)}

    until(has_changed, *ends)


def test_a_device_that_another_program_removed_is_made_again(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites
    until(crosses(one.frames(), two.frames()), *ends)
    two.ip("link", "delete", two.ifname)
    with two.entered():
        process.until(ends[1].handle_events, meanwhile=lambda: select.select([ends[1]], [], [], 1.0))
        two.make_link(two.ifname, one)
    until(crosses(one.frames(), two.frames()), *ends)


def test_two_devices_lead_to_one_peer(sites: tuple[Site, Site]) -> None:
    one, two = sites
    first, second = one.open(), one.open(0, f"{one.ifname}b")
    for device in (first, second):
        with one.entered():
            device.set_peer(two.public_key, inner=two.inner, endpoint=two.endpoint, keepalive_s=0)
    routes = one.ip("-6", "route", "show", two.inner)
    assert {one.ifname, f"{one.ifname}b"} == {line.split()[2] for line in routes.splitlines()}
    with one.entered():
        first.remove_peer(two.public_key)
    assert f"{one.ifname}b" in one.ip("-6", "route", "show", two.inner)


@pytest.fixture
def two_uplinks(sites: tuple[Site, Site]) -> tuple[Site, Site]:
    """Sites with a second cable ``u1``; the first reaches an address of the second over both, and prefers ``u0``."""
    one, two = sites
    one.space.connect(two.space, "u1")
    for site, address in ((one, "10.7.0.1"), (two, "10.7.0.2")):
        site.ip("address", "add", f"{address}/24", "dev", "u1")
    two.ip("address", "add", "10.5.0.1/32", "dev", "lo")
    one.ip("route", "add", "default", "via", "10.9.0.2", "metric", "100")
    one.ip("route", "add", "default", "via", "10.7.0.2", "metric", "200")
    two.endpoint = Endpoint("10.5.0.1", PORT)
    return one, two


@pytest.mark.parametrize(("uplink", "source"), [("u0", "10.9.0.1"), ("u1", "10.7.0.1")])
def test_a_tunnel_over_an_uplink_leaves_by_it(two_uplinks: tuple[Site, Site], uplink: str, source: str) -> None:
    one, two = two_uplinks
    first, second = one.open(uplink=uplink), two.open()
    two.connect(second, one, is_dialling=False)
    one.connect(first, two, is_dialling=True)
    sending, receiving = one.frames(), two.frames()
    until(crosses(sending, receiving), first, second)
    until(crosses(receiving, sending), first, second)
    assert second.peers()[one.public_key].endpoint == Endpoint(source, PORT)
    first.close()
    assert "fwmark" not in one.ip("rule")
    assert "table" not in one.ip("route", "show", "table", "all", "type", "unreachable")


def test_a_tunnel_over_an_uplink_that_is_down_does_not_use_the_other(two_uplinks: tuple[Site, Site]) -> None:
    one, two = two_uplinks
    first = one.open(uplink="u1")

    def is_routed() -> bool:
        try:
            return route_mtu(two.endpoint, first.fwmark) > 0
        except LocalError:
            return False

    with one.entered():
        assert is_routed()
        one.ip("link", "set", "u1", "down")
        until(lambda: not is_routed())
        assert route_mtu(two.endpoint) == 1500
        one.ip("link", "set", "u1", "up")
        one.ip("route", "add", "default", "via", "10.7.0.2", "metric", "200")
        until(is_routed)


def test_a_session_moves_to_the_other_uplink_when_one_goes_down(two_uplinks: tuple[Site, Site]) -> None:
    one, two = two_uplinks
    first, second = one.open(), two.open()
    two.connect(second, one, is_dialling=False)
    one.connect(first, two, is_dialling=True)
    sending, receiving = one.frames(), two.frames()
    until(crosses(sending, receiving), first, second)
    one.ip("link", "set", "u0", "down")
    until(crosses(sending, receiving), first, second)
    until(crosses(receiving, sending), first, second)
    assert second.peers()[one.public_key].endpoint == Endpoint("10.7.0.1", PORT)


def test_a_killed_owner_leaves_no_rule_of_its_uplink(two_uplinks: tuple[Site, Site]) -> None:
    one, _ = two_uplinks
    words = (
        f"from gdp.ports.tunnel.wireguard import open_wireguard; import time; open_wireguard(ifname={one.ifname!r},"
        f" private_key=bytes(32), listen_port=0, inner={one.inner!r}, mtu=1440, alias={one.alias!r}, uplink='u1');"
        " print('open', flush=True); time.sleep(60)"
    )
    with one.entered(), subprocess.Popen([sys.executable, "-c", words], stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == b"open\n"
        assert "fwmark" in one.ip("rule")
        owner.kill()
    until(lambda: "fwmark" not in one.ip("rule") and not one.has(one.ifname))


def test_a_restarted_peer_is_reached_again_at_once(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites
    until(crosses(one.frames(), two.frames()), *ends)
    before = ends[1].peers()[one.public_key].handshake_unix_s
    with one.entered():
        ends[0].remove_peer(two.public_key)  # its session and where the peer is are lost
        ends[0].set_peer(two.public_key, inner=two.inner, endpoint=None, keepalive_s=0)
    begun_s = time.monotonic()

    def is_new() -> bool:
        ends[1].retry_handshake(one.public_key)
        time.sleep(0.5)  # as often as a dialler tries
        return ends[1].peers()[one.public_key].handshake_unix_s > before

    until(is_new, *ends)
    assert time.monotonic() - begun_s < 14.0  # WireGuard by itself would wait 15 seconds


def test_a_stranger_gets_no_answer(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites
    other = Site(9, one.ifname[1:-1], two.space)
    try:
        stranger = other.open(0)
        with two.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((one.address, PORT))
            for size in (1, 92, 148, 1_000):
                probe.send(b"\1\0\0\0" + os.urandom(size))
            stranger.set_peer(one.public_key, inner=one.inner, endpoint=one.endpoint, keepalive_s=1)
            two_links = two.frames()
            until(lambda: stranger.peers()[one.public_key].sent_bytes >= 148, *ends)
            until(crosses(one.frames(), two_links), *ends)  # whatever came before was handled by now
            assert stranger.peers()[one.public_key].received_bytes == 0
            probe.setblocking(False)
            with pytest.raises(BlockingIOError):
                probe.recv(2_000)
    finally:
        other.close()


def test_a_handshake_starts_at_once_although_one_went_unanswered(sites: tuple[Site, Site]) -> None:
    one, two = sites
    second = two.open()
    with two.entered():
        second.set_peer(one.public_key, inner=one.inner, endpoint=one.endpoint, keepalive_s=25)
    until(lambda: second.peers()[one.public_key].sent_bytes > 0)
    first = one.open()
    with one.entered():
        first.set_peer(two.public_key, inner=two.inner, endpoint=None, keepalive_s=0)
    begun_s = time.monotonic()
    second.retry_handshake(one.public_key)
    until(lambda: second.peers()[one.public_key].handshake_unix_s > 0)
    assert time.monotonic() - begun_s < 4.9  # by itself it would wait five seconds


def test_a_taken_port_is_refused_and_nothing_is_left(sites: tuple[Site, Site]) -> None:
    one, _ = sites
    with one.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("0.0.0.0", PORT))
        with pytest.raises(LocalError, match=f"UDP port {PORT} is in use"):
            one.open()
    assert not one.has(one.ifname)
    assert not socket_path(one.ifname).exists()


def test_a_foreign_device_is_refused_and_left_alone(sites: tuple[Site, Site]) -> None:
    one, _ = sites
    one.ip("link", "add", one.ifname, "type", "veth", "peer", "name", "other")
    with pytest.raises(LocalError, match=f"{one.ifname} exists and is not ours"):
        one.open()
    with one.entered(), pytest.raises(LocalError, match="is not ours"):
        remove_link(one.ifname, one.alias)
    assert one.has(one.ifname)


def test_the_device_of_an_orphaned_wireguard_go_is_replaced(sites: tuple[Site, Site]) -> None:
    one, _ = sites
    with one.entered():
        orphan = subprocess.Popen(["wireguard-go", "-f", one.ifname], stdout=subprocess.DEVNULL)
    until(lambda: one.has(one.ifname) and socket_path(one.ifname).exists())
    one.ip("link", "set", one.ifname, "alias", one.alias)
    device = one.open()
    assert orphan.wait(PATIENCE_S) is not None
    assert device.listen_port == PORT
    assert process_of(one.ifname) != orphan.pid


def test_the_kernel_reports_the_mtu_of_a_route_and_a_change_of_it(sites: tuple[Site, Site]) -> None:
    one, two = sites
    with one.entered():
        monitor = RouteMonitor()
        try:
            assert monitor.poll([two.endpoint]) == {}
            assert route_mtu(two.endpoint) == 1500
            one.ip("route", "replace", f"{two.address}/32", "dev", "u0", "mtu", "1380")
            ((before, now),) = monitor.poll([two.endpoint]).values()
            assert before is not None
            assert now is not None
            assert monitor.route(two.endpoint) == now
            assert (before.mtu, now.mtu, route_mtu(two.endpoint)) == (1500, 1380, 1380)
            with pytest.raises(LocalError, match=r"no route to 198\.51\.100\.1:1"):
                route_mtu(Endpoint("198.51.100.1", 1))
        finally:
            monitor.close()


def test_a_path_mtu_that_a_router_reports_is_followed(sites: tuple[Site, Site]) -> None:
    one, two = sites
    one.ip("route", "add", "10.8.0.1", "via", two.address)
    two.ip("link", "add", "far", "mtu", "1300", "type", "veth", "peer", "name", "beyond")
    for end in ("far", "beyond"):
        two.ip("link", "set", end, "up")
    two.ip("route", "add", "10.8.0.1", "dev", "far")
    two.space.set("ipv4/ip_forward", "1")
    far = Endpoint("10.8.0.1", PORT)
    with one.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        assert route_mtu(far) == 1500
        sender.setsockopt(socket.IPPROTO_IP, 10, 2)  # IP_MTU_DISCOVER, IP_PMTUDISC_DO
        sender.connect((far.address, far.port))
        sender.send(bytes(1_400))
        until(lambda: route_mtu(far) == 1300)


def test_an_mtu_of_a_missing_device_is_refused(sites: tuple[Site, Site]) -> None:
    with sites[0].entered(), pytest.raises(LocalError, match="no such device"):
        set_link_mtu("gdp-none", 1_300)


def test_without_wireguard_the_error_says_what_to_install(
    sites: tuple[Site, Site], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one, _ = sites
    with one.entered(), pytest.raises(LocalError, match=r"kernel has no WireGuard; modprobe wireguard, or apt-get"):
        open_wireguard(
            ifname=one.ifname,
            private_key=one.private_key,
            listen_port=0,
            inner=one.inner,
            mtu=1440,
            alias=one.alias,
            backend="kernel",
        )
    assert not one.has(one.ifname)


def test_a_peer_that_the_device_refuses_is_not_kept(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites
    with one.entered(), pytest.raises(LocalError, match="refused a change"):
        ends[0].set_peer(bytes(31), inner=two.inner, endpoint=None, keepalive_s=0)
    assert list(ends[0].peers()) == [two.public_key]


def test_a_link_is_never_wider_than_its_tunnel(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites
    with one.entered(), pytest.raises(LocalError, match="MTU 1400: Invalid argument"):
        set_link_mtu(one.link, 1_400)
    one.ip("link", "delete", one.link)
    with one.entered():
        make_vxlan(
            ifname=one.link, vni=1, local=one.inner, remote=two.inner, underlay=one.ifname, mtu=1_400, alias=one.alias
        )
        made = find_device(one.link)
    assert made is not None
    assert made.mtu == 1370


def test_without_the_right_to_make_devices_the_error_says_what_to_do(sites: tuple[Site, Site]) -> None:
    one, _ = sites
    words = (
        f"from gdp.ports.tunnel.wireguard import open_wireguard; open_wireguard(ifname={one.ifname!r}, listen_port=0,"
        f" private_key=bytes(32), inner={one.inner!r}, mtu=1440, alias={one.alias!r})"
    )
    with one.entered():
        ended = subprocess.run(
            ["setpriv", "--bounding-set=-net_admin", "--", sys.executable, "-c", words],
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.stderr.splitlines()[-1] == (
        f"gdp.errors.LocalError: tunnel {one.ifname}: the device cannot be made: not permitted;"
        " run this as root, or with scripts/privileged.sh"
    )


def test_numbered_frames_arrive_once_and_in_order(sites: tuple[Site, Site], ends: Ends) -> None:
    one, two = sites[0].frames(), sites[1].frames()
    until(crosses(one, two), *ends)
    numbers(two)
    for number in range(1, 201):
        one.send(payload(number))
    arrived: list[int] = []
    until(lambda: arrived.extend(number for number in numbers(two) if number) or len(arrived) >= 200, *ends)  # type: ignore[func-returns-value]
    assert arrived == list(range(1, 201))


def test_a_whole_window_waits_while_wireguard_go_has_no_processor(sites: tuple[Site, Site], ends: Ends) -> None:
    def dropped() -> int:
        """Return for how many packets the WireGuard device of the first site had no space; proc_net_dev(5)."""
        with sites[0].entered():
            text = Path("/proc/thread-self/net/dev").read_text()
        return int(next(line for line in text.splitlines() if sites[0].ifname in line).partition(":")[2].split()[11])

    sender, window = sites[0].frames(), FLIGHT_MAX_BYTES // 1_250
    until(crosses(sender, sites[1].frames()), *ends)
    pid = process_of(sites[0].ifname)
    os.kill(pid, signal.SIGSTOP)
    try:
        for number in range(window):
            sender.send(payload(number))
        assert dropped() == 0
        for number in range(window):
            sender.send(payload(number))
        assert dropped() > 0  # the bound of the queue
    finally:
        os.kill(pid, signal.SIGCONT)
