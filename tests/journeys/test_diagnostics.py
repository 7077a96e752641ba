"""Diagnostic requests across the ring: who answers, who learns what, and that nothing amplifies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from gdp.client.participant import Participant
from gdp.control.diagnostics import Question, Reply
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.frame.pace import pace_of
from gdp.limits import DIAGNOSTICS_RATE, HOPS_MAX
from gdp.names import ZERO, Name
from gdp.sansio import Timestamps
from gdp.switch.core import SwitchCore
from gdp.trust.domain import Policy
from lab.simulation import Simulation
from lab.topology import MTU_BYTES, flat_topology
from tests.journeys.flows import ROBOT, SERVER, Flow, flowing, ring

pytestmark = pytest.mark.momentary("a request and its reply take milliseconds")

KINDS = (Kind.DIAGNOSTIC_REQUEST, Kind.DIAGNOSTIC_REPLY)


@dataclass
class Asker:
    """Member of the ring that asks, and what came back."""

    world: Simulation
    label: str = ROBOT
    replies: list[Reply | None] = field(default_factory=list)
    rtts_s: list[float] = field(default_factory=list)

    @property
    def core(self) -> Participant | SwitchCore:
        """Return the protocol core of the member."""
        member = self.world.members.get(self.label)
        return self.world.switches[self.label] if member is None else member

    def ask(
        self, target: Name, ask: str, name: Name = ZERO, hops: int = HOPS_MAX, reply_bytes: int = 0
    ) -> Reply | None:
        """Ask, and return what came within half a second."""
        before = len(self.replies)
        self.send(target, ask, name, hops, reply_bytes)
        assert self.world.network.run(2, lambda: len(self.replies) > before)
        return self.replies[-1]

    def send(self, target: Name, ask: str, name: Name = ZERO, hops: int = HOPS_MAX, reply_bytes: int = 0) -> None:
        """Send a request."""

        def note(reply: Reply | None, rtt_s: float) -> None:
            self.replies.append(reply)
            self.rtts_s.append(rtt_s)

        now = self.world.network.now
        self.core.diagnostics.ask(
            target, ask, now=now, on_reply=note, name=name, hops=hops, reply_bytes=reply_bytes, timeout_s=0.5
        )
        self.world.network.send_pending(self.label)


@pytest.fixture
def flow() -> Flow:
    """Return a topic from the robot to the server, and its tree."""
    return flowing(ring())


def counted(world: Simulation) -> list[tuple[str, str, int, int]]:
    """Return a list that gets the ends, the kind and the bytes of every diagnostic frame on a link from now on."""
    seen: list[tuple[str, str, int, int]] = []

    def tap(_at_s: float, a: str, b: str, frame: bytes) -> None:
        header = decode(frame, ETHER_BYTES)
        if header.kind in KINDS:
            seen.append((a, b, header.kind, len(frame)))

    world.network.taps.append(tap)
    return seen


def test_a_ping_reaches_the_publisher_by_the_path_of_data(flow: Flow) -> None:
    asker = Asker(flow.world, SERVER)
    seen = counted(flow.world)
    reply = asker.ask(flow.world.members[ROBOT].name, "ping", flow.topic.name)
    assert reply is not None
    assert (dict(reply.result), reply.switches) == ({"rights": ["publish"]}, 5)
    assert {(a, b) for a, b, kind, _ in seen if kind == Kind.DIAGNOSTIC_REQUEST} == {
        (SERVER, "nuc5"), ("nuc5", "nuc4"), ("nuc4", "nuc3"), ("nuc3", "nuc2"), ("nuc2", "nuc1"), ("nuc1", ROBOT),
    }  # fmt: skip


def test_a_second_ping_needs_no_certificates_and_one_frame_each_way(flow: Flow) -> None:
    asker = Asker(flow.world, SERVER)
    target = flow.world.members[ROBOT].name
    asker.ask(target, "ping")
    seen = counted(flow.world)
    assert asker.ask(target, "ping") is not None
    assert [kind for a, b, kind, _ in seen if SERVER in (a, b)] == list(KINDS)


def test_the_switch_where_the_hops_end_answers(flow: Flow) -> None:
    world = flow.world
    asker, target = Asker(world), world.members[SERVER].name
    asker.ask(target, "ping")
    names = []
    for hops in range(1, 7):
        reply = asker.ask(target, "trace", flow.topic.name, hops, 2_000)
        assert reply is not None
        names.append(reply.member.name)
    assert names == [*(world.switches[f"nuc{i}"].name for i in range(1, 6)), target]


def test_a_switch_of_our_domain_tells_links_and_branches(flow: Flow) -> None:
    world = flow.world
    world.switches["nuc1"].diagnostic_answers.port_name = "eth{}".format
    asker, target = Asker(world), world.members[SERVER].name
    asker.ask(target, "ping")
    reply = asker.ask(target, "trace", flow.topic.name, 1, 2_000)
    assert reply is not None
    assert not reply.is_withheld
    out, (branch,) = reply.result["out"], reply.result["branches"]
    assert (out["to"], out["role"], str(out["port"])[:3]) == (world.switches["nuc2"].name, "switch", "eth")
    assert branch["to"] == world.switches["nuc2"].name
    assert branch["p"] == world.members[ROBOT].name
    assert "kbit_s" not in branch
    for tree in world.switches["nuc1"].multicast.trees.all():
        for each in tree.branches.values():
            each.pace = pace_of(125_000)
    reply = asker.ask(target, "trace", flow.topic.name, 1, 2_000)
    assert reply is not None
    assert [each["kbit_s"] for each in reply.result["branches"]] == [1_020]


def test_branches_are_shown_to_those_with_a_right_on_the_name_and_to_switches() -> None:
    world = Simulation(topology=flat_topology(pairwise("abcd"), mtu=MTU_BYTES, rib="b", members="abc"))
    assert world.run_until_attached()
    name = flowing(world, source="a/end", readers=("b/end",)).topic.name
    target = world.switches["b"].name  # where the tree has its branch to the reader
    shown = {}
    for label in ("a/end", "b/end", "c/end", "d"):
        reply = Asker(world, label).ask(target, "trace", name, reply_bytes=2_000)
        assert reply is not None
        shown[label] = len(reply.result["branches"]) if "branches" in reply.result else 0
    assert shown == {"a/end": 1, "b/end": 1, "c/end": 0, "d": 1}
    thief = world.members["c/end"]
    thief.diagnostics.evidence_of = world.members["b/end"].attachment.evidence_of
    reply = Asker(world, "c/end").ask(target, "trace", name, reply_bytes=2_000)
    assert reply is not None
    assert ("branches" in reply.result, reply.result["w"]) == (False, DropReason.NOT_DELEGATED.label)


def test_a_switch_of_another_domain_tells_nothing_but_that_it_is_there(flow: Flow) -> None:
    reply = Asker(flow.world).ask(flow.world.members[SERVER].name, "trace", flow.topic.name, 3, 2_000)
    assert reply is not None
    assert (dict(reply.result), reply.is_withheld) == ({}, True)
    assert reply.member.domain == flow.world.authorities["backbone"].root.domain


def test_a_policy_may_tell_another_domain_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Simulation.policy

    def open_to_school(world: Simulation, domain: str) -> Policy:
        policy = made(world, domain)
        school = world.authorities["school"].root.domain
        return Policy(policy.roots[policy.own], policy.roots.values(), policy.transit, diagnostics=[school])

    monkeypatch.setattr(Simulation, "policy", open_to_school)
    world = ring()
    asker, target = Asker(world), world.members[SERVER].name
    asker.ask(target, "ping")  # so that all tables have the path
    reply = asker.ask(target, "trace", ZERO, 3, 2_000)
    assert reply is not None
    assert not reply.is_withheld
    assert "out" in reply.result


def test_an_attached_node_learns_where_a_name_is_advertised(flow: Flow) -> None:
    world = flow.world
    reply = Asker(world, SERVER).ask(world.switches["nuc5"].name, "resolve", flow.topic.name, reply_bytes=2_000)
    assert reply is not None
    (place,) = (each for each in reply.result["places"] if each["right"] == "publish")
    assert (place["node"], place["switch"]) == (world.members[ROBOT].name, world.switches["nuc1"].name)


def test_a_name_that_the_switch_does_not_know_is_queried_first() -> None:
    world = ring()
    flow = flowing(world, readers=())
    world.network.run(2)  # the RIBs know it
    switch = Asker(world, "nuc5")  # asks itself, of a name that no node here reads
    reply = switch.ask(world.switches["nuc5"].name, "resolve", flow.topic.name)
    assert reply is not None
    assert [each["node"] for each in reply.result["places"]] == [world.members[ROBOT].name]


def test_a_switch_resolves_for_its_own_nodes_only(flow: Flow) -> None:
    reply = Asker(flow.world).ask(flow.world.switches["nuc2"].name, "resolve", flow.topic.name)
    assert reply is not None
    assert reply.result == {"places": []}


def test_a_rib_answers_a_ping(flow: Flow) -> None:
    rib = flow.world.ribs["school"]
    reply = Asker(flow.world).ask(rib.name, "ping")
    assert reply is not None
    assert reply.member.name == rib.name


def test_no_reply_is_longer_than_its_request(flow: Flow) -> None:
    world = flow.world
    asker, seen = Asker(world), counted(world)
    many = [{"n": number.to_bytes(2, "big") * 16} for number in range(300)]
    world.switches["nuc2"].diagnostics.register("many", lambda question, now: {"many": many, "few": 1})
    kept = 0
    for length in (0, 900, 2_000, 8_000):
        seen.clear()
        reply = asker.ask(world.switches["nuc2"].name, "many", reply_bytes=length)
        assert reply is not None
        assert reply.is_cut
        lengths = [sum(size for a, b, kind, size in seen if kind == each and ROBOT in (a, b)) for each in KINDS]
        assert lengths[0] >= lengths[1]
        kept = len(reply.result["many"]) if "many" in reply.result else 0
    assert kept > 150


def test_an_unknown_ask_is_refused_with_a_word(flow: Flow) -> None:
    reply = Asker(flow.world).ask(flow.world.switches["nuc1"].name, "dance")
    assert reply is not None
    assert reply.error == "unknown-ask"


def test_nothing_comes_back_from_a_member_that_is_gone(flow: Flow) -> None:
    flow.world.network.stop(SERVER)
    asker = Asker(flow.world)
    assert asker.ask(flow.world.members[SERVER].name, "ping") is None
    assert asker.rtts_s[-1] >= 0.5


def test_one_member_gets_no_more_replies_than_its_rate(flow: Flow) -> None:
    asker = Asker(flow.world)
    for _ in range(2 * int(DIAGNOSTICS_RATE.burst)):
        asker.send(flow.world.switches["nuc1"].name, "ping")
    flow.world.network.run(1)
    answered = [reply for reply in asker.replies if reply is not None]
    assert int(DIAGNOSTICS_RATE.burst) <= len(answered) <= int(DIAGNOSTICS_RATE.burst) + 2
    assert flow.world.switches["nuc1"].drops()[DropReason.RATE_LIMITED]


def test_a_recorded_request_gets_no_second_reply(flow: Flow) -> None:
    world = flow.world
    sent: list[bytes] = []

    def record(_at_s: float, a: str, b: str, frame: bytes) -> None:
        if (a, b) == (ROBOT, "nuc1") and decode(frame, ETHER_BYTES).kind == Kind.DIAGNOSTIC_REQUEST:
            sent.append(frame)

    world.network.taps.append(record)
    assert Asker(world).ask(world.switches["nuc1"].name, "ping") is not None
    before, seen = len(sent), counted(world)
    for frame in sent[:before]:
        port = next(iter(world.switches["nuc1"].hello_protocol.ports))
        mac = frame[6:12]
        for each in world.switches["nuc1"].hello_protocol.ports:
            if any(n.mac == mac for n in world.switches["nuc1"].hello_protocol.ports[each].neighbours.values()):
                port = each
        world.network.inject("nuc1", port, frame[ETHER_BYTES:], mac)
    world.network.run(0.2)
    assert not [each for each in seen if each[2] == Kind.DIAGNOSTIC_REPLY]
    assert world.switches["nuc1"].drops()[DropReason.REPLAYED]


def test_a_request_that_a_tree_copies_gets_no_reply(flow: Flow) -> None:
    """The publisher of a topic sends a request to the topic itself, which its tree would multiply."""
    world = flow.world
    for hops in (2, 3, HOPS_MAX):
        seen = counted(world)
        asker = Asker(world)
        assert asker.ask(flow.topic.name, "trace", flow.topic.name, hops) is None
        assert not [each for each in seen if each[2] == Kind.DIAGNOSTIC_REPLY]


def test_what_is_not_signed_by_its_source_is_refused(flow: Flow) -> None:
    world = flow.world
    switch = world.switches["nuc1"]
    before = switch.drops().get(DropReason.UNKNOWN_SENDER, 0)
    member = world.members[ROBOT]
    frames: list[bytes] = []
    member.diagnostics._send = lambda made, _to, _now: frames.extend(made)
    Asker(world).send(switch.name, "ping")
    spoofed = [frame[:64] + world.members[SERVER].name + frame[96:] for frame in frames]
    member.attachment.send(spoofed)
    world.network.send_pending(ROBOT)
    seen = counted(world)
    world.network.run(0.2)
    assert switch.drops()[DropReason.UNKNOWN_SENDER] == before + 1
    assert not [each for each in seen if each[2] == Kind.DIAGNOSTIC_REPLY]


def test_an_answer_may_come_later(flow: Flow) -> None:
    world = flow.world
    known: list[Mapping[str, object]] = []
    switch = world.switches["nuc2"]

    def answer(_question: Question, _now: Timestamps) -> Mapping[str, object] | None:
        return known[0] if known else None

    switch.diagnostics.register("later", answer)
    world.network.call(0.2, lambda: known.append({"x": 1}))
    reply = Asker(world).ask(switch.name, "later")
    assert reply is not None
    assert reply.result == {"x": 1}
    known.clear()
    asker = Asker(world)
    asker.send(switch.name, "later")
    world.network.run(1.5)
    assert asker.replies == [None]


def test_a_switch_that_asks_itself_queries_its_rib_at_once() -> None:
    world = ring()
    flow = flowing(world, readers=())
    world.network.run(3)  # so that no timer of the switch is due
    asker = Asker(world, "nuc5")
    asker.ask(world.switches["nuc5"].name, "resolve", flow.topic.name)
    assert asker.rtts_s[-1] < 0.05


def test_a_switch_and_a_rib_are_found_by_their_own_names(flow: Flow) -> None:
    world = flow.world
    for name in (world.switches["nuc2"].name, world.ribs["school"].name):
        reply = Asker(world).ask(world.switches["nuc1"].name, "resolve", name)
        assert reply is not None
        assert [each["node"] for each in reply.result["places"]] == [name]
