"""Commands with several keys: a server is called once so many machines have sent the same request."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from gdp.trust.right import Right
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites, revocation_of

RELEASE: Final = f"kind: service, name: /switch, type: {SET_BOOL}"
DESKS: Final = (SERVER, "nuc3/desk2", "nuc5/desk3")
YES, NO = switch(on=True), switch(on=False)
TIMEOUT_S: Final = 10


class Keys:
    """A robot with a server, and three desks that may call it."""

    def __init__(self, sites: Sites, signers: int = 2) -> None:
        self.sites = sites
        self.robot = sites.add(ROBOT, expose=[f"{RELEASE}, signers: {signers}"])
        self.server = LocalServer(self.robot.graph)
        self.machines: list[Machine] = [
            sites.add(label, imports=[f"{RELEASE}, timeout_s: {TIMEOUT_S}"]) for label in DESKS
        ]
        self.desks = [Client(machine.graph) for machine in self.machines]
        assert sites.run(5, lambda: all(desk.sees_server() for desk in self.desks))

    def turn(self, desk: int, raw: bytes = YES, wait_s: float = 1.0) -> None:
        """Have a desk call, and let the request arrive."""
        self.desks[desk].call(raw)
        self.sites.run(wait_s)

    def answer(self) -> None:
        """Answer what the server has got."""
        while self.server.waiting:
            raw, done = self.server.waiting.pop(0)
            done(switched(f"got {raw[-1]}"))
        self.sites.run(1)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


@pytest.fixture
def keys(sites: Sites) -> Keys:
    return Keys(sites)


def test_the_second_machine_releases_the_request_and_both_get_the_one_response(keys: Keys) -> None:
    keys.turn(0)
    assert keys.server.asked == 0
    keys.turn(1)
    assert keys.server.asked == 1
    keys.answer()
    assert [desk.outcomes for desk in keys.desks] == [[switched("got 1")], [switched("got 1")], []]
    keys.sites.run(2 * TIMEOUT_S)
    assert keys.server.asked == 1


def test_one_machine_that_asks_twice_is_one_and_its_calls_time_out(keys: Keys) -> None:
    keys.turn(0)
    keys.turn(0)
    keys.sites.run(2 * TIMEOUT_S)
    assert keys.server.asked == 0
    assert [len(each) for each in keys.desks[0].got.values()] == [1, 1]
    assert switched("got 1") not in keys.desks[0].outcomes


def test_other_requests_do_not_meet(keys: Keys) -> None:
    keys.turn(0, YES)
    keys.turn(1, NO)
    assert keys.server.asked == 0
    keys.turn(2, NO)
    assert [raw for raw, _ in keys.server.waiting] == [NO]
    keys.answer()
    assert [desk.outcomes for desk in keys.desks] == [[], [switched("got 0")], [switched("got 0")]]


def test_a_partner_whose_time_is_over_does_not_count(keys: Keys) -> None:
    keys.turn(0)
    keys.sites.run(TIMEOUT_S + 2)
    keys.turn(1)
    assert keys.server.asked == 0
    keys.turn(2)
    assert keys.server.asked == 1


def test_a_partner_that_went_does_not_count(keys: Keys) -> None:
    keys.turn(0, wait_s=0.5)
    keys.sites.leave(keys.machines[0])
    keys.sites.run(TIMEOUT_S - 1)
    keys.turn(1)
    assert keys.server.asked == 0


def test_a_request_that_was_served_needs_two_keys_again(keys: Keys) -> None:
    for desk in (0, 1):
        keys.turn(desk)
    keys.answer()
    keys.turn(2)
    assert keys.server.asked == 1
    keys.turn(0)
    assert keys.server.asked == 2


def test_three_keys_of_three(sites: Sites) -> None:
    keys = Keys(sites, signers=3)
    for desk in (0, 1):
        keys.turn(desk)
    assert keys.server.asked == 0
    keys.turn(2)
    keys.answer()
    assert [desk.outcomes for desk in keys.desks] == [[switched("got 1")]] * 3


def test_a_machine_without_the_right_to_call_is_no_key(keys: Keys) -> None:
    world, held = keys.sites.world, keys.machines[1].bridge.held
    topic = held.find(keys.robot.bridge.flows[0][0].name, Right.CALL)
    assert topic is not None
    world.switches["nuc3"].revoke(revocation_of(world, topic), world.network.now)
    world.network.send_pending("nuc3")
    keys.sites.run(2)
    keys.turn(0)
    keys.turn(1)
    assert keys.server.asked == 0
    keys.turn(2)
    assert keys.server.asked == 1


def test_the_failure_of_the_server_is_known_to_both(keys: Keys) -> None:
    keys.turn(0)
    keys.turn(1)
    keys.server.waiting.pop()[1]("jammed")
    keys.sites.run(1)
    first, second, _ = (desk.outcomes for desk in keys.desks)
    assert first == second
    assert len(first) == 1
