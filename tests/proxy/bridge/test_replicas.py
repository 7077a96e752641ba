"""Services and actions of several servers: every call ends once, whichever server dies, and the others are informed."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from gdp.client.delivery import Delivered
from gdp.client.participant import Message
from gdp.service.dispatch import Dispatch
from gdp.service.frames import Answer, Outcome
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.bridge.imported_service import ImportedService
from proxy.endpoints.core.qos import default
from proxy.serial.channel import RosVersion
from tests.draws import TIMES
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, TRIGGER, switch, switched
from tests.proxy.bridge.sites import ROBOT, Ear, Machine, Sites
from tests.proxy.bridge.test_actions import (
    ACCEPTED,
    AT,
    CDR,
    RULE,
    STATUS,
    ActionClient,
    ActionServer,
    goal,
    goal_id,
    result,
    sequence,
)

SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
PLACES = ("nuc3/a", "nuc3/b", "nuc5/c")
MODES = ["mode: all", "mode: some, copies: 2", "mode: hedged, budget: 0.5", "mode: nearest"]


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def heard_by(client: Machine, servers: int) -> Callable[[], bool]:
    """Return a condition: a client's proxy may call this many servers."""
    flow = client.bridge.flows[0][1]
    assert isinstance(flow, ImportedService)
    return lambda: all(len(calls.servers) == servers for calls in flow._calls)


def replicas(
    sites: Sites, count: int = 3, *, expose: str = SWITCH, mode: str = MODES[0], timeout_s: float = 60
) -> tuple[list[Machine], list[LocalServer], Machine, Client]:
    """Return servers' machines and their local servers, which do not answer, the client's machine and a client."""
    machines = [sites.add(place, expose=[expose]) for place in PLACES[:count]]
    locals_ = [LocalServer(machine.graph) for machine in machines]
    client = sites.add(ROBOT, imports=[f"{SWITCH}, timeout_s: {timeout_s}, replication: {{{mode}}}"])
    sites.run(0.5)
    assert sites.run(5, heard_by(client, count))
    return machines, locals_, client, Client(client.graph)


def flow(sites: Sites, caller: Client, period_s: float, count: int) -> None:
    """Let a client call repeatedly."""

    def call(number: int) -> None:
        caller.call(switch(on=number % 2 == 1))

    sites.every(period_s, count, call)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(1, 1 + TIMES))
def test_any_two_of_three_die_while_requests_flow_and_each_is_answered_once(sites: Sites, mode: str, seed: int) -> None:
    dice = random.Random(seed)
    machines, locals_, _, caller = replicas(sites, mode=mode, timeout_s=5)
    for local in locals_:
        local.answer = lambda raw: switched(str(raw[-1]))
    dice.shuffle(machines)
    for machine in machines[:2]:
        sites.world.network.call(dice.uniform(0.2, 4), partial(sites.kill, machine))
    flow(sites, caller, 0.02, 300)
    sites.run(12)
    wrong = {number: each for number, each in caller.got.items() if each != [switched(str(number % 2))]}
    assert (len(caller.got), wrong) == (300, {})


def test_a_call_under_way_is_answered_by_a_server_that_arrives_after_all_it_was_sent_to_died(sites: Sites) -> None:
    machines, locals_, client, caller = replicas(sites, 1)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: locals_[0].asked == 1)
    later = sites.add(PLACES[1], expose=[SWITCH])
    fresh = LocalServer(later.graph)
    assert sites.run(3, lambda: fresh.asked == 1)
    sites.kill(machines[0])
    assert sites.run(10, heard_by(client, 1))
    fresh.waiting[0][1](switched("still"))
    assert sites.run(1, lambda: caller.outcomes == [switched("still")])


def test_a_late_first_copy_is_hedged_and_then_cancelled(sites: Sites) -> None:
    trigger = f"{SWITCH}, stop: /switch/stop, at_once: 1"
    machines, locals_, _, caller = replicas(sites, 2, expose=trigger, mode="mode: hedged, budget: 1")
    stops = [LocalServer(machine.graph, "/switch/stop", TRIGGER, lambda _: CDR + b"\1") for machine in machines]
    caller.call(switch(on=True))
    assert sites.run(1, lambda: [local.asked for local in locals_] in ([1, 0], [0, 1]))
    assert sites.run(0.2, lambda: [local.asked for local in locals_] == [1, 1])
    locals_[1].waiting[0][1](switched("yes"))
    assert sites.run(0.1, lambda: caller.outcomes == [switched("yes")])
    sites.run(0.5)
    assert [stop.asked for stop in stops] == [1, 0]


