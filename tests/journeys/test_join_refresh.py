"""Joins renewed by number: few frames, no tree lost with a lost join, and no branch without proof for long."""

from __future__ import annotations

from collections import Counter

import pytest

from gdp.control.join import JoinRefresh
from gdp.control.neighbour import Neighbour
from gdp.crypto.identity import Identity
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, HEADER_BYTES, Kind, decode
from gdp.intervals import JOIN, SoftState
from gdp.limits import JOINS_AGAIN_MAX
from gdp.switch import multicast, upstream_joins
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology, chain
from tests.journeys.flows import Flow, advertise, flowing
from tests.journeys.test_attacks import counted
from tests.lanes import nightly

ROBOT, READER = "s1/left", "s2/right"
TOPICS = 40
PROOF = SoftState(30.0, periods=3)  # half of the real time, so that each tree shows its proof sooner


class Joins:
    """Whole joins, refreshes and the bytes of both that enter the cable, towards the publisher."""

    def __init__(self, world: Simulation, a: str = "s2", b: str = "s1") -> None:
        self.whole: set[int] = set()
        self.refreshes: set[int] = set()
        self.bytes = 0
        self.frames: list[bytes] = []  # of refreshes, from the header on
        self._ends = a, b
        world.network.taps.append(self._note)

    def _note(self, _at_s: float, a: str, b: str, frame: bytes) -> None:
        header = decode(frame, ETHER_BYTES)
        if (a, b) != self._ends or header.kind not in (Kind.JOIN, Kind.JOIN_REFRESH):
            return
        self.bytes += HEADER_BYTES + header.length
        (self.whole if header.kind == Kind.JOIN else self.refreshes).add(header.number)
        if header.kind == Kind.JOIN_REFRESH:
            self.frames.append(frame[ETHER_BYTES:])


def two_switches(topics: int = 1) -> tuple[Simulation, list[Flow]]:
    world = Simulation(topology=chain(2))
    assert world.run_until_attached()
    flows = [advertise(world, f"/t{number}", ROBOT) for number in range(topics)]
    for flow in flows:
        flow.read_by(READER)
    assert world.network.run(5, lambda: all(flow.is_read_by(1) for flow in flows))
    return world, flows


def neighbour(world: Simulation, at: str, label: str) -> tuple[Neighbour, Identity]:
    """Return a switch as another one knows it, and its identity."""
    name = world.switches[label].name
    (found,) = (each for each in world.switches[at].hello_protocol.neighbours.all_up() if each.name == name)
    (identity,) = (each for each in world.identities.values() if each.name == name)
    return found, identity


def inject(world: Simulation, at: str, sender: Neighbour, wire: bytes) -> None:
    """Let a neighbour say this to a switch, or an attached node."""
    for frame in world.switches["s1"].state.outbox.fragmenter.split(Kind.JOIN_REFRESH, wire, 1_500):
        world.network.inject(at, sender.port, frame, sender.mac)


def test_forty_trees_are_renewed_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (upstream_joins, multicast):
        monkeypatch.setattr(module, "JOIN_PROOF", PROOF)
    world, flows = two_switches(TOPICS)
    world.network.run(2 * JOIN.refresh_s)  # all have settled
    joins, seconds = Joins(world), 4 * JOIN.refresh_s
    world.network.run(seconds)
    assert len(joins.refreshes) == len(joins.frames) <= 5
    assert not joins.whole
    assert all(len(world.switches["s1"].multicast.trees.of_topic(flow.topic.name)) == 1 for flow in flows)
    joins.bytes = 0
    world.network.run(PROOF.refresh_s)
    assert TOPICS <= len(joins.whole) <= 2 * TOPICS  # proofs, each tree at a time of its own
    whole = PROOF.refresh_s / JOIN.refresh_s * TOPICS * 3_400  # what the same costs with whole joins
    assert joins.bytes < whole / 10
    flows[0].outlive()


