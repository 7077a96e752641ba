"""Many small messages over two domains: few seals, nothing lost or doubled, and a step's cost follows its work."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.client.publisher import Publisher
from gdp.client.writer_proxy import WriterProxy
from gdp.frame.codec import Flag, Kind
from gdp.names import Name
from tests.journeys.flows import ROBOT, SERVER, Tap, advertise, flowing, row

TOPICS = 20


def test_bursts_of_many_topics_arrive_once_and_in_order_under_few_seals() -> None:
    world = row()
    flows = [flowing(world, f"/topic{at}") for at in range(TOPICS)]
    tap = Tap(ROBOT, "nuc1")
    world.network.taps.append(tap)

    def burst(first: int) -> None:
        for number in range(first, first + 50):
            for flow in flows:
                flow.publisher.publish(number.to_bytes(4, "big") + bytes(96))
        world.network.send_pending(ROBOT)

    for at in range(4):
        world.network.call(at * 0.1, partial(burst, at * 50))
    world.network.run(3)
    got: dict[Name, list[int]] = {flow.topic.name: [] for flow in flows}
    for each in world.members[SERVER].poll_messages():
        got[each.topic].append(int.from_bytes(each.delivered.message[:4], "big"))
    assert all(numbers == list(range(200)) for numbers in got.values())
    assert tap.count(Kind.DATA) < TOPICS * 200 / 5
    assert any(header.flags & Flag.BUNDLE for header in tap.headers if header.kind == Kind.DATA)
    flows[0].outlive()


def test_bundles_survive_loss_and_links_that_narrow() -> None:
    flow = flowing(row())
    network = flow.world.network
    for sim_link in flow.world.cables.values():
        sim_link.loss = 0.04

    def burst(first: int) -> None:
        for number in range(first, first + 500):
            flow.publisher.publish(number.to_bytes(4, "big") + bytes(96))
        network.send_pending(ROBOT)

    for at in range(20):
        network.call(at * 0.01, partial(burst, at * 500))
    for at_s, mtu in ((0.031, 700), (0.071, 1_500), (0.113, 576)):
        network.call(at_s, partial(network.set_mtu, flow.world.cables[frozenset(("nuc2", "nuc5"))], mtu))
    assert network.run(20, lambda: flow.has(SERVER, 10_000))
    network.run(2)
    assert flow.numbers(SERVER) == list(range(10_000))
    assert flow.publisher.acknowledgements.acknowledged == 10_000
    flow.outlive()


def test_a_step_asks_only_topics_that_have_something_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    world = row()
    idle = [advertise(world, f"/idle{at}") for at in range(50)]
    busy = flowing(world, "/busy")
    world.network.run(1)
    asked: list[Publisher] = []

    for flow in idle:
        for what in ("poll_frames", "get_timer", "handle_timer"):
            monkeypatch.setattr(flow.publisher, what, partial(_noted, asked, flow.publisher))
    busy.stream(100, 0.01, 100)
    assert world.network.run(3, lambda: busy.has(SERVER, 100))
    assert asked == []
    flow.outlive()


def test_a_writer_proxy_that_was_closed_says_nothing_after_its_goodbye() -> None:
    flow = flowing(row())
    network, reader = flow.world.network, flow.world.members[SERVER]
    tap = Tap(SERVER, "nuc5")
    writer_proxies: list[WriterProxy] = list(reader.subscriptions.writer_proxies())
    reader.leave()
    network.send_pending(SERVER)
    network.run(0.01)
    network.taps.append(tap)
    network.run(5)
    assert tap.count(Kind.ACKNACK) == 0
    assert [writer_proxy.get_timer() for writer_proxy in writer_proxies] == [float("inf")]
    flow.outlive(negative=True)


def _noted(asked: list[Publisher], publisher: Publisher, *_: object) -> None:
    asked.append(publisher)
