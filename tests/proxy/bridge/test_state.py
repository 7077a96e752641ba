"""Service with state on several machines: all live replicas agree after any kill, and no request is lost."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from proxy.bridge import state_parameter
from proxy.bridge.imported_service import ImportedService
from tests.proxy.bridge import known
from tests.proxy.bridge.clients import Client
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph, Server

RULE = f"kind: service, name: /switch, type: {SET_BOOL}, state: ordered"
PLACES = ("nuc3/a", "nuc3/b", "nuc5/c")


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


@dataclass(slots=True)
class Counter:
    """Node that counts its requests and responds with the count; its parameter ``state`` is the count."""

    graph: FakeGraph
    tells: bool = True
    count: int = 0
    is_stuck: bool = False
    servers: list[Server] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.servers = [self.graph.serve("/counter", "/switch", SET_BOOL, self._count)]
        if self.tells:
            for (part, type_name), ask in ((state_parameter.GET, self._get), (state_parameter.SET, self._set)):
                self.graph.services[type_name] = known.service(type_name, "", "")
                self.servers.append(self.graph.serve("/counter", f"/counter/{part}", type_name, ask))

    def die(self) -> None:
        """Leave the graph, without a response to calls in flight."""
        self.is_stuck = True
        for server in self.servers:
            server.close()

    def _count(self, raw: bytes, done: Callable[[bytes | str], None]) -> None:
        if not self.is_stuck:
            self.count += 1
            done(switched(str(self.count)))

    def _get(self, raw: bytes, done: Callable[[bytes | str], None]) -> None:
        assert raw == state_parameter.read_request()
        done(_said(b"%d" % self.count))

    def _set(self, raw: bytes, done: Callable[[bytes | str], None]) -> None:
        store = state_parameter._store()
        (asked,) = store.deserialize_cdr(raw, "rcl_interfaces/msg/SetParameters_Request").parameters  # type: ignore[attr-defined]
        self.count = int(bytes(asked.value.byte_array_value))
        done(b"\0\1\0\0" + b"\1\0\0\0" + b"\1\0\0\0" + b"\1\0\0\0\0")


def _said(state: bytes) -> bytes:
    store, name = state_parameter._store(), "rcl_interfaces/msg/Said"
    if name not in store.types:
        store.register(get_types_from_msg("rcl_interfaces/ParameterValue[] values", name))
    empty = np.zeros(0, np.uint8)
    value = store.types["rcl_interfaces/msg/ParameterValue"](
        5, False, 0, 0.0, "", np.frombuffer(state, np.uint8),
        empty.view(np.bool_), empty.view(np.int64), empty.view(np.float64), [],
    )  # fmt: skip
    return bytes(store.serialize_cdr(store.types[name](values=[value]), name))


def rule(*, tells: bool) -> str:
    return RULE + (", state_node: /counter" if tells else "")


def start(sites: Sites, place: str, *, tells: bool = True) -> tuple[Machine, Counter]:
    """Start a machine with a counter that has counted nothing."""
    counter = Counter(FakeGraph(2, known.channels(), known.services()), tells)
    return sites.add(place, expose=[rule(tells=tells)], graph=counter.graph), counter


def follow(client: Machine, count: int) -> Callable[[], bool]:
    """Return a condition: this many servers follow a client's log."""

    def do() -> bool:
        keepers = [flow._sequencer for _, flow in client.bridge.flows if isinstance(flow, ImportedService)]
        return [
            sum(each.follows for each in sequencer._replicas.values()) for sequencer in keepers if sequencer is not None
        ] == [count]

    return do


def client_of(sites: Sites, place: str = ROBOT, timeout_s: float = 30) -> tuple[Machine, Client]:
    client = sites.add(place, imports=[f"{RULE}, timeout_s: {timeout_s}"])
    return client, Client(client.graph)


def test_all_servers_count_the_same(sites: Sites) -> None:
    counters = [start(sites, place)[1] for place in PLACES]
    client, caller = client_of(sites)
    assert sites.run(10, follow(client, 3))
    for _ in range(20):
        caller.call(switch(on=True))
    assert sites.run(5, lambda: [each.count for each in counters] == [20] * 3)
    assert sites.run(1, lambda: caller.outcomes == [switched(str(number + 1)) for number in range(20)])
    assert client.faults == {}


