"""Findings of the insider fuzzer (tests/insiders): each statement is validly signed, and ends no node."""

from __future__ import annotations

from gdp.control.hello import Hello, Timing
from gdp.frame.codec import Kind
from tests.journeys.flows import ROBOT, flowing, ring
from tests.journeys.test_attacks import control, still_flows


def test_a_hello_of_an_older_life_from_another_address_ends_no_switch() -> None:
    """The switch removed the later incarnation by resetting its time of receipt, and took that for its own delay."""
    world = ring()
    flow = flowing(world)
    world.add_member("nuc1/insider", "nuc1")
    assert world.run_until_attached()
    insider, nuc1 = world.identities["nuc1/insider"], world.switches["nuc1"]
    world.network.connect("nuc1", "nuc1/insider").is_up = False  # a second port of the same node
    port = max(nuc1.hello_protocol.ports)
    hello = Hello(
        nonce=b"a nonce!",
        sequence=1,
        heard=(nuc1.hello_protocol.ports[port].echo,),
        mtu=1_500,
        digest=bytes(8),
        membership=insider.membership,
        timing=Timing(0, 0, 1),
    )
    frame = control(Kind.HELLO, hello.to_wire(insider.name, insider.key), source=insider.name)
    world.network.inject("nuc1", port, frame)
    world.network.run(3)
    assert nuc1.hello_protocol.liveness._lateness_s == 0
    assert {world.members[ROBOT].name, world.switches["nuc2"].name} <= {
        each.name for each in nuc1.hello_protocol.neighbours.all_up()
    }
    still_flows(flow)
    flow.outlive()
