"""Frames in a publisher's name from the wrong location: the ingress drops them and multiplies none."""

from __future__ import annotations

from functools import partial

from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.switch.core import SwitchCore
from gdp.switch.table import is_side
from tests.journeys.flows import ROBOT, SERVER, Tap, flowing, ring
from tests.journeys.test_attacks import mac_of, still_flows


def test_a19_a_frame_in_a_publishers_name_from_below_it_becomes_no_copies() -> None:
    world = ring()
    tap = Tap(ROBOT, "nuc1")
    other = world.add_member("nuc1/other", "nuc1")
    assert world.network.run(5, lambda: other.attachment.is_attached)
    world.network.taps.append(tap)
    flow = flowing(world, readers=(SERVER, "nuc1/other"))
    flow.publish(b"a message")
    assert world.network.run(3, lambda: flow.has(SERVER, 1))
    world.network.run(3)  # trees have settled
    data = next(frame for frame in tap.frames if frame[1] == Kind.DATA)
    tried = 0
    for switch in ("nuc1", "nuc5"):
        (tree,) = world.switches[switch].multicast.trees.of_topic(flow.topic.name)
        for port in world.network._nodes[switch].ports:
            if is_side(tree.sides, port):
                continue
            tried += 1
            before = world.network.drops[DropReason.WRONG_SIDE]
            copies = Tap("nuc5", SERVER)
            world.network.taps.append(copies)
            for _ in range(10):
                world.network.inject(switch, port, data, mac_of(world, switch, port))
            world.network.run(0.2)
            assert world.network.drops[DropReason.WRONG_SIDE] == before + 10
            assert copies.count(Kind.DATA) == 0
    assert tried >= 3
    still_flows(flow)
    flow.outlive()


def is_attached(switch: SwitchCore, member: Name) -> bool:
    return switch.attached.of(member) != []


def test_a19_a_topic_follows_its_publisher_to_another_side() -> None:
    world = ring()
    flow = flowing(world)
    for switch in ("nuc2", "nuc3", "nuc1"):
        world.roam(ROBOT, switch)
        assert world.network.run(5, partial(is_attached, world.switches[switch], flow.member.name))
        still_flows(flow)
    flow.outlive()
