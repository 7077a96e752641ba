"""Channels: each statement is from its signer and fresh; recorded handshakes and records open nothing."""

from __future__ import annotations

import contextlib
import random
from dataclasses import dataclass, field

import pytest

from gdp.control.channel import Channels, Outgoing
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.errors import DropReason, RemoteError
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy
from tests.gdp.trust.world import CLOUD, DAY, NOW, ROBOT, SCHOOL, SWITCH

RIB = NodeKeys.generate(Role.RIB, "rib").join(SCHOOL, DAY)
STRANGER = NodeKeys.generate(Role.SWITCH, "stranger").join(CLOUD, DAY)
SAID = b"\xd2 a statement"


@dataclass
class Pair:
    """Querying switch and a RIB, with all frames that either ever sent."""

    asker: Channels
    rib: Channels
    now_s: float = 0.0
    asked: list[bytes] = field(default_factory=list)
    answered: list[bytes] = field(default_factory=list)

    @property
    def now(self) -> Timestamps:
        return Timestamps(self.now_s, NOW + self.now_s)

    def exchange(self) -> tuple[list[bytes], list[bytes]]:
        """Carry all frames over; return the fresh statements that came to the RIB, and to the switch."""
        at_rib: list[bytes] = []
        at_asker: list[bytes] = []
        while there := (out := self.asker.records_to_send()) + (back := self.rib.records_to_send()):
            assert all(each.to in (RIB.name, SWITCH.name) for each in there)
            self.asked += [each.wire for each in out]
            self.answered += [each.wire for each in back]
            at_rib += self._received(self.rib, out, SWITCH)
            at_asker += self._received(self.asker, back, RIB)
        return at_rib, at_asker

    def _received(self, to: Channels, sent: list[Outgoing], by: Identity) -> list[bytes]:
        found = [to.receive(each.wire, by.name, self.now) for each in sent]
        return [each.wire for each in found if each is not None and each.is_fresh]

    def refused(self, to: Channels, wire: bytes, by: Identity = SWITCH) -> DropReason:
        with pytest.raises(RemoteError) as caught:
            to.receive(wire, by.name, self.now)
        return caught.value.reason


def node(identity: Identity, seed: int, *, accepts: bool = False, trusts: bool = False) -> Channels:
    policy = Policy(SCHOOL.root, [CLOUD.root] if trusts else [])
    return Channels(identity, policy, random.Random(seed).randbytes, accepts=accepts)


def pair() -> Pair:
    return Pair(node(SWITCH, 1), node(RIB, 2, accepts=True))


def opened() -> Pair:
    both = pair()
    both.asker.send_query(RIB.name, SAID, 0.0)
    assert both.exchange() == ([SAID], [])
    return both


def test_what_waits_for_a_channel_is_sent_once_it_is_open_and_answered_over_it() -> None:
    both = pair()
    assert not both.rib.send_response(SWITCH.name, b"an answer")
    both.asker.send_query(RIB.name, b"first", 0.0)
    both.asker.send_query(RIB.name, b"second", 0.0)
    assert both.exchange() == ([b"first", b"second"], [])
    assert both.rib.send_response(SWITCH.name, b"an answer")
    assert both.exchange() == ([], [b"an answer"])


def test_nothing_that_was_said_can_be_read_or_altered_on_the_way() -> None:
    both = opened()
    assert not any(SAID in wire for wire in both.asked)
    both.asker.send_query(RIB.name, SAID, 0.0)
    (record,) = both.asker.records_to_send()
    for at in range(17, len(record.wire)):
        altered = record.wire[:at] + bytes([record.wire[at] ^ 1]) + record.wire[at + 1 :]
        assert both.refused(both.rib, altered) is DropReason.BAD_TAG
    for at in range(9, 17):
        altered = record.wire[:at] + bytes([record.wire[at] ^ 1]) + record.wire[at + 1 :]
        assert both.refused(both.rib, altered) in (DropReason.BAD_TAG, DropReason.REPLAYED)
    assert both.rib.receive(record.wire, SWITCH.name, both.now) == (SAID, True)


def test_records_may_come_out_of_order_and_each_once() -> None:
    both = opened()
    for number in range(50):
        both.asker.send_query(RIB.name, b"%d" % number, 0.0)
    records = both.asker.records_to_send()
    random.Random(3).shuffle(records)
    found = [both.rib.receive(each.wire, SWITCH.name, both.now) for each in records]
    assert {each.wire for each in found if each is not None} == {b"%d" % number for number in range(50)}
    assert {both.refused(both.rib, each.wire) for each in records} == {DropReason.REPLAYED}


