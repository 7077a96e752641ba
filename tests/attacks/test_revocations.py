"""Revocations as a weapon: they fill no quota of others, cost little, amplify nothing, and stay in effect."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest

from gdp.control.hello import Hello
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import parse
from gdp.crypto.subject import Subject
from gdp.errors import DropReason
from gdp.exchange import anti_entropy
from gdp.exchange.sync_message import SyncMessage
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.nodes.revocation_upkeep import RevocationUpkeep
from gdp.trust.advertisement import Advertisement
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import hash_of
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Flow, flowing, ring
from tests.journeys.test_attacks import mac_of, still_flows

THIEF = "nuc1/thief"
MINE = SigningKey.generate()


def until(world: Simulation) -> int:
    return int(world.network.now.unix_s) + 100_000


def junk_of(key: SigningKey, number: int, until_s: int) -> bytes:
    """Return a void revocation by a key that anyone can make."""
    subject = Subject.of(Metadata({"kind": "topic", "name": f"/junk/{number % 7}"}), key.public.compressed)
    return Revocation.make(key, subject, number.to_bytes(32, "big"), until_s)


def by_root(world: Simulation, label: str, fingerprint: bytes) -> bytes:
    root = world.authorities[label]
    return Revocation.make(root.key, root.root.subject, fingerprint, until(world))


def school_of(world: Simulation) -> Name:
    return hash_of(world.authorities["school"].root.key.compressed)


def say(world: Simulation, wire: bytes, label: str, to: str, kind: Kind = Kind.REVOKE) -> None:
    """Hand a switch a statement as one of its attached members would."""
    for frame in world.members[label].attachment.fragmenter.split(kind, wire, 1_500):
        world.network.inject(to, port_of(world, label), frame, mac_of(world, to, port_of(world, label)))


def port_of(world: Simulation, label: str) -> int:
    name = world.members[label].name
    switch = world.switches[label.split("/", maxsplit=1)[0]]
    return next(each.port for each in switch.hello_protocol.neighbours.all_up() if each.name == name)


def with_thief(flow_of: Simulation | None = None) -> tuple[Simulation, Flow]:
    """Return the ring with a flow, and a hostile participant at the robot's switch."""
    world = flow_of or ring()
    world.add_member(THIEF, "nuc1")
    assert world.run_until_attached()
    return world, flowing(world)


def revoke(world: Simulation, flow: Flow, at: str = "nuc3") -> None:
    """Let the owner revoke the publisher's delegation, at one switch."""
    fingerprint = parse(flow.topic.delegation.chain[-1]).fingerprint
    wire = world.owner.revoke(flow.topic.delegation.subject, fingerprint, until(world))
    world.switches[at].revoke(wire, world.network.now)
    world.network.send_pending(at)


@pytest.mark.parametrize("matters", [False, True])
def test_a03_inventions_of_one_member_keep_no_owners_revocation_out(matters: bool) -> None:
    world, flow = with_thief()
    key = world.identities[THIEF].key if matters else MINE  # it has advertised a name of its own, so its key is stored
    far = (1 << 64) - 1 if not matters else until(world)
    for number in range(1_200):
        say(world, junk_of(key, number, far), THIEF, "nuc1")
    world.network.run(2)
    kept = {node: len(switch.state.policy.revoked) for node, switch in world.switches.items()}
    assert kept["nuc1"] <= (700 if matters else 0)
    assert kept["nuc4"] == kept["nuc5"] == 0  # none of it passed nodes that store nothing of that key
    still_flows(flow)
    revoke(world, flow)
    world.network.run(1)
    assert not world.members[SERVER].subscriptions.writer_proxies_of(flow.topic.name)
    for switch in ("nuc1", "nuc5"):
        fingerprint = parse(flow.topic.delegation.chain[-1]).fingerprint
        assert world.switches[switch].state.policy.revoked.has(fingerprint, world.owner.key.public.compressed)
    flow.outlive(negative=True)


def test_a04_a_switch_that_restarts_does_not_believe_a_revoked_member(tmp_path: Path) -> None:
    world, flow = with_thief()
    switch = world.switches["nuc1"]
    upkeep = RevocationUpkeep(tmp_path, switch.state.policy.revoked)
    upkeep.restore(world.network.now)
    upkeep.start()
    member = world.identities[ROBOT].member
    world.switches["nuc2"].revoke(by_root(world, "school", member.fingerprint), world.network.now)
    world.network.send_pending("nuc2")
    world.network.run(1)
    for number in range(1_024):
        say(world, junk_of(MINE, number, until(world)), THIEF, "nuc1")
    world.network.run(1)
    upkeep.work(world.network.now)
    upkeep.close()
    world.network.set_link(world.cables[frozenset(("nuc1", "nuc5"))], up=False)
    for node in ("nuc1", "nuc2"):
        world.network.stop(node)
    world.network.run(2)
    restarted = world.restart_switch("nuc1")  # neither neighbour comes back: no node can inform it
    again = RevocationUpkeep(tmp_path, restarted.state.policy.revoked)
    again.restore(world.network.now)
    again.close()
    world.network.run(5)
    assert flow.member.name not in {each.name for each in restarted.hello_protocol.neighbours.all_up()}
    assert restarted.drops()[DropReason.REVOKED] > 0
    assert restarted.attached.get(flow.topic.name, flow.member.name) is None
    flow.outlive(negative=True)


