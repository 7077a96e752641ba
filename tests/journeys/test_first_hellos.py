"""First hellos on a link whose ends see it one after the other, as a cable that is plugged in."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import pytest

from gdp.errors import DropReason
from lab.network import SimLink
from tests.journeys.flows import ring


@pytest.mark.momentary("a handshake ends before any lease")
@pytest.mark.parametrize("late_s", [0.001, 0.01, 0.019, 0.03])
def test_no_frame_comes_before_the_hello_that_makes_its_sender_a_neighbour(late_s: float) -> None:
    """Such frames were dropped, and the switches learned of each other's links 0.7 seconds later."""
    world = ring()
    network, late = world.network, world.switches["nuc3"]
    link = network.connect("nuc1", "nuc3", SimLink(0.0001))
    network.set_link(link, up=False)
    network.run(0.5)
    seen: list[tuple[Any, ...]] = []
    with patch.object(late, "add_port", lambda *port: seen.append(port)):
        network.set_link(link, up=True)
    network.run(late_s)
    ((index, mac, mtu, cost, _),) = seen
    late.add_port(index, mac, mtu, cost, network.now)
    network._settle("nuc3")
    network.run(1)
    assert not sum(switch.drops()[DropReason.UNKNOWN_SENDER] for switch in world.switches.values())
    nuc1, nuc3 = (world.identities[label].name for label in ("nuc1", "nuc3"))
    assert nuc3 in {each.name for each in world.switches["nuc1"].hello_protocol.neighbours.all_up()}
    assert nuc1 in {each.name for each in late.hello_protocol.neighbours.all_up()}
