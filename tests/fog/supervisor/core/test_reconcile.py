"""Reconcile decisions of the supervisor, as tables of records."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from fog.cluster import MachineRequest
from fog.hardware import Hardware
from fog.machine import Machine, MachineState
from fog.supervisor.core.reconcile import Drain, Launch, Release, Timeouts, decide
from fog.supervisor.core.record import Outcome, update_record
from tests.draws import draws
from tests.fog.supervisor.machines import NOW_S, SPOT, World, record, serving

PATIENCE = Timeouts()


def test_what_is_missing_is_launched() -> None:
    assert decide((SPOT, SPOT), [], NOW_S, PATIENCE) == [Launch(SPOT), Launch(SPOT)]


def test_what_is_there_is_left_alone() -> None:
    assert decide((SPOT, SPOT), [serving("m1"), serving("m2")], NOW_S, PATIENCE) == []


def test_a_machine_on_its_way_is_not_asked_for_twice() -> None:
    assert decide((SPOT,), [record("m1", asked_s=NOW_S - 1)], NOW_S, PATIENCE) == []


def test_a_notice_brings_a_replacement_at_once_and_the_old_one_serves_on() -> None:
    noticed = replace(serving("m1"), noticed_unix_s=NOW_S, leaves_at_unix_s=NOW_S + 10)
    assert decide((SPOT, SPOT), [noticed, serving("m2")], NOW_S, PATIENCE) == [Launch(SPOT)]


def test_a_noticed_machine_is_drained_once_its_replacement_serves() -> None:
    noticed = replace(serving("m1"), noticed_unix_s=NOW_S, leaves_at_unix_s=NOW_S + 10, reason="preempted")
    assert decide((SPOT,), [noticed, serving("m2")], NOW_S, PATIENCE) == [Drain("m1", "preempted")]


def test_a_noticed_machine_is_drained_when_half_of_its_notice_is_over() -> None:
    noticed = replace(serving("m1"), noticed_unix_s=NOW_S - 5, leaves_at_unix_s=NOW_S + 5, reason="preempted")
    assert Drain("m1", "preempted") in decide((SPOT,), [noticed, record("m2", asked_s=NOW_S - 5)], NOW_S, PATIENCE)


def test_a_replica_that_is_not_heard_is_replaced_after_a_second() -> None:
    silent = replace(serving("m1"), unreachable_unix_s=NOW_S - 1.0)
    actions = decide((SPOT, SPOT), [silent, serving("m2")], NOW_S, PATIENCE)
    assert [type(each) for each in actions] == [Release, Launch]


def test_where_none_is_heard_the_way_is_suspected_before_the_machines() -> None:
    silent = replace(serving("m1"), unreachable_unix_s=NOW_S - 5.0)
    assert decide((SPOT,), [silent], NOW_S, PATIENCE) == []


def test_nothing_is_decided_while_the_overlay_cannot_be_queried() -> None:
    silent = replace(serving("m1"), unreachable_unix_s=NOW_S - 50.0)
    assert decide((SPOT,), [silent], NOW_S, PATIENCE, liveness_known=False) == []


def test_a_machine_that_never_serves_is_given_up() -> None:
    stuck = record("m1", asked_s=NOW_S - PATIENCE.boot_s)
    assert decide((SPOT,), [stuck], NOW_S, PATIENCE)[0] == Release("m1", "did not serve in time", Outcome.FAILED)


def test_scaling_down_drains_the_youngest_and_keeps_those_that_serve() -> None:
    stuck = record("m1", asked_s=NOW_S - 30)
    machines = [stuck, serving("m2", asked_s=NOW_S - 50), serving("m3")]
    assert decide((SPOT,), machines, NOW_S, PATIENCE) == [Drain("m2", "not needed"), Release("m1", "not needed")]


def test_a_cluster_that_is_down_gives_everything_back() -> None:
    actions = decide((), [serving("m1"), record("m2")], NOW_S, PATIENCE)
    assert {each.name for each in actions if isinstance(each, Release)} == {"m1", "m2"}


def test_a_drained_machine_is_given_back_when_its_time_is_over() -> None:
    drained = replace(serving("m1"), drained_unix_s=NOW_S - PATIENCE.drain_s)
    assert Release("m1", "") in decide((SPOT,), [drained, serving("m2")], NOW_S, PATIENCE)


def test_before_its_credentials_expire_a_machine_is_replaced_and_serves_until_then() -> None:
    old = serving("m1", credential_renewal_s=60.0)
    assert decide((SPOT,), [old], NOW_S, PATIENCE) == [Launch(SPOT)]
    assert decide((SPOT,), [old, serving("m2")], NOW_S, PATIENCE) == [Drain("m1", "another took its place")]


def test_a_machine_counts_only_for_what_its_hardware_does() -> None:
    large = MachineRequest(Hardware(cpus=16), is_spot=True)
    assert decide((SPOT, large), [serving("m1")], NOW_S, PATIENCE) == [Launch(large)]


def test_an_intention_without_a_machine_is_given_up_after_a_grace() -> None:
    intended = replace(record("m1", asked_s=NOW_S - 3), id="")
    assert update_record(intended, None, None, NOW_S, grace_s=5.0) == intended
    assert update_record(intended, None, None, NOW_S, grace_s=2.0).ending is Outcome.FAILED


def test_an_intention_whose_machine_is_seen_takes_its_id() -> None:
    intended = replace(record("m1", asked_s=NOW_S - 3), id="")
    seen = Machine("i-7", intended.spec, MachineState.BOOTING, NOW_S)
    assert update_record(intended, seen, None, NOW_S, grace_s=2.0).id == "i-7"


STATES = st.sampled_from(["booting", "serving", "frozen", "noticed", "drained", "missing", "gone", "orphan", "old"])


def world_of(states: list[str]) -> World:
    world = World()
    for number, state in enumerate(states, 1):
        name = f"m{number}"
        if state == "booting":
            world.add(record(name, asked_s=NOW_S), MachineState.BOOTING)
        elif state == "noticed":
            world.add(serving(name), MachineState.LEAVING)
            world.machines[name] = replace(world.machines[name], leaves_at_unix_s=NOW_S + 4)
        elif state == "drained":
            world.add(replace(serving(name), drained_unix_s=NOW_S), MachineState.RUNNING)
            world.drained[name] = NOW_S
        elif state == "gone":
            world.records[name] = serving(name).ended(Outcome.PREEMPTED, "", NOW_S)
        elif state == "missing":
            world.records[name] = serving(name)
        elif state == "old":
            world.add(serving(name, credential_renewal_s=10.0), MachineState.RUNNING)
        else:
            known = serving(name)
            world.add(known, MachineState.RUNNING, is_frozen=state == "frozen", is_known=state != "orphan")
        world.made = max(world.made, number)
    return world


@given(st.lists(STATES, max_size=7), st.integers(1, 4))
@draws(25)
def test_from_any_mix_of_machines_it_comes_to_what_is_wanted_and_rests(states: list[str], count: int) -> None:
    world, wanted = world_of(states), (SPOT,) * count
    for _ in range(400):
        world.step(wanted, PATIENCE)
    assert len(world.serving()) == len(world.machines) == count
    assert world.step(wanted, PATIENCE) == []


@given(st.lists(st.sampled_from(["booting", "serving", "frozen"]), min_size=1, max_size=6), st.integers(1, 4))
@draws(25)
def test_scaling_down_never_takes_what_serves_below_what_is_wanted(states: list[str], count: int) -> None:
    world, wanted = world_of(states), (SPOT,) * count
    least = min(len(world.serving()), count)
    for _ in range(100):
        world.step(wanted, PATIENCE)
        assert len(world.serving()) >= least


def test_a_lost_machine_comes_back_elsewhere() -> None:
    world = world_of(["serving", "serving"])
    before = {name: each.spec.offer.region for name, each in world.machines.items()}
    del world.machines["m1"]
    for _ in range(50):
        world.step((SPOT, SPOT), PATIENCE)
    (new,) = world.machines.keys() - {"m1", "m2"}
    assert world.machines[new].spec.offer.region != before["m1"]
