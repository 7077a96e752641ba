"""Keepalives: detection time of silence, value of a recording, and nodes that get more time."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import Hello, NodeSettings, Timing
from gdp.control.keepalive import QUEUED_S, Slowness, open_keepalive
from gdp.control.link_quality import LinkQuality
from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.exchange import ExchangeKey
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType, parse, sign
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, FrameError, RemoteError, StatementError
from gdp.frame.codec import HEADER_BYTES, Header, KeepaliveFlag, Kind, decode
from gdp.intervals import HELLO_IDLE, NEIGHBOUR
from gdp.limits import CLOCK_SKEW_S, COST_AUTO
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from tests.gdp.control.members import POLICY, UNIX_S, YEAR, Nonces, at, node

A, B = node("a"), node("b")
STEP_S = 0.005
FAST = Timing(70, 70, 3)
DETECT_S = 0.21

Filter = Callable[[str, bytes], bool]


class Pair:
    """Two HelloProtocol instances on one link, under a clock that advances in small steps."""

    def __init__(self, one: Timing = FAST, two: Timing = FAST, identities: tuple[Identity, Identity] = (A, B)) -> None:
        self.now_s = 0.0
        self.ends = {
            name: self.hello_protocol(identity, salt, timing)
            for name, identity, salt, timing in zip("ab", identities, (1, 2), (one, two), strict=True)
        }
        self.frames: list[tuple[str, bytes]] = []  # sender, frame
        self.refused: list[DropReason] = []
        self.frozen: set[str] = set()
        self.passes: Filter = lambda _sender, _frame: True
        self.gone_s: dict[str, float] = {}

    @staticmethod
    def hello_protocol(identity: Identity, salt: int, timing: Timing) -> HelloProtocol:
        fragmenter = ControlFragmenter(identity.name, salt)
        settings = NodeSettings(incarnation=salt, first_sequence=0, random_bytes=Nonces(salt))
        made = HelloProtocol(identity, POLICY, fragmenter, settings)
        made.set_timing(0, timing)
        made.add_port(0, bytes([2, salt, 0, 0, 0, 0]), 1_500, 10, 0.0)
        return made

    def hear(self, name: str, frame: bytes) -> None:
        header = decode(frame)
        arrival = ReceivedFrame(0, b"\x02far\x00\x00", frame)
        try:
            if header.kind == Kind.KEEPALIVE:
                self.ends[name].receive_keepalive(arrival, header, at(self.now_s, UNIX_S + self.now_s))
            else:
                statement = parse(frame[HEADER_BYTES : HEADER_BYTES + header.length])
                self.ends[name].receive(arrival, statement, at(self.now_s, UNIX_S + self.now_s))
        except RemoteError as error:
            self.refused.append(error.reason)

    def run(self, duration_s: float) -> None:
        end_s = self.now_s + duration_s
        while self.now_s < end_s:
            self.now_s += STEP_S
            for name, other in ("a", "b"), ("b", "a"):
                if name in self.frozen:
                    continue
                end = self.ends[name]
                due_s = end.get_timer()
                if due_s is None or due_s > self.now_s:
                    continue
                if end.drop_silent(self.now_s):
                    self.gone_s.setdefault(name, self.now_s)
                for transmit in end.hellos_to_send(self.now_s):
                    for frame in transmit.frames:
                        self.frames.append((name, frame))
                        if other not in self.frozen and self.passes(name, frame):
                            self.hear(other, frame)

    def is_up(self, name: str) -> bool:
        return bool(self.ends[name].neighbours.all_up())

    def count(self, kind: Kind) -> int:
        return sum(decode(frame).kind == kind for _, frame in self.frames)


def up(pair: Pair) -> Pair:
    pair.run(3.0)
    assert pair.is_up("a")
    assert pair.is_up("b")
    pair.frames.clear()
    return pair


def test_a_node_with_one_neighbour_wakes_once_for_what_comes_and_what_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{__name__}.STEP_S", 0.001)
    pair = up(Pair())
    end, wakes = pair.ends["a"], 0
    receive, get_timer, send = end.receive_keepalive, end.get_timer, end.hellos_to_send

    def received(arrival: ReceivedFrame, header: Header, now: Timestamps) -> Neighbour:
        nonlocal wakes
        wakes += 1
        known = receive(arrival, header, now)
        if end.offload.frames_came(now.mono_s):
            end.drop_silent(now.mono_s)
            for transmit in send(now.mono_s):
                for frame in transmit.frames:
                    pair.frames.append(("a", frame))
                    pair.hear("b", frame)
        return known

    def ran(now_s: float) -> list[OutgoingFrames]:
        nonlocal wakes
        wakes += 1
        return send(now_s)

    end.receive_keepalive, end.hellos_to_send = received, ran  # type: ignore[method-assign]
    end.get_timer = lambda: None if (due_s := get_timer()) is None else end.offload.latest_s(due_s)  # type: ignore[method-assign]
    pair.run(14.0)
    intervals = 14.0 / FAST.interval_s(FAST)
    sent = sum(sender == "a" for sender, _ in pair.frames)
    assert intervals <= sent <= intervals * 1.2
    assert wakes <= sent * 1.2


def test_a_silent_cut_is_noticed_within_the_detection_time() -> None:
    pair = up(Pair())
    cut_s = pair.now_s
    pair.passes = lambda _sender, _frame: False
    pair.run(0.3)
    assert {name: gone_s - cut_s <= DETECT_S + 2 * STEP_S for name, gone_s in pair.gone_s.items()} == {
        "a": True,
        "b": True,
    }


def test_neighbours_that_hear_keepalives_sign_few_hellos() -> None:
    pair = up(Pair())
    pair.run(HELLO_IDLE * NEIGHBOUR.refresh_s)
    assert pair.count(Kind.HELLO) <= 4
    assert pair.count(Kind.KEEPALIVE) >= 2 * HELLO_IDLE * NEIGHBOUR.refresh_s / 0.07


@pytest.mark.parametrize(
    ("one", "two", "interval_s"),
    [
        (Timing(70, 70, 3), Timing(200, 70, 3), 0.07),
        (Timing(70, 70, 3), Timing(70, 200, 3), 0.2),
        (Timing(300, 70, 3), Timing(70, 70, 3), 0.3),
        (Timing(0, 70, 3), Timing(70, 70, 3), 0.0),
        (Timing(70, 70, 3), Timing(70, 0, 3), 0.0),
    ],
)
def test_the_slower_of_what_one_sends_and_the_other_takes_wins(one: Timing, two: Timing, interval_s: float) -> None:
    assert one.interval_s(two) == interval_s


def test_the_senders_multiplier_decides_how_long_silence_may_last() -> None:
    pair = up(Pair(two=Timing(100, 100, 5)))
    (neighbour,) = pair.ends["a"].neighbours.all_up()
    assert neighbour.keepalives is not None
    assert neighbour.keepalives.detect_s == pytest.approx(0.5)


@pytest.mark.parametrize("silent", [Timing(0, 0, 3), Timing(0, 70, 3), Timing(70, 0, 3)])
def test_where_one_end_wants_no_keepalives_hellos_go_on(silent: Timing) -> None:
    pair = up(Pair(two=silent))
    pair.run(5.0)
    assert pair.count(Kind.KEEPALIVE) == 0
    assert pair.is_up("a")
    assert pair.is_up("b")


def test_who_is_heard_but_does_not_hear_is_let_go_at_both_ends() -> None:
    pair = up(Pair())
    cut_s = pair.now_s
    pair.passes = lambda sender, _frame: sender == "a"
    pair.run(DETECT_S + 0.05)
    assert not pair.is_up("a")
    assert not pair.is_up("b")
    assert pair.gone_s["a"] - cut_s <= DETECT_S + 2 * STEP_S


def test_a_neighbour_comes_back_in_the_same_session() -> None:
    pair = up(Pair())
    pair.passes = lambda _sender, _frame: False
    pair.run(1.0)
    pair.passes = lambda _sender, _frame: True
    pair.refused.clear()
    pair.run(1.0)
    assert pair.is_up("a")
    assert pair.is_up("b")
    assert set(pair.refused) <= {DropReason.UNKNOWN_SENDER}  # until the other has received our echo


class Frames:
    """Count of frames that come from a port while a condition holds."""

    def __init__(self, pair: Pair, until_s: float) -> None:
        self._pair, self._until_s = pair, until_s

    def __call__(self, _port: int) -> int:
        return int(1_000 * min(self._pair.now_s, self._until_s))


def test_while_other_frames_come_a_neighbour_may_be_silent_for_three_seconds_more() -> None:
    pair = up(Pair())
    cut_s = pair.now_s
    pair.ends["a"].liveness.count_arrivals(Frames(pair, float("inf")))
    pair.passes = lambda sender, _frame: sender == "a"
    pair.run(QUEUED_S)
    assert pair.is_up("a")
    assert pair.is_up("b")
    pair.run(2 * DETECT_S)
    assert pair.gone_s["a"] - cut_s == pytest.approx(QUEUED_S + DETECT_S, abs=0.1)


def test_a_neighbour_whose_frames_stop_is_lost_a_detection_time_later() -> None:
    pair = up(Pair())
    cut_s = pair.now_s
    pair.ends["a"].liveness.count_arrivals(Frames(pair, cut_s + 1))
    pair.passes = lambda sender, _frame: sender == "a"
    pair.run(2)
    assert pair.gone_s["a"] - cut_s == pytest.approx(1 + DETECT_S, abs=0.1)


def test_frames_of_before_the_silence_give_no_time() -> None:
    pair = up(Pair())
    cut_s = pair.now_s
    pair.ends["a"].liveness.count_arrivals(Frames(pair, cut_s))
    pair.passes = lambda _sender, _frame: False
    pair.run(0.3)
    assert pair.gone_s["a"] - cut_s <= DETECT_S + 2 * STEP_S


def test_where_several_nodes_are_on_a_port_its_frames_give_no_time() -> None:
    pair = up(Pair())
    for transmit in Pair.hello_protocol(node("c"), 3, FAST).hellos_to_send(0.0):
        for frame in transmit.frames:
            pair.hear("a", frame)
    cut_s = pair.now_s
    pair.ends["a"].liveness.count_arrivals(Frames(pair, float("inf")))
    pair.passes = lambda sender, _frame: sender == "a"
    pair.run(0.3)
    assert pair.gone_s["a"] - cut_s <= DETECT_S + 2 * STEP_S


def test_two_keepalives_lost_in_a_row_lose_no_neighbour_and_are_followed_by_polls() -> None:
    pair = up(Pair())
    lost = [2]

    def passes(sender: str, _frame: bytes) -> bool:
        if sender == "b" and lost[0]:
            lost[0] -= 1
            return False
        return True

    pair.passes = passes
    pair.run(0.5)
    assert pair.gone_s == {}
    assert any(frame[HEADER_BYTES] & KeepaliveFlag.POLL for sender, frame in pair.frames if sender == "a")
    assert any(frame[HEADER_BYTES] & KeepaliveFlag.FINAL for sender, frame in pair.frames if sender == "b")


def keepalives_of(pair: Pair, sender: str) -> list[bytes]:
    return [frame for name, frame in pair.frames if name == sender and decode(frame).kind == Kind.KEEPALIVE]


def refusal(pair: Pair, frame: bytes) -> list[DropReason]:
    pair.refused.clear()
    pair.hear("a", frame)
    return pair.refused


def test_a_keepalive_played_back_is_refused_even_after_a_silence() -> None:
    pair = up(Pair())
    pair.run(0.5)
    recorded = keepalives_of(pair, "b")
    assert refusal(pair, recorded[-1]) == [DropReason.REPLAYED]
    pair.passes = lambda _sender, _frame: False
    pair.run(1.0)
    pair.passes = lambda _sender, frame: decode(frame).kind == Kind.HELLO
    pair.run(0.3)
    assert pair.is_up("a")
    assert {reason for frame in recorded for reason in refusal(pair, frame)} == {DropReason.REPLAYED}


def test_a_keepalive_of_an_earlier_session_is_refused() -> None:
    pair = up(Pair())
    pair.run(0.2)
    recorded = keepalives_of(pair, "b")[-1]
    for end in pair.ends.values():
        end.port_changed(0, False, pair.now_s)
        end.port_changed(0, True, pair.now_s)
    up(pair)
    newer = keepalives_of(pair, "b")
    assert newer == []
    assert refusal(pair, recorded) in ([DropReason.BAD_TAG], [DropReason.REPLAYED])


def test_a_keepalive_that_was_changed_is_refused() -> None:
    pair = up(Pair())
    pair.passes = lambda sender, _frame: sender == "a"
    pair.run(0.1)
    frame = keepalives_of(pair, "b")[-1]
    for at_byte in (2, 15, HEADER_BYTES, HEADER_BYTES + 1, len(frame) - 1):
        assert refusal(pair, frame[:at_byte] + bytes([frame[at_byte] ^ 1]) + frame[at_byte + 1 :]) == [
            DropReason.BAD_TAG
        ]
    assert refusal(pair, frame) == []


def test_a_strangers_keepalive_is_refused_and_not_answered() -> None:
    pair = up(Pair())
    pair.run(0.1)
    frame = keepalives_of(pair, "a")[-1]  # a's own, come back
    pair.ends["a"].hellos_to_send(pair.now_s)  # frames that are due anyway
    assert refusal(pair, frame) == [DropReason.UNKNOWN_SENDER]
    assert pair.ends["a"].hellos_to_send(pair.now_s) == []


def test_a_short_keepalive_is_refused() -> None:
    with pytest.raises(FrameError) as caught:
        open_keepalive(bytes(32), bytes(HEADER_BYTES + 25))
    assert caught.value.reason is DropReason.TRUNCATED


def test_keepalives_do_not_keep_up_whose_membership_ran_out() -> None:
    short = node("short", validity=Validity(YEAR.not_before_unix_s, UNIX_S + 5 - int(CLOCK_SKEW_S)))
    pair = up(Pair(identities=(A, short)))
    pair.run(10.0)
    assert not pair.is_up("a")


def test_a_node_that_had_no_time_itself_reports_no_neighbour_as_silent() -> None:
    pair = up(Pair())
    pair.frozen |= {"a", "b"}
    pair.run(1.0)
    pair.frozen.clear()
    pair.run(1.0)
    assert pair.gone_s == {}


def test_a_frozen_node_is_let_go_and_comes_back() -> None:
    pair = up(Pair())
    pair.frozen.add("a")
    pair.run(5.0)
    assert not pair.is_up("b")
    pair.frozen.clear()
    pair.run(2.0)
    assert pair.is_up("a")
    assert pair.is_up("b")


def test_a_node_whose_timers_are_late_asks_for_patience_and_less_so_later() -> None:
    slow = Slowness()
    assert slow.multiplier(FAST, NEIGHBOUR.lease_s, 0.0) == 3
    slow.late(0.14, 0.0)
    assert slow.multiplier(FAST, NEIGHBOUR.lease_s, 0.0) == 7
    assert slow.multiplier(FAST, NEIGHBOUR.lease_s, 10.0) == 5
    assert slow.multiplier(FAST, NEIGHBOUR.lease_s, 60.0) == 3
    slow.late(60.0, 60.0)
    assert slow.multiplier(FAST, NEIGHBOUR.lease_s, 60.0) == int(NEIGHBOUR.lease_s / 0.07)


def test_a_key_that_makes_a_secret_everybody_knows_is_refused() -> None:
    key = ExchangeKey.from_random(bytes(range(32)))
    with pytest.raises(StatementError) as caught:
        key.agree(bytes(32), b"purpose")
    assert caught.value.reason is DropReason.MALFORMED


@pytest.mark.parametrize("timing", [[70, 70], [70, 70, 0], [70, 70, 256], [-1, 70, 3], [70, 60_001, 3], [70, "x", 3]])
def test_a_timing_out_of_bounds_is_refused(timing: list[object]) -> None:
    hello = Hello(nonce=b"n" * 8, sequence=1, heard=(), mtu=1_500, digest=bytes(8), membership=B.membership)
    statement = parse(sign(StatementType.HELLO, hello.to_fields() | {"k": timing}, B.name, B.key))
    with pytest.raises(StatementError) as caught:
        Hello.from_fields(statement.fields)
    assert caught.value.reason is DropReason.MALFORMED


def test_a_hello_with_timing_and_key_comes_back_as_it_was() -> None:
    hello = Hello(
        nonce=b"n" * 8,
        sequence=1,
        heard=(),
        mtu=1_500,
        digest=bytes(8),
        membership=B.membership,
        timing=FAST,
        exchange_key=b"k" * 32,
    )
    assert Hello.from_fields(parse(hello.to_wire(B.name, B.key)).fields) == hello


def test_a_neighbour_that_is_up_by_hellos_alone_is_given_their_time() -> None:
    pair = Pair()
    pair.passes = lambda _sender, frame: decode(frame).kind == Kind.HELLO
    pair.run(5.0)
    assert pair.gone_s == {}
    assert [n.state for n in pair.ends["a"].neighbours.all_up()] == [NeighbourState.UP]


def quality(pair: Pair, name: str) -> LinkQuality:
    end = pair.ends[name]
    (neighbour,) = end.neighbours.all_up()
    return end.ports[0].quality_of(neighbour.name)


def test_keepalives_measure_the_round_trip_time_and_the_loss_of_each_direction() -> None:
    pair = up(Pair())
    chance = random.Random(1)
    pair.passes = lambda sender, frame: decode(frame).kind == Kind.HELLO or sender == "a" or chance.random() >= 0.2
    pair.run(30.0)
    for name, lost in ("a", "loss_in"), ("b", "loss_out"):
        assert getattr(quality(pair, name), lost) == pytest.approx(0.2, abs=0.1)
    assert quality(pair, "b").loss_in == 0
    assert (quality(pair, "a").rtt.srtt_s or 0.0) <= STEP_S


def test_a_forged_echo_or_loss_makes_no_link_look_better() -> None:
    pair = up(Pair())
    pair.passes = lambda sender, _frame: sender == "a"
    pair.run(0.1)
    frame = keepalives_of(pair, "b")[-1]
    here = quality(pair, "a")
    before = here.rtt.srtt_s, here.loss_out, here.loss_in
    report_at = HEADER_BYTES + 2 + 8
    for at_byte in range(report_at, report_at + 21):
        forged = frame[:at_byte] + bytes([frame[at_byte] ^ 0x80]) + frame[at_byte + 1 :]
        assert refusal(pair, forged) == [DropReason.BAD_TAG]
    assert (here.rtt.srtt_s, here.loss_out, here.loss_in) == before


def test_a_replayed_keepalive_makes_no_link_look_better() -> None:
    pair = up(Pair())
    pair.run(1.0)
    here = quality(pair, "a")
    before = here.rtt.srtt_s, here.loss_in
    for frame in keepalives_of(pair, "b"):
        assert refusal(pair, frame) == [DropReason.REPLAYED]
    assert (here.rtt.srtt_s, here.loss_in) == before


def test_a_delayed_keepalive_makes_a_link_look_slower_only() -> None:
    pair = up(Pair())
    here = quality(pair, "a")
    before_s = here.rtt.srtt_s or 0.0
    for _ in range(10):
        pair.passes = lambda *_: True
        pair.run(0.2)
        pair.passes = lambda sender, _frame: sender == "a"  # for less than the detection time
        pair.run(0.08)
        frame = keepalives_of(pair, "b")[-1]
        pair.run(0.03)
        assert refusal(pair, frame) == []
    assert (here.rtt.srtt_s or 0.0) >= before_s - 1e-6  # below the resolution of a report


def test_a_fixed_cost_is_not_changed_by_what_is_measured() -> None:
    pair = up(Pair())
    pair.run(1.0)
    end = pair.ends["a"]
    assert [each.cost for each in end.neighbours.all_up()] == [10]
    assert end.neighbours.poll_costs() == []


def test_an_automatic_cost_is_reported_once_and_follows_the_measurement() -> None:
    pair = up(Pair())
    end = pair.ends["a"]
    end.add_port(0, end.ports[0].mac, 1_500, COST_AUTO, pair.now_s)
    end.ports[0].qualities.clear()
    for each in end.neighbours.all_up():
        each.keepalives = None
    pair.run(5.0)
    assert [(each.cost, before) for each, before in end.neighbours.poll_costs()] == [(10, NeighbourState.UP)]
    assert end.neighbours.poll_costs() == []


def test_a_link_that_comes_back_keeps_its_cost() -> None:
    pair = up(Pair())
    end = pair.ends["a"]
    end.add_port(0, end.ports[0].mac, 1_500, COST_AUTO, pair.now_s)
    measured = quality(pair, "a")
    pair.passes = lambda _sender, _frame: False
    pair.run(1.0)
    assert not pair.is_up("a")
    pair.passes = lambda _sender, _frame: True
    pair.run(0.5)
    assert quality(pair, "a") is measured
    assert [each.cost for each in end.neighbours.all_up()] == [measured.cost.advertised]