def test_a04_a_restarted_switch_learns_from_its_neighbour_whatever_junk_came_in_between() -> None:
    world, flow = with_thief()
    member = world.identities[ROBOT].member
    world.switches["nuc2"].revoke(by_root(world, "school", member.fingerprint), world.network.now)
    world.network.send_pending("nuc2")
    world.network.run(1)
    for number in range(1_024):
        say(world, junk_of(MINE, number, until(world)), THIEF, "nuc1")
    world.network.run(1)
    world.network.stop("nuc1")
    world.network.run(2)
    restarted = world.restart_switch("nuc1")
    world.network.run(5)
    assert flow.member.name not in {each.name for each in restarted.hello_protocol.neighbours.all_up()}
    assert restarted.attached.get(flow.topic.name, flow.member.name) is None
    flow.outlive(negative=True)


def test_a05_a_junk_revocation_has_nothing_verified_again(monkeypatch: pytest.MonkeyPatch) -> None:
    world, flow = with_thief()
    for label in range(8):
        world.add_member(f"nuc1/reader{label}", "nuc1")
    assert world.run_until_attached()
    for label in range(8):
        flow.read_by(f"nuc1/reader{label}")
    assert world.network.run(5, lambda: flow.is_read_by(9))
    looks = [0]
    switch = world.switches["nuc1"]
    for what in ("verify", "recheck"):
        before = getattr(switch.state.verifier, what)

        def counted(*given: object, before: Callable[..., object] = before) -> object:
            looks[0] += 1
            return before(*given)

        monkeypatch.setattr(switch.state.verifier, what, counted)
    now = world.network.now
    neighbour = next(
        each for each in switch.hello_protocol.neighbours.all_up() if each.name == world.members[THIEF].name
    )
    verified = [0]
    monkeypatch.setattr(Revocation, "verify", lambda *_: verified.__setitem__(0, verified[0] + 1))
    junk = [parse(junk_of(MINE, number, until(world))) for number in range(400)]
    begun_s = time.process_time()
    for statement in junk:
        with pytest.raises(Exception, match=r"unconcerned|quota"):
            switch._revoker.receive_revocation(neighbour, statement, now)
    spent_s = time.process_time() - begun_s
    assert (looks, verified) == ([0], [0])
    assert spent_s / len(junk) < 0.005  # not a benchmark: it was 46.6 ms
    wire = world.owner.revoke(flow.topic.delegation.subject, b"x" * 32, until(world))
    switch._revoker.receive_revocation(neighbour, parse(wire), now)  # an owner's, for another object
    assert looks == [0]
    flow.outlive()


def test_a05_a_real_revocation_has_only_what_rests_on_it_verified_again(monkeypatch: pytest.MonkeyPatch) -> None:
    world, flow = with_thief()
    for label in range(8):
        world.add_member(f"nuc1/reader{label}", "nuc1")
    assert world.run_until_attached()
    for label in range(8):
        flow.read_by(f"nuc1/reader{label}")
    assert world.network.run(5, lambda: flow.is_read_by(9))
    switch = world.switches["nuc1"]
    seen: list[Name] = []
    before = switch.state.verifier.recheck

    def recheck(advertisement: Advertisement, unix_s: float) -> None:
        seen.append(advertisement.node)
        before(advertisement, unix_s)

    monkeypatch.setattr(switch.state.verifier, "recheck", recheck)
    reader = world.members["nuc1/reader3"]
    delegation = next(each.topic for each in reader.subscriptions).delegation
    wire = world.owner.revoke(delegation.subject, parse(delegation.chain[-1]).fingerprint, until(world))
    switch.revoke(wire, world.network.now)
    assert set(seen) == {reader.name}
    world.network.send_pending("nuc1")
    world.network.run(1)
    flow.outlive(*(label for label in flow.got if label != "nuc1/reader3"))


class Bytes:
    """Counter of frames from one node to another, keepalives and hellos apart."""

    def __init__(self, world: Simulation, a: str, b: str) -> None:
        self.sent = 0
        self._ends = a, b
        world.network.taps.append(self)

    def __call__(self, _at_s: float, a: str, b: str, frame: bytes) -> None:
        if (a, b) == self._ends and decode(frame, ETHER_BYTES).kind in (Kind.REVOKE, Kind.REVOKED):
            self.sent += len(frame)