def test_the_nearest_server_alone_is_asked_wherever_the_robot_is_and_the_next_one_after_its_death(
    tmp_path: Path,
) -> None:
    nodes = ("nuc1", "nuc3", "nuc5")
    links = tuple(Link(*ends) for ends in pairwise(nodes))
    sites = Sites(tmp_path, topology=Topology(links, (DomainPlan("lab", nodes),), (Attachment("nuc1", "rib", "rib"),)))
    machines = [sites.add(place, expose=[SWITCH]) for place in ("nuc5/far", "nuc3/near")]
    locals_ = [LocalServer(machine.graph, answer=lambda _: switched("yes")) for machine in machines]
    client = sites.add(ROBOT, imports=[f"{SWITCH}, timeout_s: 60, replication: {{mode: nearest}}"])
    caller, far = Client(client.graph), machines[0].member.name.short
    sites.run(0.5)
    assert sites.run(5, heard_by(client, 2))
    imported = client.bridge.flows[0][1]
    assert isinstance(imported, ImportedService)

    def asked(count: int) -> list[int]:
        """Call, and return how many requests each server has had."""
        flow(sites, caller, 0.05, count)
        sites.run(0.05 * count + 0.3)
        return [local.asked for local in locals_]

    assert asked(10) == [0, 10]
    sites.world.roam(ROBOT, "nuc5")
    sites.run(1)
    assert asked(10) == [10, 10]
    assert imported.ranking(sites.now_s)[0] == f"{far} (cost 0)"
    sites.kill(machines[0])
    caller.call(switch(on=True))
    assert sites.run(0.35, lambda: len(caller.outcomes) == 21)
    assert imported.ranking(sites.now_s)[1] == f"{far} (cost 0, silent)"


def test_what_waits_at_a_server_when_its_call_ends_is_never_given_to_it(sites: Sites) -> None:
    machines, (slow, fast), _, caller = replicas(sites, 2, expose=f"{SWITCH}, at_once: 1")
    fast.answer = lambda _: switched("fast")
    for _ in range(20):
        caller.call(switch(on=True))
    assert sites.run(2, lambda: caller.outcomes == [switched("fast")] * 20)
    sites.run(0.5)
    assert slow.asked == 1
    slow.waiting[0][1](switched("slow"))
    sites.run(0.5)
    assert (slow.asked, len(caller.outcomes)) == (1, 20)
    fast.answer = None
    caller.call(switch(on=False))
    assert sites.run(1, lambda: slow.asked == 2)
    assert machines[0].faults == {}


def test_an_answer_of_somebody_without_a_delegation_is_not_taken(sites: Sites) -> None:
    _, locals_, client, caller = replicas(sites, 2)
    forger = sites.add("nuc3/forger")
    caller.call(switch(on=True))
    assert sites.run(1, lambda: locals_[0].asked == 1)
    flow = client.bridge.flows[0][1]
    assert isinstance(flow, ImportedService)
    dispatch = flow._calls[0]
    assert isinstance(dispatch, Dispatch)
    (call,) = (number for number, _ in dispatch._calls)
    wire = Answer(0, call, Outcome.ANSWERED, b'{"success":true,"message":"forged"}').to_wire()
    delivered = Delivered(bytes(forger.member.name), 1, 1, wire, 1, 1)
    flow.receive(Message(flow.topic.name, delivered, b"", True), sites.now_s)
    assert caller.outcomes == []
    locals_[0].waiting[0][1](switched("right"))
    assert sites.run(1, lambda: caller.outcomes == [switched("right")])


