"""Attachment of a node to the overlay: advertisements, AdvertiseAcks, renewals, and the choice of its switch."""

from __future__ import annotations

from itertools import pairwise

import pytest

from gdp.client.attachment import PendingAdvertisement
from gdp.client.participant import Topic
from gdp.crypto.subject import Subject
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.intervals import ADVERTISEMENT
from gdp.metadata import Metadata
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import ring5
from tests.journeys.flows import ROBOT, SERVER, Tap, advertise, ring


def advertisement_without_delegation(world: Simulation) -> None:
    """Let the robot advertise a name of an owner that delegated nothing to it."""
    subject = world.owner.subject(Metadata({"kind": "topic", "name": "/not/mine"}))
    world.members[ROBOT].attachment.advertisement(subject, Right.PUBLISH, (), is_global=True)
    world.network.send_pending(ROBOT)


def of(world: Simulation, right: Right) -> PendingAdvertisement:
    return next(each for each in world.members[ROBOT].attachment.advertisements if each.right is right)


def test_a_refused_advertisement_is_acknowledged_with_the_reason() -> None:
    world = ring()
    advertisement_without_delegation(world)
    assert world.network.run(2, lambda: of(world, Right.PUBLISH).is_acknowledged)
    pending_advertisement = of(world, Right.PUBLISH)
    assert (pending_advertisement.is_taken, pending_advertisement.refused) == (False, DropReason.NOT_DELEGATED)
    assert world.members[ROBOT].attachment.is_attached


@pytest.mark.parametrize("reason", list(DropReason))
def test_every_reason_counts_as_a_judgement(reason: DropReason) -> None:
    assert PendingAdvertisement(
        subject=Subject(bytes(32), b""), right=Right.READ, chain=(), is_global=False, refused=reason
    ).is_acknowledged


def test_a_refused_advertisement_is_not_made_again_at_once() -> None:
    world = ring()
    advertisement_without_delegation(world)
    tap = Tap(ROBOT, "nuc1")
    world.network.taps.append(tap)
    world.network.run(world.lease_s / 3 - 0.05)
    first = {each.number for each in tap.headers if each.kind == Kind.ADVERTISE}
    assert len(first) <= 3


def test_advertisements_are_renewed_before_their_lease_ends() -> None:
    world = ring()
    world.network.run(3 * ADVERTISEMENT.lease_s)
    assert world.switches["nuc1"].attached.get(world.members[ROBOT].name, world.members[ROBOT].name) is not None
    assert world.ribs["school"].rib.names == 1


def test_a_renewal_is_repeated_with_longer_pauses_until_it_is_acknowledged() -> None:
    world = ring(lease_s=12.0)
    world.network.run(1)
    tap = Tap(ROBOT, "nuc1")
    sent_s: list[float] = []

    def note(at_s: float, a: str, b: str, frame: bytes) -> None:
        count = tap.count(Kind.ADVERTISE)
        tap(at_s, a, b, frame)
        if tap.count(Kind.ADVERTISE) > count and (not sent_s or at_s > sent_s[-1] + 0.1):
            sent_s.append(at_s)

    world.network.taps.append(note)
    world.network.stop("nuc2/rib")  # no other RIB is reached from there: nothing acknowledges it
    for domain in ("nuc3/rib", "nuc4/rib"):
        world.network.stop(domain)
    world.network.run(world.lease_s)
    pauses_s = [later - earlier for earlier, later in pairwise(sent_s)]
    assert pauses_s == pytest.approx([0.5, 1.0, 2.0, 4.0], abs=0.05)


def test_while_another_node_has_its_identity_a_node_advertises_its_own_name_alone_and_the_others_later() -> None:
    world = ring()
    advertisement_without_delegation(world)
    attachment, other, own = world.members[ROBOT].attachment, of(world, Right.PUBLISH), of(world, Right.ATTACH)
    before = own.sent_sequence, other.sent_sequence
    own.refused = DropReason.IN_USE
    attachment.renew(own.subject.name, own.chain)
    own.refused = DropReason.IN_USE
    attachment.renew(other.subject.name, ())
    attachment.handle_timer(world.network.now)
    assert (own.sent_sequence > before[0], other.sent_sequence) == (True, before[1])
    own.refused = None
    attachment.handle_timer(world.network.now)
    assert other.sent_sequence > before[1]


