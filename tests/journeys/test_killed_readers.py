"""A reader that is killed and starts again, whatever its publisher still knows and keeps: what it lacks is reported."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.intervals import ADVERTISEMENT, FORGET_S
from gdp.intervals import READER as REPORTS
from gdp.message.loss import LossReason
from lab.simulation import Simulation
from lab.topology import chain
from tests.journeys.flows import Flow, flowing

SOURCE, READER, OTHER = "s1/left", "s2/right", "s2/other"
EVERY_S, SIZE = 0.5, 100
READ = 21  # messages that came before it was killed
LITTLE_BYTES = 20 * SIZE
SUSPENDED_S = REPORTS.lease_s + 2.0
FORGOTTEN_S = REPORTS.lease_s + FORGET_S + 5.0


def killed(away_s: float, readers: tuple[str, ...] = (READER,), budget_bytes: int | None = None) -> Flow:
    """Kill a reader that has read some messages, and return after it was away."""
    world = Simulation(topology=chain(2), lease_s=2.5)
    world.add_member(OTHER, "s2")
    assert world.run_until_attached()
    flow = flowing(world, source=SOURCE, readers=readers)
    if budget_bytes is not None:
        flow.publisher._window._budget_bytes = budget_bytes
    network = world.network
    for number in range(int((away_s + 20) / EVERY_S)):
        message = number.to_bytes(4, "big") + bytes(SIZE)
        network.call(number * EVERY_S, partial(flow.publish, message))
    assert network.run(20, lambda: flow.has(READER, READ))
    network.run(EVERY_S / 2)
    network.stop(READER)
    assert flow.numbers(READER) == list(range(READ))
    network.run(away_s)
    return flow


def reads_again(flow: Flow, label: str) -> list[int]:
    """Let a reader come until all was published; return which messages it got."""
    flow.read_by(label)
    flow.world.network.run(12)
    return flow.numbers(label)


@pytest.mark.parametrize(
    ("away_s", "others", "budget_bytes"),
    [
        pytest.param(0.5, (), None, id="known"),
        pytest.param(SUSPENDED_S, (), None, id="suspended"),
        pytest.param(SUSPENDED_S, (OTHER,), LITTLE_BYTES, id="suspended, little is kept, another reads on"),
        pytest.param(FORGOTTEN_S, (), None, id="given up"),
        pytest.param(FORGOTTEN_S, (OTHER,), LITTLE_BYTES, id="given up, little is kept, another reads on"),
    ],
)
def test_what_a_killed_reader_lacks_is_reported_to_its_next_incarnation(
    away_s: float, others: tuple[str, ...], budget_bytes: int | None
) -> None:
    flow = killed(away_s, (READER, *others), budget_bytes)
    world = flow.world
    world.restart_member(READER)
    numbers = reads_again(flow, READER)
    losses = world.members[READER].subscriptions.losses_of(flow.topic.name)
    assert numbers == list(range(numbers[0], flow.publisher.messages))
    assert numbers[0] > READ
    assert [(each.first, each.last, each.reason) for each in losses.ranges] == [
        (READ + 1, numbers[0], LossReason.READER_RESTARTED)  # sequence numbers begin with 1
    ]


@pytest.mark.parametrize("away_s", [SUSPENDED_S, FORGOTTEN_S], ids=["suspended", "given up"])
def test_what_a_killed_reader_lacks_is_reported_by_its_publisher_where_another_one_comes_for_it(away_s: float) -> None:
    flow = killed(away_s)
    numbers = reads_again(flow, OTHER)
    world = flow.world
    assert numbers == list(range(numbers[0], flow.publisher.messages))
    assert world.members[OTHER].subscriptions.losses_of(flow.topic.name).total == 0
    world.network.run(FORGOTTEN_S)
    lost = flow.publisher.losses
    assert lost.counts.keys() <= {LossReason.GIVEN_UP, LossReason.NO_READER}
    assert lost.ranges[0].first == READ + 1
    assert flow.publisher.acknowledgements.acknowledged == flow.publisher.messages - lost.total


def test_a_reader_that_is_killed_again_and_again_reports_each_message_once() -> None:
    flow = killed(0.5)
    world, network = flow.world, flow.world.network
    got, lost = list(range(READ)), list[int]()

    def poll() -> None:
        losses = world.members[READER].subscriptions.losses_of(flow.topic.name)
        lost.extend(number for each in losses.ranges for number in range(each.first - 1, each.last))
        got.extend(flow.numbers(READER))

    for lives_s in (0.3, 0.02, 1.0, 0.1):
        world.restart_member(READER)
        flow.read_by(READER)
        network.run(lives_s)
        poll()
        network.stop(READER)
        network.run(2 * lives_s)
    world.restart_member(READER)
    reads_again(flow, READER)
    poll()
    assert got == sorted(set(got))
    assert sorted({*got, *lost}) == list(range(flow.publisher.messages))
    assert len(got) + len(lost) <= flow.publisher.messages + 4  # the last one of a life may not be confirmed


@pytest.mark.parametrize("readers", [(READER,), (READER, OTHER)])
def test_a_switch_stops_watching_the_topics_of_a_reader_that_died_unless_another_reads_them(
    readers: tuple[str, ...],
) -> None:
    world = Simulation(topology=chain(2))
    world.add_member(OTHER, "s2")
    assert world.run_until_attached()
    flow = flowing(world, source=SOURCE, readers=readers)
    queries = world.switches["s2"].resolver.requests
    assert flow.topic.name in queries
    world.network.stop(READER)
    world.network.run(4 * ADVERTISEMENT.lease_s)
    assert (flow.topic.name in queries) is (OTHER in readers)