@pytest.mark.parametrize("here", [1, 2])
def test_servers_of_either_ros_stand_in_for_each_other(sites: Sites, here: RosVersion) -> None:
    kinds: tuple[RosVersion, ...] = (1, 2, 2)
    machines = [sites.add(place, expose=[SWITCH], ros=ros) for place, ros in zip(PLACES, kinds, strict=True)]
    locals_ = [LocalServer(machine.graph) for machine in machines]
    client = sites.add(ROBOT, imports=[SWITCH], ros=here)
    sites.run(0.5)
    assert sites.run(5, heard_by(client, 3))
    caller = Client(client.graph)
    for number, (machine, local) in enumerate(zip(machines, locals_, strict=True)):
        caller.call(switch(on=True, ros=here))
        sites.run(0.5)
        local.waiting[number][1](switched("yes", machine.graph.ros))
        sites.run(0.5)
        assert caller.got[number] == [switched("yes", here)]


def test_a_server_that_drains_answers_what_it_has_and_gets_nothing_new(sites: Sites) -> None:
    machines, (first, second), client, caller = replicas(sites, 2, mode="mode: some, copies: 2")
    caller.call(switch(on=True))
    assert sites.run(1, lambda: first.asked == second.asked == 1)
    machines[0].bridge.drain(sites.now_s)
    sites.run(1.5)
    assert heard_by(client, 2)()
    second.answer = lambda _: switched("second")
    assert not machines[0].bridge.is_drained(sites.now_s)
    first.waiting[0][1](switched("first"))
    assert sites.run(1, lambda: caller.outcomes == [switched("first")])
    assert sites.run(0.5, lambda: machines[0].bridge.is_drained(sites.now_s))
    sites.leave(machines[0])
    for _ in range(20):
        caller.call(switch(on=False))
    assert sites.run(2, lambda: caller.outcomes[1:] == [switched("second")] * 20)
    assert first.asked == 1


def test_a_server_that_drains_stays_until_the_client_has_its_response(sites: Sites) -> None:
    (machine,), (local,), _, caller = replicas(sites, 1)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    machine.bridge.drain(sites.now_s)
    sites.run(1.5)
    lead = sites.world.leads[PLACES[0]]
    lead.loss = 1.0  # the response and its repetitions
    local.waiting[0][1](switched("done"))
    assert not sites.run(0.4, lambda: machine.bridge.is_drained(sites.now_s))
    lead.loss = 0.0
    assert sites.run(2, lambda: machine.bridge.is_drained(sites.now_s))
    sites.leave(machine)
    sites.run(1)
    assert caller.outcomes == [switched("done")]


def test_the_only_server_still_answers_while_it_says_that_it_leaves(sites: Sites) -> None:
    (machine,), (local,), _, caller = replicas(sites, 1, mode="mode: hedged")
    local.answer = lambda _: switched("yes")
    machine.bridge.drain(sites.now_s)
    flow(sites, caller, 0.1, 8)
    sites.run(2)
    assert caller.outcomes == [switched("yes")] * 8
    assert machine.bridge.is_drained(sites.now_s)


def test_many_calls_of_a_fast_and_a_slow_server_cost_few_words(sites: Sites) -> None:
    _, (slow, fast), client, caller = replicas(sites, 2)
    fast.answer = lambda _: switched("fast")
    before = client.context.traffic.messages_out
    for _ in range(50):
        caller.call(switch(on=True))
    assert sites.run(2, lambda: len(caller.outcomes) == 50)
    sites.run(0.1)
    assert slow.asked == 8  # what its queue holds; the other calls were answered before their turn came
    assert 51 <= client.context.traffic.messages_out - before <= 58, "a stop for each eight"


def actions(
    sites: Sites, count: int = 2, mode: str = MODES[0]
) -> tuple[list[Machine], list[ActionServer], Machine, ActionClient]:
    """Return servers' machines and their action servers, the client's machine and a client."""
    machines = [sites.add(place, expose=[RULE]) for place in PLACES[:count]]
    servers = [ActionServer(machine.graph) for machine in machines]
    client = sites.add(ROBOT, imports=[f"{RULE}, replication: {{{mode}}}"])
    sites.run(0.5)
    assert sites.run(5, heard_by(client, count))
    return machines, servers, client, ActionClient(client.graph)


def status(number: int, code: int) -> bytes:
    return CDR + struct.pack("<I", 1) + bytes([number]) * 16 + struct.pack("<iIB", 1, 0, code)