@pytest.mark.parametrize("restarted", ["asker", "rib", "both"])
def test_no_recording_of_an_earlier_life_is_taken_after_a_restart(restarted: str) -> None:
    both = opened()
    both.rib.send_response(SWITCH.name, b"an answer")
    both.exchange()
    asked, answered = list(both.asked), list(both.answered)
    if restarted in ("asker", "both"):
        both.asker = node(SWITCH, 11)
    if restarted in ("rib", "both"):
        both.rib = node(RIB, 12, accepts=True)
    for _ in range(2):  # before there is a channel again, and after
        for wire in asked:
            try:
                taken = both.rib.receive(wire, SWITCH.name, both.now)
            except RemoteError:
                continue
            assert taken is None
        for wire in answered:
            try:
                taken = both.asker.receive(wire, RIB.name, both.now)
            except RemoteError:
                continue
            assert taken is None
        both.rib.records_to_send()
        both.asker.records_to_send()
        both.asker.renew(RIB.name)
        both.asker.send_query(RIB.name, b"again", both.now_s)
        assert both.exchange() == ([b"again"], [])


def test_a_recorded_offer_draws_no_more_than_its_own_bytes_and_displaces_no_channel() -> None:
    both = opened()
    offer = both.asked[0]
    spent = drawn = 0
    for number in range(1_000):
        both.now_s = number / 1_000
        spent += len(offer)
        with contextlib.suppress(RemoteError):  # above the pace
            both.rib.receive(offer, SWITCH.name, both.now)
        drawn += sum(len(each.wire) for each in both.rib.records_to_send())
    assert 0 < drawn <= spent
    both.asker.send_query(RIB.name, SAID, both.now_s)
    assert both.exchange() == ([SAID], [])


def test_a_channel_is_opened_by_members_for_whom_it_names_only() -> None:
    both = opened()
    foreign = node(STRANGER, 5)
    foreign.send_query(RIB.name, SAID, 0.0)
    (offer,) = foreign.records_to_send()
    assert both.refused(both.rib, offer.wire, STRANGER) is DropReason.WRONG_DOMAIN
    assert both.refused(both.rib, offer.wire) is DropReason.UNKNOWN_SENDER
    assert both.refused(node(RIB, 2, accepts=False), offer.wire, STRANGER) is DropReason.NOT_FOR_US
    for_another = node(SWITCH, 6)
    for_another.send_query(ROBOT.name, SAID, 0.0)
    assert both.refused(both.rib, for_another.records_to_send()[0].wire) is DropReason.NOT_FOR_US
    proxy = node(ROBOT, 7)
    proxy.send_query(RIB.name, SAID, 0.0)
    assert both.refused(both.rib, proxy.records_to_send()[0].wire, ROBOT) is DropReason.NOT_DELEGATED


def test_an_acceptance_of_another_offer_opens_nothing() -> None:
    both, other = opened(), opened()
    both.asker.renew(RIB.name)
    both.asker.send_query(RIB.name, SAID, 0.0)
    both.asker.records_to_send()
    for accept in (both.answered[0], other.answered[0]):
        assert both.refused(both.asker, accept, RIB) is DropReason.REPLAYED


def test_a_rib_that_was_restarted_says_so_and_is_asked_for_a_channel_at_once() -> None:
    both = opened()
    both.rib = node(RIB, 9, accepts=True)
    both.now_s = 5.0
    both.asker.send_query(RIB.name, b"lost", 5.0)
    (record,) = both.asker.records_to_send()
    assert both.refused(both.rib, record.wire) is DropReason.NO_CHANNEL
    (hint,) = both.rib.records_to_send()
    assert len(hint.wire) < len(record.wire)
    both.asker.receive(hint.wire, RIB.name, both.now)
    both.exchange()
    both.asker.send_query(RIB.name, SAID, 5.0)
    assert both.exchange() == ([SAID], [])


def test_forged_hints_end_no_channel_and_cost_one_offer_each_third_of_a_second() -> None:
    both = opened()
    for number in range(100):
        both.now_s = 1 + number / 100
        hint = b"\x02" + both.asked[-1][1:9]
        with contextlib.suppress(RemoteError):  # it names the channel before
            both.asker.receive(hint, RIB.name, both.now)
        both.asker.send_query(RIB.name, SAID, both.now_s)
        assert SAID in both.exchange()[0]
    offers = sum(1 for wire in both.asked if wire[0] == 0xD2)
    assert offers <= 5


def test_an_offer_that_is_not_answered_is_repeated_and_given_up() -> None:
    both = pair()
    both.asker.send_query(RIB.name, SAID, 0.0)
    sent = len(both.asker.records_to_send())
    while (due_s := both.asker.get_timer()) is not None:
        both.asker.handle_timer(due_s)
        sent += len(both.asker.records_to_send())
    assert (sent, both.asker.drops[DropReason.NO_CHANNEL]) == (4, 1)
    both.asker.send_query(RIB.name, SAID, 9.0)
    assert both.exchange() == ([SAID], [])


def test_what_waited_too_long_is_not_sent_for_its_sender_has_sent_it_again() -> None:
    both = pair()
    both.asker.send_query(RIB.name, b"old", 0.0)
    both.asker.records_to_send()
    both.now_s = 1.5
    both.asker.handle_timer(1.5)
    both.asker.send_query(RIB.name, b"new", 1.5)
    assert both.exchange() == ([b"new"], [])