@pytest.mark.parametrize("echoes", [False, True])
def test_a06_fresh_hellos_draw_no_more_bytes_than_they_cost(echoes: bool) -> None:
    world, flow = with_thief()
    for number in range(300):  # 135 kB of them
        world.switches["nuc1"].revoke(by_root(world, "school", number.to_bytes(32, "big")), world.network.now)
    world.network.send_pending("nuc1")
    world.network.run(10)
    label = THIEF
    identity, port = world.identities[label], port_of(world, label)
    world.network.freeze(label)
    if not echoes:
        world.network.run(2)  # it is not up any more
    answered = Bytes(world, "nuc1", label)
    spent, numbers = 0, count(1)
    for _ in range(40):
        link = world.switches["nuc1"].hello_protocol.ports[port]
        nonce = b"fresh" + next(numbers).to_bytes(3, "big")
        hello = Hello(
            nonce=nonce,
            sequence=1,
            heard=(link.echo,) if echoes else (),
            mtu=1_500,
            digest=bytes(8),
            membership=identity.membership,
        )
        for frame in world.members[label].attachment.fragmenter.split(
            Kind.HELLO, hello.to_wire(identity.name, identity.key), 1_500
        ):
            spent += ETHER_BYTES + len(frame)
            world.network.inject("nuc1", port, frame, mac_of(world, "nuc1", port))
        world.network.run(0.05)
    assert answered.sent <= (spent if echoes else 0)
    still_flows(flow)
    flow.outlive()


def test_a06_a_proven_neighbour_draws_twice_all_there_is_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(anti_entropy, "_SPARE", 100)
    world, flow = with_thief()
    for number in range(300):
        wire = by_root(world, "school", number.to_bytes(32, "big"))
        world.switches["nuc1"].revoke(wire, world.network.now)
    world.network.send_pending("nuc1")
    world.network.run(5)
    identity, port = world.identities[THIEF], port_of(world, THIEF)
    answered = Bytes(world, "nuc1", THIEF)
    session = world.switches["nuc1"].hello_protocol.ports[port].echo
    for number in range(6):
        said = SyncMessage(
            of=school_of(world),
            lacking=tuple((bytes([at]), b"") for at in range(256)),
            session=session,
            sequence=int(2e15) + number,
        )
        say(world, said.to_wire(identity.name, identity.key), THIEF, "nuc1", Kind.REVOKED)
        world.network.run(0.5)
    assert answered.sent < (2 * 300 + 100 + 12) * 500
    flow.outlive()


def test_a_recorded_digest_draws_nothing() -> None:
    world, flow = with_thief()
    identity, port = world.identities[THIEF], port_of(world, THIEF)
    school = school_of(world)
    session = world.switches["nuc1"].hello_protocol.ports[port].echo
    totals = ((school, b"another!"),)
    said = SyncMessage(totals=totals, session=session, sequence=int(2e15)).to_wire(identity.name, identity.key)
    for _ in range(20):
        say(world, said, THIEF, "nuc1", Kind.REVOKED)
    old = SyncMessage(totals=totals, session=b"an older session", sequence=int(3e15))
    say(world, old.to_wire(identity.name, identity.key), THIEF, "nuc1", Kind.REVOKED)
    assert world.switches["nuc1"].drops()[DropReason.REPLAYED] >= 20
    flow.outlive()


def test_only_what_is_lacking_is_sent_to_a_neighbour_that_comes_up() -> None:
    world, flow = with_thief()
    for number in range(100):
        world.switches["nuc1"].revoke(by_root(world, "school", bytes([number]) * 32), world.network.now)
    world.network.send_pending("nuc1")
    world.network.run(3)
    assert len(world.members[THIEF].attachment._policy.revoked) == 100
    world.network.set_link(world.leads[THIEF], up=False)
    world.network.run(1)
    for number in range(100, 105):
        world.switches["nuc1"].revoke(by_root(world, "school", bytes([number]) * 32), world.network.now)
    answered = Bytes(world, "nuc1", THIEF)
    world.network.set_link(world.leads[THIEF], up=True)
    world.network.run(5)
    assert len(world.members[THIEF].attachment._policy.revoked) == 105
    assert answered.sent < 16_000  # five statements, digests and buckets; all would be 45,000
    flow.outlive()


def test_a_reader_of_a_topic_whose_switch_restarted_is_refused_by_what_its_rib_knows() -> None:
    world = ring()
    flow = flowing(world)
    reader = world.members[SERVER]
    delegation = next(each.topic for each in reader.subscriptions if each.topic.name == flow.topic.name).delegation
    wire = world.owner.revoke(delegation.subject, parse(delegation.chain[-1]).fingerprint, until(world))
    world.network.stop("nuc5")
    world.switches["nuc1"].revoke(wire, world.network.now)
    world.network.send_pending("nuc1")
    world.network.run(3)
    world.restart_switch("nuc5")
    world.network.run(10)
    assert not world.switches["nuc5"].state.readers.of(flow.topic.name)
    flow.outlive(negative=True)


def test_what_was_revoked_before_it_was_used_is_refused_within_a_minute() -> None:
    world = ring()
    member = world.members[SERVER]
    topic = world.topic("/early", member, [Right.PUBLISH])
    wire = world.owner.revoke(topic.delegation.subject, parse(topic.delegation.chain[-1]).fingerprint, until(world))
    world.switches["nuc1"].revoke(wire, world.network.now)
    world.network.send_pending("nuc1")
    world.network.run(5)
    member.advertise(topic, b"", reliable=True)
    world.network.send_pending(SERVER)
    world.network.run(75)
    assert all(rib.rib.state.store.routes(topic.name) == [] for rib in world.ribs.values())
