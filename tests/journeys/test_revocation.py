"""Revoked certificate: it closes the access that it opened, in every tier, within a second."""

from __future__ import annotations

import pytest

from gdp.crypto.statements import parse
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.trust.delegation import Delegation
from gdp.trust.revocation import Revocation
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import LEASE_S, ROBOT, SERVER, Tap, flowing, ring
from tests.lanes import nightly

HERE = "nuc3"  # where the operator inserts the revocation: neither end's domain
WITHIN_S = 1.0
TIERS = {"t": ("t1",), "m": ("m1",), "n": ("n1",), "l": ("l1",), "r": ("r1",)}


def three_tiers() -> Simulation:
    """Return a publisher and a reader in two bottom domains, each below a middle one, and these below the top."""
    uppers = {"m": "t", "n": "t", "l": "m", "r": "n"}
    topology = Topology(
        (Link("m1", "t1"), Link("n1", "t1"), Link("l1", "m1"), Link("r1", "n1")),
        tuple(DomainPlan(label, switches, uppers.get(label)) for label, switches in TIERS.items()),
        (
            *(Attachment(switch, "rib", "rib") for (switch,) in TIERS.values()),
            Attachment("l1", "proxy", "robot"),
            Attachment("r1", "proxy", "server"),
        ),
    )
    world = Simulation(topology=topology, lease_s=LEASE_S)
    assert world.run_until_attached()
    return world


def keeps(world: Simulation, fingerprint: bytes, key: bytes) -> set[str]:
    """Return the nodes that store a revocation: switches by name, RIBs by domain in capitals, members."""
    who = {node for node, switch in world.switches.items() if switch.state.policy.revoked.has(fingerprint, key)}
    who |= {label.upper() for label, host in world.ribs.items() if host.rib.state.policy.revoked.has(fingerprint, key)}
    members = world.members.items()
    return who | {label for label, each in members if each.attachment._policy.revoked.has(fingerprint, key)}


@pytest.mark.parametrize(
    ("end", "at"),
    [
        ("publisher", "l1"),
        ("reader", "n1"),
        ("member", "t1"),
        *nightly(*(("publisher", at) for at in ("t1", "n1"))),
        *nightly(*(("reader", at) for at in ("l1", "t1"))),
        *nightly(*(("member", at) for at in ("l1", "n1"))),
    ],
)
def test_a_revocation_closes_a_flow_in_all_of_three_tiers(end: str, at: str) -> None:
    world = three_tiers()
    flow = flowing(world, source="l1/robot", readers=("r1/server",))
    reader = world.members["r1/server"]
    key, until = world.owner.key.public.compressed, int(world.network.now.unix_s) + 100_000
    if end == "member":
        authority, fingerprint = world.authorities["l"], world.identities["l1/robot"].member.fingerprint
        key = authority.root.key.compressed
        wire = Revocation.make(authority.key, authority.root.subject, fingerprint, until)
    else:
        delegation = flow.topic.delegation
        if end == "reader":
            delegation = next(
                each.topic for each in reader.subscriptions if each.topic.name == flow.topic.name
            ).delegation
        fingerprint = parse(delegation.chain[-1]).fingerprint
        wire = world.owner.revoke(delegation.subject, fingerprint, until)
    world.switches[at].revoke(wire, world.network.now)
    world.network.send_pending(at)
    world.network.run(WITHIN_S)
    expected = {"L", "M", "T", "N", "R", "l1", "r1"} if end == "publisher" else {"R", "r1"}
    if end == "member":
        expected = {*world.switches, *(label.upper() for label in world.ribs), *world.members}
    assert keeps(world, fingerprint, key) >= expected
    if end != "reader":
        assert not reader.subscriptions.writer_proxies_of(flow.topic.name)
        stored = [host.rib.state.store.routes(flow.topic.name) for host in world.ribs.values()]
        assert not any(stored)
    assert not any(switch.multicast.trees.all() for switch in world.switches.values())
    flow.outlive(negative=True)


def revoke(world: Simulation, delegation: Delegation) -> None:
    """Revoke a delegation's AdCert, at one switch."""
    fingerprint = parse(delegation.chain[-1]).fingerprint
    until = int(world.network.now.unix_s) + 100_000
    world.switches[HERE].revoke(world.owner.revoke(delegation.subject, fingerprint, until), world.network.now)
    world.network.send_pending(HERE)