def test_a_join_that_was_lost_is_sent_again_when_its_number_is_unknown() -> None:
    world, (flow,) = two_switches()
    world.network.run(2 * JOIN.refresh_s)
    cable = world.cables[frozenset(("s1", "s2"))]
    other, joins = advertise(world, "/other", ROBOT), Joins(world)

    def lose(_at_s: float, a: str, _b: str, frame: bytes) -> None:
        cable.loss = float(a == "s2" and decode(frame, ETHER_BYTES).kind == Kind.JOIN and len(joins.whole) <= 1)

    world.network.taps.append(lose)
    other.read_by(READER)
    assert world.network.run(1, lambda: other.is_read_by(1))
    assert len(joins.whole) == 2
    other.publish(b"it is there")
    assert world.network.run(1, lambda: other.has(READER, 1))
    flow.outlive()


def test_of_many_unknown_joins_some_are_sent_at_a_time() -> None:
    world, flows = two_switches(TOPICS)
    world.network.run(2 * JOIN.refresh_s)
    upper, joins = world.switches["s1"].multicast, Joins(world)
    upper._received._trees.clear()
    assert world.network.run(2 * JOIN.refresh_s, lambda: bool(joins.whole))
    tree = next(iter(world.switches["s2"].multicast.trees.all()))
    ((at, _),) = tree.sent.items()
    waiting = {each.number for each in world.switches["s2"].multicast._joins._spaced[at]}
    assert len(waiting) == JOINS_AGAIN_MAX
    world.network.run(JOIN.refresh_s)
    assert len(joins.whole) == TOPICS
    flows[-1].outlive()


@pytest.mark.parametrize("topics", [12, *nightly(1)])
def test_joins_pass_a_queue_that_is_shorter_than_one_of_them(topics: int) -> None:
    world = Simulation(topology=chain(2), keepalive_ms=None)
    assert world.run_until_attached()
    cable = world.cables[frozenset(("s1", "s2"))]
    cable.delay_s, cable.bytes_s = 0.005, 1e6 / 8
    cable.fifo_s = 3_000 / cable.bytes_s
    flows = [advertise(world, f"/t{number}", ROBOT) for number in range(topics)]
    for flow in flows:
        flow.read_by(READER)
    assert world.network.run(topics, lambda: all(flow.is_read_by(1) for flow in flows))
    flows[0].outlive()


def test_numbers_alone_keep_no_branch_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    unasked = SoftState(1e9, periods=3e-9 * JOIN.refresh_s)  # the lower switch never shows its proofs of its own accord
    monkeypatch.setattr(upstream_joins, "JOIN_PROOF", unasked)
    monkeypatch.setattr(multicast, "JOIN_PROOF", unasked)
    world, (flow,) = two_switches()
    upper, joins = world.switches["s1"].multicast, Joins(world)
    world.network.run(12 * JOIN.refresh_s)
    assert 3 <= len(joins.whole) <= 4  # it had to
    monkeypatch.setattr(upstream_joins, "JOINS_AGAIN_MAX", 0)  # and now it never does
    world.network.run(3 * JOIN.refresh_s + JOIN.lease_s)
    assert not upper.trees.of_topic(flow.topic.name)
    monkeypatch.setattr(upstream_joins, "JOINS_AGAIN_MAX", JOINS_AGAIN_MAX)
    world.network.run(JOIN.refresh_s + 0.1)
    flow.outlive()


def readers_by_evidence(world: Simulation, shown: list[bytes]) -> tuple[str, str]:
    """Return the reader whose advertisement both switches hold, and the other one."""
    names = {label: bytes(world.members[label].name) for label in ("s3/right", "s3/other")}
    (held,) = {label for label, name in names.items() if all(name in evidence for evidence in shown)}
    (other,) = set(names) - {held}
    return held, other


