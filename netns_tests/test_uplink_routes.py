"""Routes of uplinks: marked packets leave through their own uplink only, and nothing of a dead run stays.

::

    [host] u0 10.1.0.2 ---- 10.1.0.1 [router, 203.0.113.9 and 2001:db8:9::9]
           u1 10.2.0.2 ---- 10.2.0.1
"""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from gdp.errors import LocalError
from gdp.ports.tunnel.uplink_routes import PROTOCOL, UplinkRoutes, mark_of, remove_leftovers
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import calling

pytestmark = pytest.mark.netns

MARKS = mark_of("gw0-test"), mark_of("gw1-test")
PEER4, PEER6 = "203.0.113.9", "2001:db8:9::9"
PORT = 9_999
PATIENCE_S = 20.0


class Site:
    """A host with two uplinks to one router, which returns the source address of each datagram.

    ``host``: the namespace of this thread.
    """

    def __init__(self, host: Space, stack: ExitStack) -> None:
        self.host, self.router = host, stack.enter_context(contextlib.closing(Space()))
        for each in (self.host, self.router):
            for scope in ("all", "default"):
                each.set(f"ipv4/conf/{scope}/rp_filter", "0")
            each.set("ipv6/conf/default/disable_ipv6", "0")
            each.ip("link", "set", "lo", "up")
        self.router.ip("address", "add", f"{PEER4}/32", "dev", "lo")
        self.router.ip("address", "add", f"{PEER6}/128", "dev", "lo", "nodad")
        with self.router.entered():
            self.servers = {
                family: stack.enter_context(socket.socket(family, socket.SOCK_DGRAM))
                for family in (socket.AF_INET, socket.AF_INET6)
            }
            self.servers[socket.AF_INET].bind((PEER4, PORT))
            self.servers[socket.AF_INET6].bind((PEER6, PORT))
        for uplink in (0, 1):
            self.connect(uplink)

    def connect(self, uplink: int) -> None:
        """Make the cable of an uplink, with addresses and default routes at this end."""
        self.host.connect(self.router, f"u{uplink}", f"r{uplink}")
        self.router.ip("address", "add", f"10.{uplink + 1}.0.1/24", "dev", f"r{uplink}")
        self.router.ip("address", "add", f"2001:db8:{uplink + 1}::1/64", "dev", f"r{uplink}", "nodad")
        self.lease(uplink)

    def lease(self, uplink: int) -> None:
        """Give an uplink its addresses and default routes; those of the first one are preferred."""
        device, metric = f"u{uplink}", str(100 * (uplink + 1))
        self.host.ip("address", "add", f"10.{uplink + 1}.0.2/24", "dev", device)
        self.host.ip("address", "add", f"2001:db8:{uplink + 1}::2/64", "dev", device, "nodad")
        self.host.ip("route", "add", "default", "via", f"10.{uplink + 1}.0.1", "dev", device, "metric", metric)
        self.host.ip(
            "-6", "route", "add", "default", "via", f"2001:db8:{uplink + 1}::1", "dev", device, "metric", metric
        )

    def source(self, mark: int, family: socket.AddressFamily) -> str:
        """Return the address that the router sees of a datagram with this mark, after an answer came back.

        Raises:
            OSError: there is no route.
        """
        server = self.servers[family]
        with socket.socket(family, socket.SOCK_DGRAM) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_MARK, mark)
            client.settimeout(PATIENCE_S)
            server.settimeout(PATIENCE_S)
            client.sendto(b"question", (PEER4 if family == socket.AF_INET else PEER6, PORT))
            _, address = server.recvfrom(64)
            server.sendto(b"answer", address)
            assert client.recv(64) == b"answer"
            return str(address[0])

    def sources(self, mark: int) -> tuple[str, str]:
        """Return the source addresses of both families."""
        return self.source(mark, socket.AF_INET), self.source(mark, socket.AF_INET6)

    def has_route(self, mark: int) -> bool:
        """Return whether packets with this mark leave at all."""
        with contextlib.suppress(OSError):
            self.sources(mark)
            return True
        return False


