"""Proxy with a request to leave: it finishes its calls and ends, within ten seconds in any case."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from gdp.runtime.runtime import Runtime
from proxy.node import bridge_node, node
from proxy.node.node import ProxyNode
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites

SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}, timeout_s: 60"


@dataclass(slots=True)
class Steps:
    """Main loop in virtual time."""

    sites: Sites
    is_stopped: bool = False

    def step(self, until_s: float | None) -> None:
        self.sites.run(0.01)

    def every(self, *_: object) -> None:
        """Call nothing."""


class Leaving(ProxyNode):
    """Node in virtual time that has been asked to leave."""

    def __init__(self, sites: Sites, machine: Machine) -> None:
        self.member, self.runtime = machine.member, cast(Runtime, Steps(sites))
        self.is_leaving, self.has_drained = True, False

    def tell_refusals(self) -> None:
        """Log nothing."""


def leave(sites: Sites, machine: Machine) -> float:
    """Run a machine's loop after a SIGUSR1; return how many seconds it took to end."""
    began_s = sites.now_s
    bridge_node._work(Leaving(sites, machine), machine.bridge, json=True)
    return sites.now_s - began_s


@pytest.fixture
def sites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sites:
    sites = Sites(tmp_path)
    monkeypatch.setattr(node, "time", SimpleNamespace(monotonic=lambda: sites.now_s))
    monkeypatch.setattr(bridge_node, "_tell_ready", lambda *_, json: None)
    return sites


def called(sites: Sites) -> tuple[Machine, LocalServer, Client]:
    """Return a server's machine, its local server with a call in flight, and the client."""
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    local, caller = LocalServer(server.graph), Client(client.graph)
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    return server, local, caller


def test_it_answers_what_is_under_way_and_ends(sites: Sites) -> None:
    server, local, caller = called(sites)
    sites.world.network.call(3, lambda: local.waiting[0][1](switched("yes")))
    assert 3 <= leave(sites, server) < 4
    sites.run(0.5)
    assert caller.outcomes == [switched("yes")]


def test_it_ends_after_ten_seconds_all_the_same(sites: Sites) -> None:
    server, _, _ = called(sites)
    assert 10 <= leave(sites, server) < 11


def test_without_servers_it_ends_at_once(sites: Sites) -> None:
    assert leave(sites, sites.add(ROBOT, imports=[SWITCH])) < 1