def test_a_node_whose_clock_went_back_finds_its_way_past_its_earlier_life() -> None:
    world = ring()
    member = world.restart_member(ROBOT)
    member.attachment._sequence = 5
    world.network.run(3)
    assert member.attachment.is_attached
    assert member.attachment.refusals[DropReason.STALE] >= 1


@pytest.mark.parametrize("away_s", [0.1, 3.0])
def test_a_node_that_starts_is_attached_as_soon_as_both_ends_have_heard_each_other(away_s: float) -> None:
    world = ring()
    world.network.stop(ROBOT)
    world.network.run(away_s)
    member = world.restart_member(ROBOT)
    world.network.send_pending(ROBOT)
    assert world.network.run(0.1, lambda: member.attachment.is_attached)


def test_who_leaves_is_gone_in_every_tier() -> None:
    world = ring()
    flow = advertise(world)
    world.network.run(1)
    world.members[ROBOT].leave()
    world.network.send_pending(ROBOT)
    world.network.run(1)
    for host in world.ribs.values():
        assert host.rib.state.store.routes(flow.topic.name) == []


def test_who_falls_silent_is_gone_when_its_lease_ends() -> None:
    world = ring()
    world.network.stop(ROBOT)
    world.network.run(ADVERTISEMENT.lease_s + 1)
    assert [host.rib.names for host in world.ribs.values()] == [0, 1, 1]


@pytest.mark.parametrize("lease_s", [2.0, 60.0])
def test_the_lease_is_what_the_settings_say(lease_s: float) -> None:
    world = Simulation(topology=ring5(), lease_s=lease_s)
    assert world.run_until_attached()
    world.network.run(lease_s + 1)
    assert world.ribs["school"].rib.names == 1  # it was renewed
    world.network.stop(ROBOT)
    world.network.run(2 * lease_s / 3 - 1)
    assert world.ribs["school"].rib.names == 1
    world.network.run(lease_s / 3 + 2)
    assert world.ribs["school"].rib.names == 0


def test_without_a_switch_what_is_sent_is_counted_as_lost() -> None:
    world = ring()
    attachment = world.members[ROBOT].attachment
    world.network.set_link(world.leads[ROBOT], up=False)
    attachment.send([b"frame"])
    assert attachment.refusals[DropReason.PORT_DOWN] == 1
    assert not attachment.is_attached


def test_of_two_switches_the_cheaper_is_held() -> None:
    world = ring()
    world.network.connect("nuc2", ROBOT, cost=5)
    world.network.run(2)
    switch = world.members[ROBOT].attachment.switch
    assert switch is not None
    assert switch.name == world.identities["nuc2"].name
    assert world.members[ROBOT].attachment.is_attached


def test_the_other_switch_is_held_when_the_first_is_gone() -> None:
    world = ring()
    world.network.connect("nuc2", ROBOT, cost=50)
    world.network.run(2)
    world.network.stop("nuc1")
    world.network.run(3)
    switch = world.members[ROBOT].attachment.switch
    assert switch is not None
    assert switch.name == world.identities["nuc2"].name
    assert world.members[ROBOT].attachment.is_attached


def test_a_delegation_of_another_node_is_refused_with_its_reason() -> None:
    world = ring()
    server = world.members[SERVER]
    topic = world.topic("/x", server, [Right.READ])
    robot = world.members[ROBOT]
    robot.subscribe(Topic(topic.delegation, topic.secrets))
    world.network.send_pending(ROBOT)
    world.network.run(1)
    assert of(world, Right.READ).refused is DropReason.NOT_DELEGATED
