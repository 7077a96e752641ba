"""Gateway election of a group, as tables of records."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fog.supervisor.core.gateway_election import elect, excused_names
from fog.supervisor.core.reconcile import Release, Timeouts, decide
from fog.supervisor.core.record import Outcome, Record
from tests.fog.supervisor.machines import NOW_S, SPOT, offer, record, serving

PATIENCE = Timeouts()
LONG_AGO_S = NOW_S - 80.0


def gateway(machine: Record, since_s: float = LONG_AGO_S) -> Record:
    return replace(machine, gateway="edge", gateway_unix_s=since_s)


def silent(machine: Record, since_s: float) -> Record:
    return replace(machine, unreachable_unix_s=since_s)


def on_demand(machine: Record) -> Record:
    return replace(machine, spec=replace(machine.spec, offer=offer(is_spot=False)))


GONE = gateway(serving("m1")).ended(Outcome.PREEMPTED, "killed", NOW_S)
NOTICED = replace(gateway(serving("m1")), noticed_unix_s=NOW_S - 1, reason="preempted")
DRAINED = replace(gateway(serving("m1")), drained_unix_s=NOW_S - 1, reason="not needed")
RELEASED = replace(gateway(serving("m1")), released_unix_s=NOW_S - 1, reason="not needed")


@pytest.mark.parametrize(
    ("group", "name", "reason"),
    [
        ([record("m1")], "m1", "the first machine"),
        ([record("m1"), serving("m2")], "m2", "the first machine"),
        ([serving("m1", asked_s=NOW_S - 90), serving("m2")], "m2", "the first machine"),
        ([serving("m1"), on_demand(serving("m2"))], "m2", "the first machine"),
        ([silent(serving("m1"), NOW_S - 0.5), serving("m2")], "m2", "the first machine"),
        ([GONE, serving("m2"), serving("m3")], "m2", "m1 is gone: killed"),
        ([GONE, record("m2")], "m2", "m1 is gone: killed"),
        ([NOTICED, record("m2"), serving("m3")], "m3", "m1 leaves: preempted"),
        ([DRAINED, serving("m2")], "m2", "m1 leaves: not needed"),
        ([RELEASED, serving("m2")], "m2", "m1 leaves: not needed"),
        ([gateway(record("m1"), NOW_S - 4), silent(serving("m2"), NOW_S - 4)], "m2", "m1 does not come up"),
        ([gateway(record("m1"), NOW_S - 11), record("m2")], "m2", "m1 does not come up"),
    ],
)
def test_the_fittest_machine_becomes_the_gateway(group: list[Record], name: str, reason: str) -> None:
    election = elect(group, "edge", NOW_S, PATIENCE)
    assert election is not None
    assert (election.new.name, election.reason) == (name, reason)


@pytest.mark.parametrize(
    "group",
    [
        [],
        [GONE],
        [NOTICED],
        [replace(record("m1"), id="")],
        [gateway(serving("m1")), serving("m2"), on_demand(serving("m3"))],
        [gateway(record("m1"), NOW_S - 1), record("m2")],
        [gateway(record("m1"), NOW_S - 4), serving("m2")],
        [gateway(record("m1"), NOW_S - 2), silent(serving("m2"), NOW_S - 2)],
        [NOTICED, record("m2")],
        [gateway(serving("m1")), silent(serving("m2"), NOW_S - 20)],
        [silent(gateway(serving("m1")), NOW_S - 20), serving("m2")],
    ],
    ids=[
        "no candidate",
        "gone",
        "alone",
        "not made",
        "works",
        "boots",
        "boots and forwards",
        "boots and may forward soon",
        "none is up",
        "one is silent",
        "another is heard",
    ],
)
def test_the_gateway_stays(group: list[Record]) -> None:
    assert elect(group, "edge", NOW_S, PATIENCE) is None


def test_behind_a_silent_gateway_each_machine_is_tried_once() -> None:
    began_s = NOW_S - PATIENCE.unreachable_timeout_s
    group = [silent(each, began_s) for each in (gateway(serving("m1")), serving("m2"), serving("m3"))]
    now_s, tried = NOW_S, []
    for _ in range(20):
        if (election := elect(group, "edge", now_s, PATIENCE)) is not None:
            assert election.old is not None
            old = replace(election.old, gateway="", gateway_unix_s=now_s)
            group = [old if each.name == old.name else each for each in group]
            new = gateway(election.new, now_s)
            group = [new if each.name == new.name else each for each in group]
            tried.append(new.name)
        now_s += 1.0
    assert tried == ["m2", "m3"]


def test_silence_means_nothing_behind_a_new_gateway() -> None:
    others = [silent(each, NOW_S - 2.0) for each in (gateway(serving("m1"), NOW_S - 1.0), serving("m2"))]
    group = [*others, serving("m3", "west")]
    assert excused_names(others, "edge", NOW_S, PATIENCE) == {"m1", "m2"}
    wanted = (SPOT, SPOT, SPOT)
    assert decide(wanted, group, NOW_S, PATIENCE, excused=["m1", "m2"]) == []
    released = [each.name for each in decide(wanted, group, NOW_S, PATIENCE) if isinstance(each, Release)]
    assert released == ["m1", "m2"]


def test_a_machine_that_fell_silent_as_the_gateway_changed_has_the_time_of_a_partition() -> None:
    m1, m2 = gateway(serving("m1"), NOW_S - PATIENCE.gateway_s), serving("m2")
    late_s = NOW_S - PATIENCE.partition_timeout_s
    assert excused_names([m1, silent(m2, NOW_S - 4.0)], "edge", NOW_S, PATIENCE) == {"m2"}
    assert excused_names([m1, silent(m2, late_s)], "edge", NOW_S, PATIENCE) == frozenset()
    assert excused_names([m1, silent(m2, NOW_S)], "edge", NOW_S, PATIENCE) == frozenset()  # with settled paths
    assert excused_names([m1, m2], "edge", NOW_S, PATIENCE) == frozenset()


@pytest.mark.parametrize(
    ("since_s", "other", "is_kept"),
    [
        (NOW_S - 4.0, serving("m2"), True),
        (NOW_S - 4.0, silent(serving("m2"), NOW_S - 4.0), False),
        (NOW_S - PATIENCE.partition_timeout_s, serving("m2"), False),
    ],
    ids=["forwards", "does not forward", "for too long"],
)
def test_a_silent_gateway_that_forwards_is_kept_for_longer(since_s: float, other: Record, is_kept: bool) -> None:
    group = [silent(gateway(serving("m1")), since_s), other]
    assert ("m1" in excused_names(group, "edge", NOW_S, PATIENCE)) is is_kept