def test_a_publisher_whose_delegation_is_revoked_is_gone_from_every_tier() -> None:
    flow = flowing(ring())
    world = flow.world
    before = {label: host.rib.names for label, host in world.ribs.items()}
    revoke(world, flow.topic.delegation)
    world.network.run(WITHIN_S)
    assert {label: host.rib.names for label, host in world.ribs.items()} == {k: n - 1 for k, n in before.items()}
    assert not world.members[SERVER].subscriptions.writer_proxies_of(flow.topic.name)
    assert not any(switch.multicast.trees.all() for switch in world.switches.values())
    flow.outlive(negative=True)


def test_messages_of_a_revoked_publisher_reach_no_reader() -> None:
    flow = flowing(ring())
    revoke(flow.world, flow.topic.delegation)
    flow.world.network.run(WITHIN_S)
    flow.publish(b"too late")
    flow.world.network.run(1)
    assert not flow.has(SERVER, 1)
    flow.outlive(negative=True)


def test_a_revoked_publisher_that_advertises_again_is_refused() -> None:
    flow = flowing(ring())
    world = flow.world
    revoke(world, flow.topic.delegation)
    world.network.run(30)
    assert world.switches["nuc1"].drops()[DropReason.REVOKED] > 0
    assert not any(host.rib.names > 2 for host in world.ribs.values())
    flow.outlive(negative=True)


def test_a_reader_whose_delegation_is_revoked_gets_no_frame_more() -> None:
    flow = flowing(ring())
    world = flow.world
    reader = next(e.topic for e in world.members[SERVER].subscriptions if e.topic.name == flow.topic.name)
    revoke(world, reader.delegation)
    world.network.run(WITHIN_S)
    tap = Tap("nuc1", "nuc2")
    world.network.taps.append(tap)
    flow.publish(b"not for you")
    world.network.run(5)
    assert tap.count(Kind.DATA) == 0
    assert not flow.has(SERVER, 1)
    flow.outlive(negative=True)


def test_another_reader_behind_the_same_link_reads_on_without_a_gap() -> None:
    world = ring()
    world.add_member("nuc4/other", "nuc4")
    assert world.run_until_attached()
    flow = flowing(world, readers=(SERVER, "nuc4/other"))
    flow.stream(100, 0.05)
    reader = next(e.topic for e in world.members[SERVER].subscriptions if e.topic.name == flow.topic.name)
    world.network.call(1.0, lambda: revoke(world, reader.delegation))
    assert world.network.run(10, lambda: flow.has("nuc4/other", 100))
    assert flow.numbers("nuc4/other") == list(range(100))
    assert len(flow.numbers(SERVER)) < 60
    flow.outlive("nuc4/other")


def test_a_revoked_member_is_cut_off_by_its_switch() -> None:
    flow = flowing(ring())
    world = flow.world
    authority = world.authorities["school"]
    member = world.identities[ROBOT].member
    wire = Revocation.make(
        authority.key, authority.root.subject, member.fingerprint, int(world.network.now.unix_s) + 100_000
    )
    world.switches["nuc4"].revoke(wire, world.network.now)
    world.network.send_pending("nuc4")
    world.network.run(1.5)  # a hello, and the silence that follows it
    assert world.ribs["backbone"].rib.names == 1
    assert flow.member.name not in {each.name for each in world.switches["nuc1"].hello_protocol.neighbours.all_up()}
    flow.outlive(negative=True)


def test_a_switch_that_was_away_learns_what_was_revoked_meanwhile() -> None:
    flow = flowing(ring())
    world = flow.world
    world.network.stop("nuc1")
    revoke(world, flow.topic.delegation)
    world.network.run(2)
    world.restart_switch("nuc1")
    world.network.run(5)
    assert world.switches["nuc1"].drops()[DropReason.REVOKED] > 0
    assert not world.switches["nuc1"].attached.get(flow.topic.name, flow.member.name)
    flow.outlive(negative=True)


@pytest.mark.parametrize("revoked", [1, *nightly(0)])
def test_the_whole_way_to_another_reader_stands_while_one_is_taken_back(revoked: int) -> None:
    world = ring()
    world.add_member("nuc5/other", "nuc5")
    assert world.run_until_attached()
    readers = (SERVER, "nuc5/other")
    flow = flowing(world, readers=readers)
    reader = next(
        each.topic for each in world.members[readers[revoked]].subscriptions if each.topic.name == flow.topic.name
    )
    until = int(world.network.now.unix_s) + 100_000
    fingerprint = parse(reader.delegation.chain[-1]).fingerprint
    world.switches["nuc5"].revoke(world.owner.revoke(reader.delegation.subject, fingerprint, until), world.network.now)
    world.network.send_pending("nuc5")
    way = [world.switches[node] for node in ("nuc1", "nuc2", "nuc3", "nuc4", "nuc5")]
    assert not world.network.run(3, lambda: not all(switch.multicast.trees.all() for switch in way))
    flow.outlive(readers[1 - revoked])