def of(uplink: int) -> tuple[str, str]:
    """Return the addresses of an uplink."""
    return f"10.{uplink + 1}.0.2", f"2001:db8:{uplink + 1}::2"


def follow(routes: UplinkRoutes, until: Callable[[], bool]) -> None:
    """Handle events until a condition holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not until():
        assert select.select([routes], [], [], max(end_s - time.monotonic(), 0.0))[0], "no event"
        routes.sync()


def left(site: Site) -> list[str]:
    """Return the rules and routes with our protocol number."""
    words = "proto", str(PROTOCOL)
    found = []
    for family in ("-4", "-6"):
        found += [line for line in site.host.ip(family, "-d", "rule").splitlines() if f"proto {PROTOCOL}" in line]
        found += site.host.ip(family, "route", "show", "table", "all", *words).splitlines()
    return found


@pytest.fixture
def site(space: Space) -> Iterator[Site]:
    with ExitStack() as stack:
        yield Site(space, stack)


@pytest.fixture
def uplinks(site: Site) -> Iterator[tuple[UplinkRoutes, UplinkRoutes]]:
    with ExitStack() as stack:
        made = [UplinkRoutes(f"u{uplink}", MARKS[uplink]) for uplink in (0, 1)]
        for each in made:
            stack.callback(each.close)
        yield made[0], made[1]


Uplinks = tuple[UplinkRoutes, UplinkRoutes]


def test_marked_packets_leave_through_their_own_uplink(site: Site, uplinks: Uplinks) -> None:
    assert [site.sources(mark) for mark in MARKS] == [of(0), of(1)]
    assert site.sources(0) == of(0)  # without a mark the main table decides


def test_an_uplink_without_address_takes_no_other_way_and_works_again_when_it_is_back(
    site: Site, uplinks: Uplinks
) -> None:
    first, _ = uplinks
    site.host.ip("address", "flush", "dev", "u0")
    site.host.ip("-6", "route", "flush", "dev", "u0")  # as the end of a router advertisement's lifetime does
    follow(first, lambda: not site.has_route(MARKS[0]))
    assert site.sources(0) == of(1)
    assert site.sources(MARKS[1]) == of(1)
    site.lease(0)
    follow(first, lambda: site.has_route(MARKS[0]))
    assert site.sources(MARKS[0]) == of(0)


def test_a_device_that_is_removed_and_comes_back_is_followed(site: Site, uplinks: Uplinks) -> None:
    _, second = uplinks
    site.host.ip("link", "del", "u1")
    follow(second, lambda: not site.has_route(MARKS[1]))
    site.connect(1)
    follow(second, lambda: site.has_route(MARKS[1]))
    assert site.sources(MARKS[1]) == of(1)


def test_an_uplink_may_be_missing_at_the_start(site: Site) -> None:
    site.host.ip("link", "del", "u1")
    with contextlib.closing(UplinkRoutes("u1", MARKS[1])) as routes:
        assert not site.has_route(MARKS[1])
        site.connect(1)
        follow(routes, lambda: site.has_route(MARKS[1]))
        assert site.sources(MARKS[1]) == of(1)


def test_another_gateway_replaces_the_one_before(site: Site, uplinks: Uplinks) -> None:
    first, _ = uplinks
    site.host.ip("route", "replace", "default", "via", "10.1.0.77", "dev", "u0", "metric", "100")
    table = str(MARKS[0])
    follow(first, lambda: "10.1.0.77" in site.host.ip("route", "show", "table", table))
    assert "10.1.0.1 " not in site.host.ip("route", "show", "table", table, "default")


def test_one_hop_of_a_route_over_both_uplinks_stands_in_the_table_of_each(site: Site, uplinks: Uplinks) -> None:
    hops = "nexthop", "via", "10.1.0.1", "dev", "u0", "nexthop", "via", "10.2.0.1", "dev", "u1"
    site.host.ip("route", "add", "198.51.100.0/24", *hops)
    for uplink, routes in enumerate(uplinks):
        table = str(MARKS[uplink])
        follow(routes, lambda table=table: "198.51.100.0" in site.host.ip("route", "show", "table", table))  # type: ignore[misc]
        assert f"via 10.{uplink + 1}.0.1 dev u{uplink}" in site.host.ip(
            "route", "show", "table", table, "198.51.100.0/24"
        )


def test_rules_that_another_program_flushed_are_made_again(site: Site, uplinks: Uplinks) -> None:
    _, second = uplinks
    for family in ("-4", "-6"):
        site.host.ip(family, "rule", "del", "priority", "5000", "fwmark", str(MARKS[1]))
    follow(second, lambda: site.has_route(MARKS[1]) and site.sources(MARKS[1]) == of(1))


def test_nothing_is_left_at_the_end(site: Site) -> None:
    made = [UplinkRoutes(f"u{uplink}", MARKS[uplink]) for uplink in (0, 1)]
    assert left(site)
    for each in made:
        each.close()
    assert left(site) == []


def keep_routes() -> None:
    """Hold the routes of both uplinks until killed; a process of its own."""
    made = [UplinkRoutes(f"u{uplink}", MARKS[uplink]) for uplink in (0, 1)]
    print("ready", len(made), flush=True)
    signal.pause()


@pytest.fixture
def dead_run(site: Site, machine: LabMachine) -> Site:
    """Return a site where a run with both uplinks was killed."""
    child = machine.launch(calling(keep_routes))
    child.read_until("ready")
    machine.kill(child)
    assert left(site)
    return site


def test_the_next_start_replaces_what_a_killed_run_left(dead_run: Site) -> None:
    before = len(left(dead_run))
    made = [UplinkRoutes(f"u{uplink}", MARKS[uplink]) for uplink in (0, 1)]
    assert len(left(dead_run)) == before
    assert [dead_run.sources(mark) for mark in MARKS] == [of(0), of(1)]
    for each in made:
        each.close()
    assert left(dead_run) == []


def test_what_a_killed_run_left_is_removed_although_no_uplink_is_configured_any_more(dead_run: Site) -> None:
    remove_leftovers([mark_of("gw0-other")])
    assert left(dead_run)
    remove_leftovers(MARKS)
    assert left(dead_run) == []


def test_rules_and_routes_of_other_programs_stay(site: Site) -> None:
    site.host.ip("rule", "add", "fwmark", "0x77", "lookup", "700", "priority", "5000")
    site.host.ip("route", "add", "default", "via", "10.1.0.1", "dev", "u0", "table", "700")
    before = site.host.ip("rule"), site.host.ip("route", "show", "table", "700")
    with contextlib.closing(UplinkRoutes("u0", MARKS[0])):
        pass
    assert (site.host.ip("rule"), site.host.ip("route", "show", "table", "700")) == before


def test_a_table_of_another_program_is_refused_and_left_alone(site: Site) -> None:
    table = str(MARKS[0])
    site.host.ip("route", "add", "default", "via", "10.1.0.1", "dev", "u0", "table", table)
    with pytest.raises(LocalError, match="another program uses the routing table"):
        UplinkRoutes("u0", MARKS[0])
    assert "10.1.0.1" in site.host.ip("route", "show", "table", table)
    assert left(site) == []


@pytest.mark.parametrize(
    ("everywhere", "here", "is_reported"), [(0, 1, True), (1, 0, True), (1, 2, False), (0, 0, False)]
)
def test_a_strict_reverse_path_filter_is_reported_with_what_to_do(
    site: Site, uplinks: Uplinks, everywhere: int, here: int, is_reported: bool
) -> None:
    site.host.set("ipv4/conf/all/rp_filter", str(everywhere))
    site.host.set("ipv4/conf/u1/rp_filter", str(here))
    assert ("sysctl -w net.ipv4.conf.u1.rp_filter=2" in uplinks[1].warning) is is_reported
    assert bool(uplinks[1].warning) is is_reported


def test_a_machine_without_ipv6_addresses_has_routes_of_ipv4_only(site: Site) -> None:
    site.host.set("ipv6/conf/all/disable_ipv6", "1")
    with contextlib.closing(UplinkRoutes("u1", MARKS[1])):
        assert site.source(MARKS[1], socket.AF_INET) == of(1)[0]
