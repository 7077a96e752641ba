"""A border restarts on links of drawn delays that fall silent at drawn moments: nothing ends, all losses are reported.

A switch that starts learns of other domains, of its neighbours and of its own domain in an order that delays decide. A
link that is silent in between meets it with half of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.draws import IS_LONG
from tests.journeys.flows import flowing

DRAWS: Final = 12 if IS_LONG else 3
BORDER, NEIGHBOURS = "right", ("left", "top", "inner")
AT_S, SILENT_S, LASTS_S, PERIOD_S, CATCHES_UP_S = 1.0, 1.5, 6.0, 0.1, 6.0
TRIANGLE: Final = Topology(
    (Link("left", "right"), Link("right", "top"), Link("top", "left"), Link("right", "inner")),
    (
        DomainPlan("top", ("top",)),
        DomainPlan("left", ("left",), upper="top"),
        DomainPlan("right", ("right", "inner"), upper="top"),
    ),
    (
        *(Attachment(each, "rib", "rib") for each in ("top", "left", "right")),
        Attachment("left", "proxy", "talker"),
        Attachment("inner", "proxy", "reader"),
    ),
)


@dataclass(frozen=True)
class Drawn:
    """Delay of one link, one way, and when it falls silent after the start of the border; None: never."""

    delay_s: float
    silent_s: float | None


def _drawn() -> st.SearchStrategy[Drawn]:
    moment_s = st.one_of(st.floats(0.0, 0.015), st.floats(0.0, 0.6))
    return st.builds(Drawn, st.sampled_from([0.0005, 0.02, 0.1, 0.3]), st.none() | moment_s)


def _set_loss(link: SimLink, loss: float) -> None:
    link.loss = loss


def _restart(world: Simulation) -> None:
    world.restart_switch(BORDER)


@pytest.mark.momentary("what is tried are the seconds in which a switch starts")
@settings(
    max_examples=DRAWS,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.generate),
)
@given(st.tuples(*(_drawn() for _ in NEIGHBOURS)))
# Links of other domains were known and silent before the border had a link of its own: its process ended.
@example((Drawn(0.0005, 0.0059), Drawn(0.0005, None), Drawn(0.1, None)))
@example((Drawn(0.0005, 0.0059), Drawn(0.0005, 0.509), Drawn(0.1, 0.0135)))
@example((Drawn(0.1, 0.2078), Drawn(0.3, 0.5092), Drawn(0.02, 0.2097)))
def test_links_that_fall_silent_while_a_border_starts_end_nothing(drawn: tuple[Drawn, ...]) -> None:
    world = Simulation(topology=TRIANGLE, keepalive_ms=None)
    assert world.run_until_attached()
    flow = flowing(world, "/scan", "left/talker", ("inner/reader",))
    for neighbour, each in zip(NEIGHBOURS, drawn, strict=True):
        link = world.cables[frozenset((BORDER, neighbour))]
        link.delay_s = each.delay_s
        if each.silent_s is not None:
            world.network.call(AT_S + each.silent_s, partial(_set_loss, link, 1.0))
            world.network.call(AT_S + each.silent_s + SILENT_S, partial(_set_loss, link, 0.0))
    world.network.call(AT_S, partial(_restart, world))
    count = int(LASTS_S / PERIOD_S)
    flow.stream(count, PERIOD_S, size=50)
    world.network.run(LASTS_S + CATCHES_UP_S)
    numbers = flow.numbers("inner/reader")
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == count - 1, "traffic did not return"
    # With links of 0.3 s the reader may be silent for longer than its lease, so messages may be given up.
    lost = sum(world.members["inner/reader"].subscriptions.lost().values())
    assert lost == count - len(numbers), "lost without a report"
