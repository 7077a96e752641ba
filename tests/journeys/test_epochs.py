"""Topic secrets that change while messages flow, without a loss."""

from __future__ import annotations

import pytest

from gdp.client.participant import Topic
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.limits import CLOCK_SKEW_S
from gdp.trust.grants import EPOCH_S, begun_epochs, daily_epochs
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right
from tests.journeys.flows import ROBOT, SERVER, Flow, advertise, flowing, row
from tests.lanes import nightly


def topic(flow: Flow, label: str, right: Right, epochs: list[int]) -> Topic:
    """Return the flow's topic for a member, with the secrets of these epochs."""
    world, identity = flow.world, flow.world.identities[label]
    metadata = flow.topic.delegation.metadata
    assert metadata is not None
    card = NodeDescriptor.from_wire(NodeDescriptor.make(identity))
    given = world.owner.delegate(card, metadata, [right], epochs, world.validity)
    return Topic(given, {epoch: grant.secret for epoch, grant in given.open(identity).items()})


def epochs_seen(flow: Flow) -> set[int]:
    """Return a set that fills with the epochs of the data on the first link."""
    seen: set[int] = set()

    def tap(_: float, a: str, b: str, frame: bytes) -> None:
        header = decode(frame, ETHER_BYTES)
        if (a, b) == ("nuc1", "nuc2") and header.kind == Kind.DATA:
            seen.add(header.epoch)

    flow.world.network.taps.append(tap)
    return seen


