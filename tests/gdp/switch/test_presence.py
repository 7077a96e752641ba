"""Presence answers: a question about an attached node is answered at its next sign of life, or when it is gone."""

from __future__ import annotations

from collections.abc import Sequence
from unittest.mock import patch

from gdp.control.presence import Presence
from gdp.frame.codec import Kind, decode
from gdp.intervals import SCAPY_KEEPALIVE_MS
from gdp.sansio import ReceivedFrame, Timestamps
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, ring


def ask(world: Simulation, node: str) -> Presence:
    """Let the RIB of its domain ask the robot's switch whether a node is there; return the question."""
    nuc1, name = world.switches["nuc1"], world.identities[node].name
    held = nuc1.attached.get(name, name)
    incarnation = 1 if held is None else held.advertisement.incarnation
    question = Presence(node=name, incarnation=incarnation, other=world.identities["nuc2"].name, question=1)
    rib = nuc1.rib
    assert rib is not None
    nuc1.rib_client.presence.handle_question(question, rib, b"", world.network.now.mono_s)
    return question


def test_a_question_about_a_node_that_is_not_attached_is_answered_at_once() -> None:
    world = ring()
    ask(world, SERVER)
    assert not world.switches["nuc1"].rib_client.presence.open


def test_a_question_about_an_attached_node_is_answered_at_its_next_keepalive() -> None:
    world = ring()
    world.network.run(1)
    question = ask(world, ROBOT)
    nuc1 = world.switches["nuc1"]
    receive = nuc1.receive

    def keepalives(arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        receive([each for each in arrivals if decode(each.frame).kind == Kind.KEEPALIVE], now)

    assert list(nuc1.rib_client.presence.open) == [question.node]
    with patch.object(nuc1, "receive", keepalives), patch.object(nuc1, "get_timer", return_value=None):
        world.network.run(SCAPY_KEEPALIVE_MS / 1_000)
    assert not nuc1.rib_client.presence.open
