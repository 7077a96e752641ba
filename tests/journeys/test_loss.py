"""Published is delivered plus lost, for absences of any member and length, over switches and RIBs and three leases."""

from __future__ import annotations

import pytest

from gdp.intervals import ADVERTISEMENT, FORGET_S
from gdp.intervals import READER as REPORTS
from gdp.message.loss import LossReason
from lab.simulation import Simulation
from lab.topology import chain
from tests.journeys.flows import Flow, advertise, flowing

SOURCE, READER = "s1/left", "s2/right"
EVERY_S = 0.25


def flow_of(*, reliable: bool = True) -> Flow:
    world = Simulation(topology=chain(2))
    assert world.run_until_attached()
    flow = flowing(world, source=SOURCE, readers=(READER,), reliable=reliable)
    world.network.run(1)
    return flow


def away(flow: Flow, label: str, away_s: float) -> None:
    """Stream for three advertisement leases, while a member is unplugged for some of the time."""
    network, lead = flow.world.network, flow.world.leads[label]
    count = round(max(3 * ADVERTISEMENT.lease_s, away_s + 20) / EVERY_S)
    flow.stream(count, EVERY_S, 100)
    network.call(2.0, lambda: network.set_link(lead, up=False))
    network.call(2.0 + away_s, lambda: network.set_link(lead, up=True))
    network.run(count * EVERY_S + 20)


def assert_complete(flow: Flow) -> None:
    losses = flow.world.members[READER].subscriptions.losses_of(flow.topic.name)
    numbers = flow.numbers(READER)
    lost = [each for span in losses.ranges for each in range(span.first - 1, span.last)]
    assert numbers == sorted(set(numbers))
    assert sorted(numbers + lost) == list(range(flow.publisher.messages))
    assert losses.total == len(lost)


@pytest.mark.parametrize("label", [SOURCE, READER])
@pytest.mark.parametrize("away_s", [3.0, ADVERTISEMENT.lease_s + 6.0])
def test_who_is_away_within_the_grace_time_costs_a_reliable_topic_nothing(label: str, away_s: float) -> None:
    flow = flow_of()
    away(flow, label, away_s)
    assert_complete(flow)
    assert flow.numbers(READER) == list(range(flow.publisher.messages))
    assert flow.publisher.acknowledgements.acknowledged == flow.publisher.messages


def test_a_publisher_that_was_alone_for_longer_still_has_what_its_reader_lacks() -> None:
    flow = flow_of()
    away(flow, SOURCE, REPORTS.lease_s + FORGET_S + 5.0)
    assert flow.numbers(READER) == list(range(flow.publisher.messages))


def test_a_reader_that_was_away_for_longer_costs_what_both_ends_count() -> None:
    flow = flow_of()
    away(flow, READER, REPORTS.lease_s + FORGET_S + 5.0)
    assert_complete(flow)
    lost = flow.world.members[READER].subscriptions.losses_of(flow.topic.name)
    assert lost.total == flow.publisher.messages - flow.publisher.acknowledgements.acknowledged > 0
    assert lost.counts.keys() <= {LossReason.GIVEN_UP, LossReason.NO_READER}


def test_a_best_effort_topic_loses_what_was_sent_meanwhile_and_no_more() -> None:
    flow = flow_of(reliable=False)
    away(flow, READER, 10.0)
    assert_complete(flow)
    lost = flow.world.members[READER].subscriptions.losses_of(flow.topic.name).total
    assert 10.0 / EVERY_S <= lost <= 13.0 / EVERY_S


def test_what_a_publisher_says_in_a_new_life_before_its_reader_is_back_is_lost() -> None:
    flow = flow_of()
    world, before = flow.world, flow.publisher
    flow.stream(20, 0.1, 100)
    world.network.run(3)
    world.network.stop(SOURCE)
    world.network.run(2)
    member = world.restart_member(SOURCE)
    again = Flow(world, flow.name, SOURCE, flow.topic, member.advertise(flow.topic, b"", reliable=True), flow.got)
    again.stream(round(3 * ADVERTISEMENT.lease_s), 1.0, 100)
    again.publish(b"\xff" * 4)
    world.network.run(3 * ADVERTISEMENT.lease_s + 5)
    losses = world.members[READER].subscriptions.losses_of(flow.topic.name)
    assert losses.counts.keys() == {LossReason.PUBLISHER_RESTARTED}
    assert losses.ranges[0].first == 1
    again.collect()
    assert len(again.got[READER]) + losses.total == before.messages + again.publisher.messages


def test_a_reader_that_starts_again_counts_what_came_between() -> None:
    flow = flow_of()
    world = flow.world
    flow.stream(40, 0.25, 100)
    world.network.run(2.1)
    world.network.stop(READER)
    world.network.run(2.0)
    first = len(flow.numbers(READER))
    world.restart_member(READER)
    flow.read_by(READER)
    world.network.run(3 * ADVERTISEMENT.lease_s)
    losses = world.members[READER].subscriptions.losses_of(flow.topic.name)
    assert losses.counts.keys() == {LossReason.READER_RESTARTED}
    assert first + losses.total + len(flow.numbers(READER)) == flow.publisher.messages


def test_reading_again_on_purpose_is_no_loss() -> None:
    flow = flow_of()
    world = flow.world
    flow.stream(40, 0.25, 100)
    world.network.run(2.1)
    world.members[READER].unsubscribe(flow.topic.name)
    world.network.send_pending(READER)
    world.network.run(3)
    flow.read_by(READER)
    world.network.run(3 * ADVERTISEMENT.lease_s)
    assert world.members[READER].subscriptions.losses_of(flow.topic.name).total == 0
    assert 10 < len(flow.numbers(READER)) < 40


def test_a_latched_topic_without_earlier_readers_has_lost_nothing_for_its_first_reader() -> None:
    world = Simulation(topology=chain(2))
    assert world.run_until_attached()
    flow = advertise(world, source=SOURCE, depth=2)
    for number in range(5):
        flow.publish(number.to_bytes(4, "big"))
    flow.read_by(READER)
    world.network.run(3 * ADVERTISEMENT.lease_s + 1)
    assert flow.numbers(READER) == [3, 4]
    assert world.members[READER].subscriptions.losses_of(flow.topic.name).total == 0