def accepted(sites: Sites, servers: list[ActionServer], caller: ActionClient) -> None:
    """Let the client send a goal, and ask for its result."""
    caller.goals.call(goal(1, 10))
    assert sites.run(1, lambda: caller.goals.outcomes == [ACCEPTED])
    caller.results.call(goal_id(1))
    assert sites.run(1, lambda: any(server.results.waiting for server in servers))
    sites.run(0.5)


def test_a_goal_goes_to_all_and_the_losers_is_cancelled(sites: Sites) -> None:
    _, servers, _, caller = actions(sites)
    accepted(sites, servers, caller)
    assert [len(server.results.waiting) for server in servers] == [1, 1]
    servers[0].results.waiting[0][1](result(1))
    assert sites.run(1, lambda: caller.results.outcomes == [result(1)])
    sites.run(0.5)
    assert [server.cancels.asked for server in servers] == [0, 1]


def test_feedback_comes_from_one_server_and_when_that_dies_from_another_as_does_the_result(sites: Sites) -> None:
    machines, servers, client, caller = actions(sites)
    servers[1].goals.answer = None  # so that the acceptance of the first one counts
    accepted(sites, servers, caller)
    servers[1].goals.waiting[0][1](ACCEPTED)
    sites.run(0.5)
    for number, server in enumerate(servers):
        server.feedback.publish(sequence(1, number))
    sites.run(0.5)
    assert caller.feedback.heard == [sequence(1, 0)]
    sites.kill(machines[0])
    assert sites.run(10, heard_by(client, 1))
    servers[1].feedback.publish(sequence(1, 2))
    servers[1].results.waiting[0][1](result(2))
    assert sites.run(1, lambda: caller.results.outcomes == [result(2)])
    assert caller.feedback.heard == [sequence(1, 0), sequence(1, 2)]


def test_a_losers_status_does_not_contradict_the_result(sites: Sites) -> None:
    _, servers, client, caller = actions(sites)
    ear = Ear(client.graph, f"{AT}status", STATUS, default(latched=True, depth=1), node="/client")
    said = [next(p for p in server.graph.publications if p.end.name == f"{AT}status") for server in servers]
    accepted(sites, servers, caller)
    for publication in said:
        publication.publish(status(1, 2))
    sites.run(0.5)
    servers[0].results.waiting[0][1](result(1))
    sites.run(0.5)
    for publication, code in zip(said, (4, 5), strict=True):
        publication.publish(status(1, code))
    sites.run(0.5)
    assert ear.heard == [status(1, 2), status(1, 4)]


def test_a_server_that_does_not_know_the_goal_or_rejects_it_does_not_end_it(sites: Sites) -> None:
    _, servers, _, caller = actions(sites)
    servers[0].goals.answer = lambda _: CDR + b"\0"
    servers[0].results.answer = lambda _: CDR + bytes(8)
    accepted(sites, servers, caller)
    assert (caller.goals.outcomes, caller.results.outcomes) == ([ACCEPTED], [])
    servers[1].results.waiting[0][1](result(1))
    assert sites.run(1, lambda: caller.results.outcomes == [result(1)])


@pytest.mark.parametrize("mode", [MODES[0], "mode: some, copies: 1", "mode: hedged"])
def test_a_server_that_arrives_takes_up_the_goal_when_the_other_dies(sites: Sites, mode: str) -> None:
    machines, servers, client, caller = actions(sites, 1, mode)
    accepted(sites, servers, caller)
    later = ActionServer(sites.add(PLACES[1], expose=[RULE]).graph)
    assert sites.run(5, heard_by(client, 2))
    sites.run(0.5)
    sites.kill(machines[0])
    assert sites.run(10, heard_by(client, 1))
    assert sites.run(1, lambda: later.goals.asked == 1 and len(later.results.waiting) == 1)
    later.results.waiting[0][1](result(7))
    assert sites.run(1, lambda: caller.results.outcomes == [result(7)])


def test_a_clients_cancel_goes_to_all(sites: Sites) -> None:
    _, servers, _, caller = actions(sites, mode="mode: some, copies: 2")
    accepted(sites, servers, caller)
    caller.cancels.call(goal_id(1))
    assert sites.run(1, lambda: caller.cancels.outcomes != [])
    sites.run(0.5)
    assert [server.cancels.asked for server in servers] == [1, 1]