@pytest.mark.parametrize("tells", [True, False])
def test_those_that_live_agree_though_any_are_killed_and_come_back(sites: Sites, tells: bool) -> None:
    dice = random.Random(7)
    live = {place: start(sites, place, tells=tells) for place in PLACES}
    client, caller = client_of(sites)
    assert sites.run(10, follow(client, 3))

    def call(_: int) -> None:
        caller.call(switch(on=True))

    for _ in range(6):
        place = dice.choice(PLACES)
        sites.every(0.02, 20, call)
        sites.run(dice.uniform(0, 0.4))
        sites.kill(live[place][0])
        sites.run(dice.uniform(0.1, 1.5))
        counter = Counter(FakeGraph(2, known.channels(), known.services()), tells)
        sites.world.restart_member(place)
        assert sites.world.run_until_attached()
        live[place] = sites.add(place, expose=[rule(tells=tells)], graph=counter.graph), counter
    assert sites.run(30, lambda: len(caller.outcomes) == 120)
    assert sites.run(30, lambda: [each.count for _, each in live.values()] == [120] * 3)
    assert caller.outcomes == [switched(str(number + 1)) for number in range(120)]


def test_a_node_that_restarts_under_its_proxy_takes_on_the_others_state(sites: Sites) -> None:
    (machine, counter), (_, other) = start(sites, PLACES[0]), start(sites, PLACES[1])
    client, caller = client_of(sites)
    assert sites.run(10, follow(client, 2))
    for _ in range(5):
        caller.call(switch(on=True))
    assert sites.run(5, lambda: [counter.count, other.count] == [5, 5])
    counter.die()
    again = Counter(machine.graph)
    caller.call(switch(on=True))
    assert sites.run(10, lambda: [again.count, other.count] == [6, 6])


def test_a_second_client_is_refused_with_a_reason_until_the_first_is_gone(sites: Sites) -> None:
    _, counter = start(sites, PLACES[0])
    first, caller = client_of(sites)
    assert sites.run(10, follow(first, 1))
    second, other = client_of(sites, "nuc3/second")
    assert sites.run(5, other.sees_server)
    sites.run(3)
    other.call(switch(on=True))
    assert sites.run(1, lambda: other.outcomes == [f"kept in order by {first.member.name.short}"])
    caller.call(switch(on=True))
    assert sites.run(2, lambda: caller.outcomes == [switched("1")])
    sites.leave(first)
    assert sites.run(30, follow(second, 1))
    other.call(switch(on=True))
    assert sites.run(2, lambda: other.outcomes[1:] == [switched("2")])
    assert counter.count == 2


def test_a_client_that_restarts_goes_on_with_what_was_counted(sites: Sites) -> None:
    counters = [start(sites, place)[1] for place in PLACES]
    client, caller = client_of(sites)
    assert sites.run(10, follow(client, 3))
    for _ in range(3):
        caller.call(switch(on=True))
    assert sites.run(5, lambda: [each.count for each in counters] == [3] * 3 and len(caller.outcomes) == 3)
    client = sites.restart(client)
    sites.run(0.5)
    assert sites.run(20, follow(client, 3))
    caller.call(switch(on=True))
    assert sites.run(5, lambda: caller.outcomes[3:] == [switched("4")])
    assert sites.run(5, lambda: [each.count for each in counters] == [4] * 3)


@pytest.mark.parametrize("ordered_side", ["expose", "import"])
def test_both_sides_must_say_that_state_is_kept(sites: Sites, ordered_side: str) -> None:
    plain = RULE.replace(", state: ordered", "")
    counter = Counter(FakeGraph(2, known.channels(), known.services()), tells=False)
    sites.add(PLACES[0], expose=[RULE if ordered_side == "expose" else plain], graph=counter.graph)
    client = sites.add(ROBOT, imports=[plain if ordered_side == "expose" else RULE])
    caller = Client(client.graph)
    sites.run(5)
    assert not caller.sees_server()
    assert client.faults == {"other-type": 1}


def test_the_state_outlives_all_servers_while_the_client_lives(sites: Sites) -> None:
    machine, counter = start(sites, PLACES[0])
    client, caller = client_of(sites)
    assert sites.run(10, follow(client, 1))
    for _ in range(3):
        caller.call(switch(on=True))
    assert sites.run(5, lambda: counter.count == 3 and len(caller.outcomes) == 3)
    sites.kill(machine)
    assert sites.run(30, lambda: not caller.sees_server())
    _, fresh = start(sites, PLACES[1])
    assert sites.run(10, follow(client, 1))
    caller.call(switch(on=True))
    assert sites.run(5, lambda: caller.outcomes[3:] == [switched("4")])
    assert fresh.count == 4
