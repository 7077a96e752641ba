"""Transit policy of domains, rights to read, and the knowledge of an eavesdropper on the path."""

from __future__ import annotations

import pytest

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Kind
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import ring5
from tests.journeys.flows import SERVER, Tap, advertise, flowing, ring

SHORT = frozenset(("nuc5", "nuc1"))
WITHOUT_BACKBONE = {"school": ("cloud",), "cloud": ("school",), "backbone": ("school", "cloud")}
# The upper RIB is in the backbone: resolution requires trust in its responses; transit through it is not required.
NOT_THROUGH_BACKBONE = {"school": ("school", "cloud"), "cloud": ("school", "cloud")}


def test_traffic_keeps_out_of_a_domain_that_the_reader_keeps_out_of() -> None:
    world = ring(transits={"cloud": ("cloud", "school")})
    flow = flowing(world)
    taps = [Tap("nuc2", "nuc3"), Tap("nuc3", "nuc4")]
    world.network.taps += taps
    flow.stream(20, 0.01)
    assert world.network.run(5, lambda: flow.has(SERVER, 20))
    assert set(flow.hops(SERVER)) == {2}
    assert [tap.count(Kind.DATA) for tap in taps] == [0, 0]
    flow.outlive()


def test_traffic_keeps_out_of_a_domain_that_the_publisher_keeps_out_of() -> None:
    flow = flowing(ring(transits={"school": ("cloud", "school")}))
    flow.stream(20, 0.01)
    assert flow.world.network.run(5, lambda: flow.has(SERVER, 20))
    assert set(flow.hops(SERVER)) == {2}
    flow.outlive()


def test_reports_keep_to_the_allowed_way_too() -> None:
    world = ring(transits=NOT_THROUGH_BACKBONE)
    tap = Tap("nuc4", "nuc3")
    world.network.taps.append(tap)
    flow = flowing(world)
    flow.stream(20, 0.01)
    assert world.network.run(5, lambda: flow.has(SERVER, 20))
    assert tap.count(Kind.ACKNACK) == 0
    flow.outlive()


def test_nothing_passes_where_no_allowed_way_is_left() -> None:
    world = ring(transits=NOT_THROUGH_BACKBONE)
    flow = flowing(world)
    world.network.set_link(world.cables[SHORT], up=False)
    world.network.run(2)
    tap = Tap("nuc2", "nuc3")
    world.network.taps.append(tap)
    flow.stream(20, 0.01)
    world.network.run(5)
    assert (flow.numbers(SERVER), tap.count(Kind.DATA)) == ([], 0)
    flow.outlive(negative=True)


def test_the_allowed_way_is_taken_again_when_it_is_back() -> None:
    world = ring(transits=NOT_THROUGH_BACKBONE)
    flow = flowing(world)
    world.network.set_link(world.cables[SHORT], up=False)
    world.network.run(2)
    flow.stream(20, 0.01)
    world.network.call(3, lambda: world.network.set_link(world.cables[SHORT], up=True))
    assert world.network.run(10, lambda: flow.has(SERVER, 20))
    assert flow.numbers(SERVER) == list(range(20))
    flow.outlive()


@pytest.mark.momentary("hellos have no lease of a name")
def test_a_border_of_an_untrusted_domain_is_no_neighbour() -> None:
    world = Simulation(topology=ring5(), trusts=WITHOUT_BACKBONE)
    world.network.run(3)
    border = world.switches["nuc2"]
    assert {n.name for n in border.hello_protocol.neighbours.all_up()} == {
        world.identities[label].name for label in ("nuc1", "nuc2/rib")
    }
    assert border.drops()[DropReason.WRONG_DOMAIN] > 0


@pytest.mark.momentary("it is refused before anything is claimed")
def test_a_member_without_a_delegation_to_read_cannot_even_ask() -> None:
    world = ring()
    server = world.members[SERVER]
    topic = world.topic("/secret", server, [Right.PUBLISH])
    with pytest.raises(LocalError):
        server.subscribe(topic)


def test_a_reader_whose_delegation_is_anothers_gets_nothing() -> None:
    world = ring()
    world.add_member("nuc4/thief", "nuc4")
    assert world.run_until_attached()
    flow = flowing(world)
    thief = world.members["nuc4/thief"]
    thief.subscribe(world.topic(flow.name, world.members[SERVER], [Right.READ]))
    world.network.send_pending("nuc4/thief")
    tap = Tap("nuc4", "nuc4/thief")
    world.network.taps.append(tap)
    flow.stream(20, 0.01)
    assert world.network.run(5, lambda: flow.has(SERVER, 20))
    assert (thief.poll_messages(), tap.count(Kind.DATA), flow.publisher.readers) == ([], 0, 1)
    flow.outlive()


def test_a_local_topic_is_not_found_from_another_domain() -> None:
    world = ring()
    flow = advertise(world, is_global=False)
    flow.read_by(SERVER)
    world.network.run(5)
    assert flow.publisher.readers == 0
    assert not world.ribs["backbone"].rib.state.store.routes(flow.topic.name)
    flow.outlive(negative=True)


def test_a_local_topic_is_found_within_its_domain() -> None:
    world = ring()
    world.add_member("nuc2/near", "nuc2")
    assert world.run_until_attached()
    flow = advertise(world, is_global=False)
    flow.read_by("nuc2/near")
    assert world.network.run(5, lambda: flow.is_read_by(1))
    flow.outlive()


def test_no_frame_on_any_link_shows_a_topic_a_type_or_a_word_of_it() -> None:
    world = ring()
    seen: list[bytes] = []
    world.network.taps.append(lambda _at_s, _a, _b, frame: seen.append(frame))
    flow = flowing(world, "/camera/front/image")
    flow.publish(b"the plaintext of a message" * 200)
    assert world.network.run(1, lambda: flow.has(SERVER, 1))
    wire = b"\n".join(seen)
    assert len(seen) > 20
    for word in (b"camera", b"front", b"image", b"plaintext", b"described", bytes(range(32))):
        assert word not in wire
    flow.outlive()
