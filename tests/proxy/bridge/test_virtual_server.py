"""Virtual server: responses reach clients that are busy when the last remote server goes, and the server ends then."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from gdp.intervals import READER
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites

SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}, timeout_s: 60"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def pair(sites: Sites) -> tuple[LocalServer, Client, Machine]:
    """Return a local server that answers at once, a client on another machine, and its machine."""
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    local, caller = LocalServer(server.graph, answer=lambda _: switched("yes")), Client(client.graph)
    assert sites.run(5, caller.sees_server)
    return local, caller, client


def call(caller: Client) -> None:
    caller.call(switch(on=True))


def took_s(sites: Sites, is_met: Callable[[], bool]) -> float:
    """Return after how many seconds a condition came true."""
    begun_s = sites.now_s
    assert sites.run(5, is_met)
    return sites.now_s - begun_s


def test_a_server_that_has_answered_nothing_lately_ends_at_once(sites: Sites) -> None:
    local, caller, _ = pair(sites)
    local.handle.close()
    assert took_s(sites, lambda: not caller.sees_server()) < 0.3


def test_a_server_stays_for_a_moment_after_its_last_answer(sites: Sites) -> None:
    local, caller, _ = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])
    local.handle.close()
    assert 0.2 < took_s(sites, lambda: not caller.sees_server()) < 0.4


def test_requests_to_a_server_that_stays_are_refused_and_do_not_keep_it(sites: Sites) -> None:
    local, caller, client = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])
    local.handle.close()
    sites.run(0.1)
    assert caller.sees_server()
    for number in range(15):
        sites.world.network.call(0.02 * number, partial(call, caller))
    assert took_s(sites, lambda: not caller.sees_server()) < 0.3
    sites.run(2)
    assert len(caller.outcomes) == 16
    assert set(caller.outcomes[1:]) == {"the far server is gone", "no server"}
    assert client.faults["no-server"] == caller.outcomes.count("the far server is gone")


def test_a_server_that_returns_meanwhile_is_the_only_one(sites: Sites) -> None:
    local, caller, client = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])
    local.handle.close()
    sites.run(0.1)
    LocalServer(local.graph, answer=lambda _: switched("again"))
    sites.run(0.5)
    assert sum(each.end.name == "/switch" for each in client.graph.servers) == 1
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes[1:] == [switched("again")])


def test_failures_of_many_calls_are_paced_after_the_last_server_has_gone(sites: Sites) -> None:
    local, caller, client = pair(sites)
    local.answer = None
    for _ in range(50):
        call(caller)
    assert sites.run(1, lambda: local.asked >= 8)
    sites.kill(next(each for each in sites.machines if each is not client))
    assert sites.run(READER.lease_s + 2, lambda: len(caller.outcomes) > 0)
    assert len(caller.outcomes) <= 10  # what a client's queue holds
    assert sites.run(1, lambda: caller.outcomes == ["the far server is gone"] * 50)
    assert sites.run(2, lambda: not caller.sees_server())