def test_the_evidence_of_a_reader_that_leaves_is_replaced_at_each_switch() -> None:
    topology = Topology(
        (Link("s1", "s2"), Link("s2", "s3")),
        (DomainPlan("home", ("s1", "s2", "s3")),),
        (
            Attachment("s2", "rib", "rib"),
            Attachment("s1", "proxy", "left"),
            Attachment("s3", "proxy", "right"),
            Attachment("s3", "proxy", "other"),
        ),
    )
    world = Simulation(topology=topology)
    assert world.run_until_attached()
    flow = flowing(world, "/t", ROBOT, ("s3/right", "s3/other"))
    world.network.run(JOIN.refresh_s)
    trees = [world.switches[label].multicast.trees.of_topic(flow.topic.name)[0] for label in ("s1", "s2")]
    left, stays = readers_by_evidence(world, [next(iter(tree.branches.values())).evidence for tree in trees])
    world.members[left].unsubscribe(flow.topic.name)
    world.network.send_pending(left)
    world.network.run(3 * JOIN.refresh_s)
    for tree in trees:
        ((_, branch),) = tree.branches.items()
        assert bytes(world.members[stays].name) in branch.evidence
    flow.outlive(stays)


def test_x03_a_neighbour_prolongs_no_branch_of_another_and_repeats_no_refresh() -> None:
    world = Simulation(topology=chain(3))
    assert world.run_until_attached()
    flow = flowing(world, "/t", ROBOT, ("s3/right",))
    world.network.run(2 * JOIN.refresh_s)
    middle = world.switches["s2"]
    (tree,) = middle.multicast.trees.of_topic(flow.topic.name)
    ((at, branch),) = tree.branches.items()
    liar, identity = neighbour(world, "s2", "s1")
    before, expires_s = counted(world), branch.expires_s
    refresh = JoinRefresh(
        numbers=(branch.sequence, branch.sequence + 1),
        session=middle.hello_protocol.ports[liar.port].echo,
        sender_session=liar.nonce,
        sequence=1 << 60,
    )
    for _ in range(2):
        inject(world, "s2", liar, refresh.to_wire(identity.name, identity.key))
    assert {each: its.expires_s for each, its in tree.branches.items()} == {at: expires_s}
    assert (counted(world) - before)[DropReason.REPLAYED] == 1
    flow.outlive()


def test_x03_a_reply_about_unknown_joins_works_once_for_each_refresh() -> None:
    world, (flow,) = two_switches()
    world.network.run(2 * JOIN.refresh_s)
    lower, joins = world.switches["s2"], Joins(world)
    (tree,) = lower.multicast.trees.of_topic(flow.topic.name)
    (sent,) = tree.sent.values()
    upper, identity = neighbour(world, "s2", "s1")
    before = Counter(counted(world))
    for count in range(50):
        reply = JoinRefresh(
            numbers=(sent.number, sent.number + 1, 7),
            session=lower.hello_protocol.ports[upper.port].echo,
            sender_session=upper.nonce,
            sequence=(1 << 60) + count,
            is_reply=True,
        )
        inject(world, "s2", upper, reply.to_wire(identity.name, identity.key))
    world.network.send_pending("s2")
    world.network.run(0.05)
    assert len(joins.whole) == 1
    assert counted(world) - before == Counter()
    flow.outlive()


def test_an_attached_node_refuses_a_reply_about_unknown_joins() -> None:
    world, (flow,) = two_switches()
    attachment = world.members[ROBOT].attachment
    above = attachment.switch
    assert above is not None
    (identity,) = (each for each in world.identities.values() if each.name == above.name)
    reply = JoinRefresh(
        numbers=(7,),
        session=attachment.hello_protocol.ports[above.port].echo,
        sender_session=above.nonce,
        sequence=1 << 60,
        is_reply=True,
    )
    before = counted(world)
    inject(world, ROBOT, above, reply.to_wire(identity.name, identity.key))
    assert counted(world) - before == Counter({DropReason.MALFORMED: 1})
    flow.outlive()
