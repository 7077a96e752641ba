"""A large reliable message, the first one of its path, over links whose queue is shorter than the first burst."""

from __future__ import annotations

from functools import partial

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.client.participant import Message
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.draws import draws
from tests.journeys.flows import advertise

MESSAGES = 3
FRAME_BYTES = 1_514
PAIR = Topology(
    (Link("a", "b"),),
    (DomainPlan("home", ("a", "b")),),
    (Attachment("a", "rib", "rib"), Attachment("a", "proxy", "robot"), Attachment("b", "proxy", "reader")),
)


def drawn() -> st.SearchStrategy[tuple[float, float, float, float, float]]:
    """Draw rate in Mbit/s, delay one way in s, queue in s, loss, and the time in s that a message takes at the rate."""
    return st.tuples(
        st.sampled_from([0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]),
        st.sampled_from([0.0005, 0.005, 0.03, 0.1]),
        st.sampled_from([0.01, 0.02, 0.05, 0.1, 0.3, 1.0]),
        st.sampled_from([0.0, 0.0, 0.01, 0.03]),
        st.sampled_from([0.02, 0.1, 0.4, 1.0]),
    )


@pytest.mark.momentary("what is tried is how long single messages take")
@draws(4, long=32)
@given(drawn())
@example((1.0, 0.0005, 0.1, 0.0, 0.48))  # took 16 s, or did not arrive within 40 s
@example((1.0, 0.03, 0.1, 0.01, 0.48))
def test_a_large_message_takes_a_few_times_its_own_time(drawn: tuple[float, float, float, float, float]) -> None:
    mbit_s, delay_s, fifo_s, loss, own_s = drawn
    world = Simulation(topology=PAIR, keepalive_ms=None)
    assert world.run_until_attached()
    flow = advertise(world, "/map", "a/robot")
    flow.read_by("b/reader")
    assert world.network.run(5, lambda: flow.is_read_by(1))
    link, reader = world.cables[frozenset(("a", "b"))], world.members["b/reader"]
    link.bytes_s, link.delay_s, link.loss = mbit_s * 1e6 / 8, delay_s, loss
    link.fifo_s = max(fifo_s, 4 * FRAME_BYTES / link.bytes_s)
    world.network.run(0.5)
    came: list[Message] = []

    def has(count: int) -> bool:
        came.extend(reader.poll_messages())
        return len(came) == count

    for number in range(MESSAGES):
        flow.publish(number.to_bytes(4, "big") + bytes(max(int(own_s * link.bytes_s), 100)))
        assert world.network.run(1.5 + 8 * (own_s + 2 * delay_s), partial(has, number + 1)), f"message {number}"
        world.network.run(0.3)
        assert has(number + 1)
