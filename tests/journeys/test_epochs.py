"""Topic secrets that change while messages flow, without a loss."""

from __future__ import annotations

import pytest

from gdp.client.participant import Topic
from gdp.frame.codec import ETHER_BYTES, decode
from gdp.frame.kinds import Kind
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right
from tests.journeys.flows import ROBOT, SERVER, Flow, advertise, flowing, ring


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
    flow = flowing(ring())
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
    flow = advertise(ring())
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
    flow = flowing(ring())
    flow.member.renew(topic(flow, ROBOT, Right.PUBLISH, [2]))
    flow.publish(b"under two")
    flow.world.network.run(5)
    assert not flow.has(SERVER, 1)
    flow.outlive(negative=True)