def test_a_new_epoch_given_to_the_reader_first_costs_no_message() -> None:
    flow = flowing(row())
    network, seen = flow.world.network, epochs_seen(flow)
    flow.stream(200, 0.02)
    network.call(1.0, lambda: flow.world.members[SERVER].renew(topic(flow, SERVER, Right.READ, [1, 2])))
    network.call(2.0, lambda: flow.member.renew(topic(flow, ROBOT, Right.PUBLISH, [1, 2])))
    network.call(3.0, lambda: flow.world.members[SERVER].renew(topic(flow, SERVER, Right.READ, [2])))
    assert network.run(20, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    assert seen == {1, 2}
    flow.outlive()


@pytest.mark.parametrize(("published", "read"), [([1], [1, 2]), ([1, 2], [1, 2]), ([2], [1, 2]), ([1, 2], [2])])
def test_a_reader_finds_the_epoch_that_its_publisher_uses(published: list[int], read: list[int]) -> None:
    flow = advertise(row())
    flow.member.renew(topic(flow, ROBOT, Right.PUBLISH, published))
    reader = flow.world.members[SERVER]
    reader.subscribe(topic(flow, SERVER, Right.READ, read))
    flow.got[SERVER] = []
    flow.world.network.send_pending(SERVER)
    assert flow.world.network.run(5, lambda: flow.is_read_by(1))
    flow.world.network.run(1)
    flow.publish(b"hello")
    assert flow.world.network.run(2, lambda: flow.has(SERVER, 1))
    flow.outlive()


def test_a_reader_without_the_new_epoch_reads_no_more() -> None:
    flow = flowing(row())
    flow.member.renew(topic(flow, ROBOT, Right.PUBLISH, [2]))
    flow.publish(b"under two")
    flow.world.network.run(5)
    assert not flow.has(SERVER, 1)
    flow.outlive(negative=True)


DAY = 20_000  # the first day, as a number since 1970
DAY_S = 20.0  # virtual seconds that stand for a day


def on_day(flow: Flow, label: str, right: Right, epochs: set[int], day: float) -> Topic:
    """Return the flow's topic as a member's node reads it at a time, in days since 1970."""
    given, unix_s = topic(flow, label, right, sorted(epochs)), day * EPOCH_S
    sealing = begun_epochs(given.secrets, unix_s)
    return Topic(given.delegation, begun_epochs(given.secrets, unix_s + CLOCK_SKEW_S), sealing)


@pytest.mark.parametrize(
    ("loss", "clock_days"),
    [
        (0.03, -1 / 30),
        *nightly((0.0, 1 / 30), (0.0, -1 / 30), (0.0, 0), (0.03, 0), (0.03, 1 / 30)),
    ],
)
def test_epochs_of_three_days_follow_each_other_without_a_lost_or_doubled_message(
    loss: float, clock_days: float
) -> None:
    """A reader is away at a change of the day, another comes on the third; the publisher's clock may be wrong."""
    world = row(lease_s=6.0)  # shorter than the absence
    away, late, former = (f"nuc{number}/{name}" for number, name in ((5, "away"), (2, "late"), (2, "former")))
    for label in (away, late, former):
        world.add_member(label, label.partition("/")[0])
    assert world.run_until_attached()
    flow, network = advertise(world), world.network
    seen, held = epochs_seen(flow), daily_epochs({0}, DAY * EPOCH_S)

    def renew(label: str, right: Right, day: float, epochs: set[int] | None = None) -> None:
        world.members[label].renew(on_day(flow, label, right, epochs or held, day))
        network.send_pending(label)

    def begin(label: str, day: float, epochs: set[int]) -> None:
        world.members[label].subscribe(on_day(flow, label, Right.READ, epochs, day))
        flow.got[label] = []
        network.send_pending(label)

    renew(ROBOT, Right.PUBLISH, DAY)
    for label in (SERVER, away, former):
        begin(label, DAY, held)
    assert network.run(10, lambda: flow.is_read_by(3))
    world.cables[frozenset(("nuc2", "nuc5"))].loss = loss
    count = int(4 * DAY_S / 0.1)
    flow.stream(count, 0.1, size=200)
    begin_s = network.now.mono_s

    def until(day: float) -> None:
        network.run(max(begin_s + (day - DAY) * DAY_S - network.now.mono_s, 0.0))

    for day in (DAY + 1, DAY + 2, DAY + 3):
        until(day - 0.2)  # the upkeep has granted the coming day before: it runs each second
        if day == DAY + 2:
            network.freeze(away)
        until(day - 1 / 24)
        readers = [SERVER, *([away] if day != DAY + 2 else []), *([late] if late in flow.got else [])]
        for label in readers:
            renew(label, Right.READ, day - 1 / 24)
        until(day - clock_days)
        renew(ROBOT, Right.PUBLISH, day)
        until(day)
        held = daily_epochs(held, day * EPOCH_S)
        for label in readers:
            renew(label, Right.READ, day)
        if day == DAY + 2:
            until(day + 0.2)
            network.thaw(away)
            renew(away, Right.READ, day + 0.2)
            begin(late, day + 0.2, {DAY + 2, DAY + 3})
    assert network.run(2 * DAY_S, lambda: flow.has(SERVER, count) and flow.has(away, count))
    for label in (SERVER, away):
        assert flow.numbers(label) == list(range(count))
    joined = flow.numbers(late)
    assert joined == list(range(joined[0], count))
    assert joined[0] < 2.6 * DAY_S / 0.1
    opened = flow.numbers(former)  # it got the first two epochs and no later one
    assert opened == list(range(len(opened)))
    assert len(opened) <= (2 + 1 / 30) * DAY_S / 0.1
    assert seen == {0, DAY + 1, DAY + 2, DAY + 3}


def test_a_late_reader_gets_what_was_latched_under_an_epoch_that_it_never_had() -> None:
    flow = advertise(row(), depth=1)
    flow.read_by(SERVER)
    assert flow.world.network.run(5, lambda: flow.is_read_by(1))
    flow.publish(b"the map")
    assert flow.world.network.run(2, lambda: flow.has(SERVER, 1))
    flow.world.members[SERVER].renew(topic(flow, SERVER, Right.READ, [1, 2]))
    flow.member.renew(topic(flow, ROBOT, Right.PUBLISH, [1, 2]))
    late = "nuc2/late"
    flow.world.add_member(late, "nuc2")
    assert flow.world.run_until_attached()
    flow.world.members[late].subscribe(topic(flow, late, Right.READ, [2]))
    flow.got[late] = []
    flow.world.network.send_pending(late)
    assert flow.world.network.run(5, lambda: flow.has(late, 1))
    flow.world.network.run(3)
    flow.collect()
    assert [[each.message for each in flow.got[label]] for label in (late, SERVER)] == [[b"the map"]] * 2
    flow.outlive()
