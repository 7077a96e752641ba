"""Sans-I/O parts of the chaos bench: networks and faults from a seed, the oracle, the accounting."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from faults.accounts import Books, Timeline
from faults.plan import VICTIM, Flow, Oracle, Plan, Service, random_network
from faults.records import Kind, Record, RecordReader
from faults.schedule import STRUCTURAL, make_schedule
from faults.store import critical_lines, snapshot_faults

from gdp.message.loss import LossReason
from lab.faults import Broken, Fault, FaultKind, broken_by, moments
from lab.topology import make_topology

SEEDS = range(1, 9)
SECOND_NS = 1_000_000_000


def square(*flows: Flow, services: tuple[Service, ...] = (), homes: dict[str, tuple[str, ...]] | None = None) -> Plan:
    """Return four switches in a square with P at s1 and R at s4."""
    links = ("s1-s2", "s2-s4", "s1-s3", "s3-s4")
    topology, members = make_topology({"a": ("s1", "s2", "s3", "s4")}, {}, links, ("s1",), {"P": "s1", "R": "s4"})
    return Plan(topology, members, homes or {}, flows or (Flow("/t", "P", ("R",)),), services)


def survives_any_single(plan: Plan) -> bool:
    """Return whether the network stays whole when any single switch or link fails (it is 2-connected)."""
    oracle = Oracle(plan)
    singles = [Broken(switches={each}) for each in plan.switches] + [Broken(links={each}) for each in oracle.links]
    return all(oracle.is_whole(each) for each in singles)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_seed_draws_the_same_network_and_the_same_faults_again(seed: int) -> None:
    assert random_network(seed) == random_network(seed)
    plan = random_network(seed)
    assert make_schedule(plan, seed, 100) == make_schedule(plan, seed, 100)
    assert make_schedule(plan, seed, 100) != make_schedule(plan, seed + 1, 100)


@pytest.mark.parametrize("switches", [12, 16, 20])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_drawn_network_survives_any_single_failure(seed: int, switches: int) -> None:
    plan = random_network(seed, switches)
    assert len(plan.switches) == switches
    assert len(plan.topology.domains) == 4
    assert survives_any_single(plan)


@pytest.mark.parametrize("seed", SEEDS)
def test_faults_part_the_network_only_where_that_is_meant(seed: int) -> None:
    plan = random_network(seed)
    faults, oracle = make_schedule(plan, seed, 200), Oracle(plan)
    assert {fault.kind for fault in faults} >= STRUCTURAL
    for fault in faults:
        under_way = [each for each in faults if each.start_s <= fault.start_s and each.end_s > fault.start_s]
        is_parted = any(each.kind is FaultKind.PARTITION for each in under_way)
        assert is_parted or oracle.is_whole(broken_by(under_way, {}))


@pytest.mark.parametrize("seed", SEEDS)
def test_no_fault_outlasts_the_schedule_and_none_meets_another_at_the_same_target(seed: int) -> None:
    faults = make_schedule(random_network(seed), seed, 120)
    assert max(fault.end_s for fault in faults) <= 120
    for kind in (FaultKind.KILL_SWITCH, FaultKind.CUT):
        of_kind = [fault for fault in faults if fault.kind is kind]
        for one, other in pairwise(of_kind):
            assert one.targets != other.targets or one.end_s <= other.start_s


def test_a_fault_that_lasts_has_a_beginning_only_and_what_begins_comes_before_what_ends() -> None:
    lasting, first = Fault(FaultKind.CUT, ("a", "b"), 2.0), Fault(FaultKind.CUT, ("b", "c"), 1.0, 2.0)
    assert moments([lasting, first]) == [(1.0, first, True), (2.0, lasting, True), (2.0, first, False)]


def test_a_schedule_can_be_limited_to_some_kinds() -> None:
    faults = make_schedule(random_network(1), 1, 100, kinds=[FaultKind.ROAM, FaultKind.CUT])
    assert {fault.kind for fault in faults} == {FaultKind.ROAM, FaultKind.CUT}


_OF_STORE = {FaultKind.KILL_PRIMARY, FaultKind.KILL_REPLICA, FaultKind.FREEZE_PRIMARY}


@pytest.mark.parametrize("seed", SEEDS)
def test_servers_of_a_store_fail_one_at_a_time_and_long_enough_to_be_replaced(seed: int) -> None:
    plan = random_network(seed)
    assert not _OF_STORE & {fault.kind for fault in make_schedule(plan, seed, 300)}
    faults = [each for each in make_schedule(plan, seed, 300, has_store=True) if each.kind in _OF_STORE]
    assert {fault.kind for fault in faults} == _OF_STORE
    assert all(fault.end_s - fault.start_s >= 3.0 for fault in faults)
    assert all(one.end_s <= other.start_s for one, other in pairwise(faults))


def test_a_disk_is_full_once_at_a_time_and_a_rib_may_restart_meanwhile() -> None:
    faults = make_schedule(random_network(1), 1, 200, kinds=[FaultKind.DISK_FULL])
    assert {len(fault.targets) for fault in faults} == {1, 2}
    assert all(one.end_s <= other.start_s for one, other in pairwise(faults))


_START = "snapshot read live=3 unreadable=0 refused=0\nrib up name=a\n"
_FULL, _AGAIN = "snapshot not written path=a reason=full\n", "snapshot written again path=a\n"


@pytest.mark.parametrize(
    ("log", "faults"),
    [
        (_START, 0),
        (_START + _FULL + _AGAIN + _FULL + _AGAIN, 0),
        (_START + _FULL, 1),
        (_START + _FULL + _FULL + _AGAIN, 1),
        ("snapshot not read path=a reason=full\nsnapshot read live=0 unreadable=0 refused=0\nrib up name=a\n", 0),
        ("rib up name=a\n", 1),
        (_START.replace("unreadable=0", "unreadable=1"), 1),
    ],
)
def test_a_rib_says_once_that_its_snapshot_is_not_written_and_when_it_is_again(log: str, faults: int) -> None:
    assert len(list(snapshot_faults("rib s1", log, is_alive=True))) == faults


def test_a_server_of_the_cluster_that_lost_data_is_reported_once(tmp_path: Path) -> None:
    for number, lines in (("1", ["* Ready to accept connections"]), ("2", ["# == CRITICAL == -NOPERM a", "* b"] * 3)):
        (tmp_path / number).mkdir()
        (tmp_path / number / "server.log").write_text("\n".join(lines))
    (complaint,) = critical_lines(tmp_path)
    assert complaint == "server 2 of the store, 3 times: -NOPERM a"


@pytest.mark.parametrize(
    ("broken", "connected"),
    [
        (Broken(), True),
        (Broken(links={frozenset(("s1", "s2"))}), True),
        (Broken(switches={"s2"}), True),
        (Broken(switches={"s2"}, links={frozenset(("s3", "s4"))}), False),
        (Broken(switches={"s1"}), False),
        (Broken(switches={"s1"}, at={"P": "s3"}), True),
        (Broken(members={"R"}), False),
        (Broken(links={frozenset(("s1", "s2")), frozenset(("s1", "s3"))}), False),
    ],
)
def test_the_oracle_knows_what_the_graph_connects(broken: Broken, connected: bool) -> None:
    assert Oracle(square()).must_talk("P", "R", broken) is connected


def test_a_chain_does_not_survive_the_switch_in_its_middle() -> None:
    topology, members = make_topology({"a": ("s1", "s2", "s3")}, {}, ("s1-s2", "s2-s3"), ("s1",), {})
    assert not survives_any_single(Plan(topology, members))


def test_frozen_processes_and_the_revoked_are_broken() -> None:
    faults = [
        Fault(FaultKind.FREEZE, ("member P",), 0, 1),
        Fault(FaultKind.FREEZE, ("switch s2",), 0, 1),
        Fault(FaultKind.FREEZE, ("rib s1",), 0, 1),
        Fault(FaultKind.REVOKE, (VICTIM,), 0, 0),
    ]
    broken = broken_by(faults, {})
    assert (broken.members, broken.switches) == ({"P", VICTIM}, {"s2"})


def delivered(number: int, at_s: float = 0.0, incarnation_id: int = 1, publisher: int = 0) -> Record:
    return Record(Kind.DELIVERED, 0, incarnation_id, publisher, number, round(at_s * SECOND_NS))


def published(count: int) -> Iterator[Record]:
    return (Record(Kind.PUBLISHED, 0, 1, 0, number, number) for number in range(1, count + 1))


def books(*arrived: Record, sent: int = 0) -> Books:
    found = Books(square())
    found.take("P", 1, published(sent))
    found.take("R", 1, iter(arrived))
    return found


def test_a_message_that_is_missing_and_was_not_reported_is_found() -> None:
    found = books(*(delivered(n) for n in (2, 3, 5)), sent=5).incomplete(lambda *_: True, SECOND_NS)
    assert found == ["/t at R (life 1): 1 messages missing, 0 reported"]


def test_a_loss_that_was_reported_exactly_is_accepted() -> None:
    lost = Record(Kind.LOST, 0, 1, 0, 2, 0)
    assert not books(*(delivered(n) for n in (1, 4)), lost, sent=4).incomplete(lambda *_: True, SECOND_NS)


def test_the_last_messages_of_a_dead_publisher_between_two_incarnations_of_a_reader_may_be_reported() -> None:
    found = books(delivered(1), delivered(2))
    found.take("P", 1, (Record(Kind.PUBLISHED, 0, 1, 0, number, number) for number in range(1, 100)))
    found.take("P", 2, (Record(Kind.PUBLISHED, 0, 2, 0, number, number) for number in range(1, 6)))
    between = Record(Kind.LOST, 0, 2, LossReason.READER_RESTARTED, 97, 0)
    head = Record(Kind.LOST, 0, 2, LossReason.PUBLISHER_RESTARTED, 3, 0)
    found.take("R", 2, iter((between, delivered(4, incarnation_id=2), delivered(5, incarnation_id=2), head)))
    assert not found.incomplete(lambda _, incarnation_id: incarnation_id == 2, SECOND_NS)
    found.take("R", 2, iter((Record(Kind.LOST, 0, 2, LossReason.READER_RESTARTED, 41, 0),)))
    assert found.incomplete(lambda _, incarnation_id: incarnation_id == 2, SECOND_NS)


def test_more_reported_than_missing_is_found() -> None:
    lost = Record(Kind.LOST, 0, 1, 0, 2, 0)
    assert books(delivered(1), delivered(2), lost, sent=2).incomplete(lambda *_: True, SECOND_NS)


def test_the_end_of_a_flow_is_required_only_where_no_process_was_killed() -> None:
    cut_short = books(delivered(1), delivered(2), sent=9)
    assert cut_short.incomplete(lambda *_: True, SECOND_NS)
    assert not cut_short.incomplete(lambda *_: False, SECOND_NS)


def test_a_message_that_came_twice_is_found() -> None:
    assert "came twice" in books(delivered(1), delivered(1), sent=1).incomplete(lambda *_: True, SECOND_NS)[0]


def test_a_message_of_another_publisher_is_a_wrong_one() -> None:
    assert books(delivered(1, publisher=1)).wrong


def test_a_silence_counts_only_while_both_ends_were_connected() -> None:
    must = Timeline()
    must.note(0, connected=True)
    must.note(4 * SECOND_NS, connected=False)
    must.note(7 * SECOND_NS, connected=True)
    found = books(delivered(1, 1.0), delivered(2, 9.0))
    silences = list(found.silences(0, "R", 0, 10 * SECOND_NS, must, 1.5))
    assert [(each.begin_ns // SECOND_NS, each.end_ns // SECOND_NS) for each in silences] == [(1, 4), (7, 9)]


def test_a_call_without_an_answer_or_with_two_is_found() -> None:
    def of(*kinds: Kind) -> list[str]:
        plan = square(services=(Service("/s", ("R",), ("P",)),))
        found = Books(plan)
        found.take("P", 1, (Record(kind, 1, 1, 0, 1, 0) for kind in kinds))
        return found.miscalled(SECOND_NS, lambda *_: True)

    assert not of(Kind.CALLED, Kind.ANSWERED)
    assert not of(Kind.CALLED, Kind.FAILED)
    assert of(Kind.CALLED)
    assert of(Kind.CALLED, Kind.ANSWERED, Kind.ANSWERED)
    assert of(Kind.CALLED, Kind.ANSWERED, Kind.FAILED)


def test_records_come_back_as_they_were_written_also_from_a_file_that_grows(tmp_path: Path) -> None:
    path = tmp_path / "records"
    reader = RecordReader(path)
    one, other = (Record(Kind.DELIVERED, 1, 2, 3, number, 5) for number in (4, 1 << 40))
    assert list(reader.read()) == []
    path.write_bytes(one.to_bytes() + other.to_bytes()[:9])
    assert list(reader.read()) == [one]
    path.write_bytes(one.to_bytes() + other.to_bytes())
    assert list(reader.read()) == [other]
