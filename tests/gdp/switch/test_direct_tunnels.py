"""Direct tunnels: which peers get one, which candidates are tried when, and that both ends try the same."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest

from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.names import Name
from gdp.switch.direct_tunnels import Action, Close, DirectTunnels, Open, Retry, Silence, slots_between

A, B, C = (Name(bytes([number]) * 32) for number in (1, 2, 3))
HOST, REFLEXIVE, PUBLIC, TLS = CandidateType
PORT = 51_820


def record(name: Name, *candidates: tuple[CandidateType, str], sequence: int = 1, uplinks: int = 1) -> EndpointRecord:
    """Return a record, unsigned, whose candidates are all of uplink 0."""
    return EndpointRecord(
        name=name,
        keys=tuple(name[:31] + bytes([uplink]) for uplink in range(uplinks)),
        candidates=tuple(Candidate(0, type_, Endpoint(address, PORT)) for type_, address in candidates),
        sequence=sequence,
        until_unix_s=0,
        membership=b"",
    )


AT_HOME = record(A, (REFLEXIVE, "192.0.2.1"), (HOST, "192.168.1.5"))
IN_CLOUD = record(B, (REFLEXIVE, "198.51.100.1"), (HOST, "10.0.0.7"))


@dataclass
class Bed:
    """Direct tunnels of one switch, and what it would be given."""

    own: EndpointRecord = AT_HOME
    records: dict[Name, EndpointRecord] = field(default_factory=lambda: {B: IN_CLOUD})
    linked: set[Name] = field(default_factory=set)
    up: set[Name] = field(default_factory=set)
    maximum: int = 32
    now_s: float = 0.0

    def __post_init__(self) -> None:
        self.tunnels = DirectTunnels(self.own.name, self.maximum)

    def poll(self) -> list[Action]:
        return self.tunnels.poll_actions(
            own=self.own, records=self.records, linked=self.linked, up=self.up, now_s=self.now_s
        )

    def run(self, duration_s: float) -> list[tuple[float, Action]]:
        """Let time pass; return the actions, each with its second."""
        found, end_s = [], self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            found += [(round(self.now_s, 1), each) for each in self.poll()]
            self.now_s += 0.1
        return found


def addresses(own: EndpointRecord, peer: EndpointRecord) -> list[str]:
    """Return the addresses that ``own`` tries, ``-`` where it waits."""
    return [slot.candidate.endpoint.address if slot.candidate else "-" for slot in slots_between(own, peer)]


@pytest.mark.parametrize(
    ("own", "peer", "tried"),
    [
        ((), (), []),
        (((REFLEXIVE, "192.0.2.1"),), ((REFLEXIVE, "198.51.100.1"),), ["198.51.100.1"]),
        (((REFLEXIVE, "192.0.2.1"),), (), ["-"]),  # the peer may reach it
        ((), ((REFLEXIVE, "198.51.100.1"),), ["198.51.100.1"]),
        ((), ((PUBLIC, "203.0.113.9"),), ["203.0.113.9"]),
        ((), ((TLS, "203.0.113.9"),), []),
        (((HOST, "192.168.1.5"),), ((HOST, "10.0.0.7"),), []),
        (((HOST, "203.0.113.5"),), ((REFLEXIVE, "198.51.100.1"),), ["198.51.100.1"]),
        (((REFLEXIVE, "198.51.100.1"),), ((HOST, "203.0.113.5"),), ["203.0.113.5"]),
        (((HOST, "192.168.1.5"),), ((HOST, "192.168.1.6"),), ["192.168.1.6"]),
        (((HOST, "192.168.1.5"),), ((HOST, "192.168.1.5"),), []),
        (((HOST, "fe80::1"),), ((HOST, "fe80::2"),), []),
        (((HOST, "127.0.0.1"),), ((HOST, "127.0.0.2"),), []),
        (((HOST, "2001:db8::1"),), ((HOST, "2001:db8:9::2"),), ["2001:db8:9::2"]),
        (((HOST, "2001:db8::1"),), ((HOST, "fd00::2"),), []),
        (((HOST, "2001:db8::1"),), ((REFLEXIVE, "198.51.100.1"),), ["198.51.100.1"]),
        (
            ((REFLEXIVE, "192.0.2.1"), (HOST, "192.168.1.5")),
            ((REFLEXIVE, "192.0.2.1"), (HOST, "10.0.0.7")),  # behind one NAT
            ["10.0.0.7", "192.0.2.1"],
        ),
        (
            ((PUBLIC, "203.0.113.8"), (HOST, "2001:db8::1"), (HOST, "10.0.0.6"), (REFLEXIVE, "192.0.2.1")),
            ((PUBLIC, "203.0.113.9"), (REFLEXIVE, "198.51.100.1"), (HOST, "2001:db8::2"), (HOST, "10.0.0.7")),
            ["10.0.0.7", "2001:db8::2", "198.51.100.1", "203.0.113.9"],
        ),
    ],
)
def test_candidates_are_tried_in_the_order_of_their_types(
    own: tuple[tuple[CandidateType, str], ...], peer: tuple[tuple[CandidateType, str], ...], tried: list[str]
) -> None:
    assert addresses(record(A, *own), record(B, *peer)) == tried


def test_both_ends_try_the_same_pairs_at_the_same_time() -> None:
    one = record(A, (REFLEXIVE, "192.0.2.1"), (REFLEXIVE, "192.0.2.2"), (PUBLIC, "203.0.113.9"), uplinks=2)
    other = record(B, (REFLEXIVE, "198.51.100.1"), (REFLEXIVE, "198.51.100.2"), uplinks=3)
    ours, theirs = slots_between(one, other), slots_between(other, one)
    assert [(slot.uplink, slot.peer_uplink) for slot in ours] == [(slot.peer_uplink, slot.uplink) for slot in theirs]
    assert [slot.candidate for slot in theirs[:4]] == [one.candidates[at] for at in (0, 0, 1, 1)]
    assert [slot.candidate for slot in ours[:4]] == [other.candidates[at] for at in (0, 1, 0, 1)]


def test_many_candidates_do_not_make_a_round_long() -> None:
    many = [(REFLEXIVE, f"192.0.2.{number}") for number in range(1, 16)]
    assert len(slots_between(record(A, *many), record(B, *many))) == 4


def test_a_peer_is_opened_and_tried_again_after_growing_pauses() -> None:
    times = [at_s for at_s, action in Bed().run(200) if isinstance(action, Open | Retry)]
    pauses = [later - before - 1.0 for before, later in pairwise(times)]
    assert times[0] == 0.0
    for pause, expected in zip(pauses, (0, 0, 2, 4, 8, 36, 36, 60), strict=False):
        assert 0.75 * expected - 0.2 <= pause <= 1.25 * expected + 0.2


def test_both_ends_draw_the_same_pauses() -> None:
    one, other = Bed(), Bed(own=IN_CLOUD, records={A: AT_HOME})
    times = list(zip(one.run(300), other.run(300), strict=True))
    assert all(abs(ours_s - theirs_s) <= 0.6 for (ours_s, _), (theirs_s, _) in times)  # half a second by chance
    assert all(ours_s == theirs_s for (ours_s, _), (theirs_s, _) in times if ours_s < 30)


def test_after_some_rounds_nothing_is_sent_for_longer_than_nats_remember_and_the_reason_is_said() -> None:
    bed = Bed()
    assert bed.tunnels.failure(B) == ""
    actions = bed.run(120)
    silent = [at_s for at_s, action in actions if isinstance(action, Silence)]
    sent = [at_s for at_s, action in actions if not isinstance(action, Silence)]
    assert silent
    for begin_s in silent[:-1]:
        assert min(at_s for at_s in sent if at_s > begin_s) - begin_s >= 31
    assert "no answer from its endpoints" in bed.tunnels.failure(B)
    bed.up.add(B)
    bed.poll()
    assert bed.tunnels.failure(B) == ""


def test_a_peer_stays_configured_between_attempts() -> None:
    actions = [action for _, action in Bed().run(100) if not isinstance(action, Silence)]
    assert [type(each) for each in actions] == [Open] + [Retry] * (len(actions) - 1)


def test_an_end_without_a_target_configures_its_peer_once_and_waits() -> None:
    bed = Bed(records={B: record(B)})
    assert [action for _, action in bed.run(100)] == [Open(record(B), None)]


def test_nothing_is_tried_while_the_tunnel_is_up() -> None:
    bed = Bed()
    bed.run(0.5)
    bed.up.add(B)
    assert bed.run(300) == []


def test_a_tunnel_that_went_down_recovers_by_itself_or_is_tried_again() -> None:
    bed = Bed()
    bed.run(0.5)
    bed.up.add(B)
    bed.run(100)
    bed.up.clear()
    down_s = bed.now_s
    (first_s, action), *_ = bed.run(10)
    assert isinstance(action, Retry)
    assert 0.9 <= first_s - down_s <= 1.2


@pytest.mark.parametrize("which", ["own", "peer"])
def test_a_changed_record_is_tried_at_once(which: str) -> None:
    bed = Bed()
    bed.run(120)
    moved = (REFLEXIVE, "203.0.113.77")
    if which == "own":
        bed.own = record(A, moved, sequence=2)
    else:
        bed.records = {B: record(B, moved, sequence=2)}
    (action,) = bed.poll()
    assert isinstance(action, Retry)
    assert action.record is bed.records[B]


def test_a_renewed_record_disturbs_no_schedule() -> None:
    renewed, other = Bed(), Bed()
    before = renewed.run(20), other.run(20)
    renewed.records = {B: replace(IN_CLOUD, sequence=2)}
    renewed.own = replace(AT_HOME, sequence=2)
    after = renewed.run(100), other.run(100)
    assert [at_s for at_s, _ in before[0] + after[0]] == [at_s for at_s, _ in before[1] + after[1]]


def test_a_changed_record_leaves_a_tunnel_that_is_up_alone() -> None:
    bed = Bed()
    bed.run(1)
    bed.up.add(B)
    bed.run(1)
    bed.records = {B: record(B, (REFLEXIVE, "203.0.113.77"), sequence=2)}
    assert bed.run(60) == []


def test_a_peer_with_another_key_is_opened_again() -> None:
    bed = Bed()
    bed.run(1)
    bed.up.add(B)
    bed.run(1)
    changed = replace(IN_CLOUD, keys=(b"k" * 32,), sequence=2)
    bed.records, bed.up = {B: changed}, set()
    close, again = bed.poll()
    assert close == Close(B)
    assert isinstance(again, Open)
    assert again.record is changed


def test_a_switch_with_a_link_of_its_own_gets_no_tunnel() -> None:
    bed = Bed(linked={B})
    assert bed.run(60) == []
    assert bed.tunnels.peers([A, B, C], {B}) == [C]


def test_a_tunnel_next_to_a_lasting_link_is_closed() -> None:
    bed = Bed()
    bed.run(1)
    bed.up.add(B)
    bed.run(1)
    bed.linked.add(B)
    closed = bed.run(60)
    assert [action for _, action in closed] == [Close(B)]
    assert closed[0][0] >= 31


def test_a_switch_opens_no_tunnel_to_itself() -> None:
    bed = Bed(records={A: AT_HOME, B: IN_CLOUD})
    assert {action.record.name for _, action in bed.run(30) if not isinstance(action, Close)} == {B}
    assert A not in bed.tunnels.peers([A, B], set())


def test_a_void_record_ends_the_attempts_and_not_a_tunnel_that_is_up() -> None:
    bed = Bed()
    bed.run(1)
    bed.up.add(B)
    bed.run(1)
    bed.records = {}
    assert bed.run(60) == []
    bed.up = set()
    assert [action for _, action in bed.run(60)] == [Close(B)]


def test_the_number_of_tunnels_is_bounded_and_both_ends_choose_alike() -> None:
    names = [Name(bytes([number]) * 32) for number in range(1, 101)]
    chosen: dict[Name, set[Name]] = {}
    for name in names:
        records = {each: record(each, (REFLEXIVE, "192.0.2.1")) for each in names if each != name}
        bed = Bed(own=record(name, (REFLEXIVE, "192.0.2.1")), records=records)
        chosen[name] = {action.record.name for action in bed.poll() if isinstance(action, Open)}
        assert len(chosen[name]) == 32
    mutual = sum(name in chosen[peer] for name in names for peer in chosen[name])
    assert mutual > 0.7 * 32 * len(names)


def test_a_completed_handshake_gives_the_candidate_time_to_come_up() -> None:
    bed = Bed(records={B: record(B, (REFLEXIVE, "198.51.100.1"), (REFLEXIVE, "198.51.100.2"))})
    bed.run(0.5)
    bed.tunnels.answered(B, bed.now_s)
    assert bed.run(2.4) == []
    assert len(bed.run(0.3)) == 1


def test_a_switch_that_was_asleep_tries_the_pair_of_now_only() -> None:
    bed = Bed()
    bed.run(1)
    bed.now_s += 3_600
    assert len(bed.poll()) <= 1


def test_without_an_own_record_all_tunnels_are_closed() -> None:
    bed = Bed()
    bed.run(1)
    closed = bed.tunnels.poll_actions(own=None, records=bed.records, linked=(), up=(), now_s=bed.now_s)
    assert closed == [Close(B)]
