"""Sans-I/O parts that all benches share: figures over rounds, the search for a rate, prepared frames."""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gdp.frame.codec import ETHER_BYTES, decode
from gdp.frame.kinds import ETHERTYPE
from gdp.names import NAME_BYTES

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts" / "bench"))

from frames import NAME_AT, SINK, SOURCE, gdp_frame, ip_checksum, ip_frame
from machine import machine_state, offload_text
from rate_search import LATE_MAX_S, LOSS_MAX, Try, highest
from report import Rounds, Spread, number_text, percentile, write_json

CASE, COLUMN = "1,400 B", "frames/s"
MACS = bytes(range(12))
GOOD = Try(asked=100.0, sent=100_000, got=100_000, sink_drops=0, send_s=1.0, late_s=0.0, cpu_s=0.1)


def rounds(**values: list[float | None]) -> Rounds:
    over = Rounds()
    for contender, each in values.items():
        for value in each:
            over.add(contender, CASE, COLUMN, value)
    return over


def test_a_ratio_is_taken_in_each_round_before_the_median() -> None:
    target = rounds(ours=[20.0, 2.0, 30.0], theirs=[10.0, 1.0, 30.0]).ratio("", "ours", "theirs", CASE, COLUMN, 1.5)
    assert target.measured == Spread(2.0, 1.0, 2.0)
    assert target.met


def test_a_round_that_failed_on_one_side_is_no_ratio() -> None:
    target = rounds(ours=[None, 3.0], theirs=[1.0, 1.0]).ratio("", "ours", "theirs", CASE, COLUMN, 4.0)
    assert target.measured == Spread(3.0, 3.0, 3.0)
    assert not target.met
    assert "MISSED" in str(target)


def test_an_upper_bound_is_kept_from_below() -> None:
    over = rounds(ours=[7.0], theirs=[10.0])
    assert over.ratio("", "ours", "theirs", CASE, COLUMN, 0.7, at_most=True).met
    assert not over.ratio("", "ours", "theirs", CASE, COLUMN, 0.6, at_most=True).met
    assert not over.difference("", "theirs", "ours", CASE, COLUMN, 2.5).met


def test_who_is_not_here_leaves_a_reason_in_place_of_a_figure() -> None:
    over = rounds(theirs=[1.0])
    over.absent("ours", "no CAP_BPF")
    target = over.ratio("speed", "ours", "theirs", CASE, COLUMN, 1.0)
    assert target.met is None
    assert str(target) == "speed: target ≥ 1.00, not measured: ours is not here: no CAP_BPF"


def test_a_figure_without_a_bound_is_only_printed() -> None:
    target = rounds(ours=[1.0], theirs=[4.0]).ratio("peer", "ours", "theirs", CASE, COLUMN, None)
    assert target.met is None
    assert str(target) == "peer: measured 0.25"


@pytest.mark.parametrize(("share", "value"), [(0.5, 50), (0.99, 99), (1.0, 100), (0.0, 1)])
def test_a_percentile_is_one_of_the_values(share: float, value: int) -> None:
    assert percentile(range(100, 0, -1), share) == value


def test_no_values_have_no_percentile() -> None:
    with pytest.raises(ValueError, match="no values"):
        percentile([], 0.5)


@pytest.mark.parametrize(
    ("value", "text"),
    [(450_123.4, "450,123"), (244.4, "244"), (15.64, "15.6"), (0.7, "0.70"), (0.0123, "0.012"), (0, "0.00")],
)
def test_a_figure_shows_the_digits_that_mean_something(value: float, text: str) -> None:
    assert number_text(value) == text


def test_the_file_holds_every_round_and_what_came_of_the_goals(tmp_path: Path) -> None:
    over = rounds(ours=[1.0, 2.0], theirs=[1.0, 1.0])
    over.absent("scapy", "not installed")
    target = over.ratio("speed", "ours", "theirs", CASE, COLUMN, 1.5)
    path = tmp_path / "new" / "figures.json"
    write_json(path, "forwarding", machine_state(), {"MTU": [1_500]}, over, [target])
    written = json.loads(path.read_text())
    assert written["rounds"]["ours"][CASE][COLUMN] == [1.0, 2.0]
    assert written["not_here"] == {"scapy": "not installed"}
    assert written["targets"][0]["met"]
    assert written["machine"]["kernel"]


def test_offloads_that_differ_between_devices_are_called_mixed() -> None:
    assert offload_text([{"tso": True, "gro": False, "gso": True}, {"tso": True, "gro": False, "gso": False}]) == (
        "tso on, gro off, gso mixed"
    )


@pytest.mark.parametrize(
    "spoilt",
    [
        replace(GOOD, got=round(100_000 * (1 - LOSS_MAX))),
        replace(GOOD, late_s=LATE_MAX_S),
        replace(GOOD, asked=120_000.0),
        replace(GOOD, sent=0, got=0),
    ],
    ids=["lost", "late", "slow source", "nothing sent"],
)
def test_a_try_that_loses_lags_or_lacks_frames_does_not_hold(spoilt: Try) -> None:
    assert GOOD.holds
    assert not spoilt.holds


def test_frames_that_come_late_make_the_rate_smaller() -> None:
    assert replace(GOOD, late_s=0.25).rate == 80_000


class Path40k:
    """Path that carries 40,000 frames/s and loses the excess; its source can send 100,000/s."""

    def __init__(self, carries: float = 40_000.0, spoilt: int = 0) -> None:
        self.carries = carries
        self.asked: list[float | None] = []
        self._spoilt = spoilt

    def attempt(self, rate: float | None) -> Try:
        self.asked.append(rate)
        sent = round(rate or 100_000.0)
        got = min(sent, round(self.carries))
        if len(self.asked) == self._spoilt:
            got //= 2
        return Try(rate, sent, got, 0, 1.0, 0.0, 0.1)


@pytest.mark.parametrize("guess", [None, 1_000.0, 39_000.0, 90_000.0])
def test_the_highest_rate_is_found_from_any_guess(guess: float | None) -> None:
    best = highest(Path40k().attempt, guess)
    assert best is not None
    assert 0.94 * 40_000 < best.rate <= 40_000 * (1 + LOSS_MAX)


def test_a_path_that_carries_all_is_measured_flat_out() -> None:
    path = Path40k(carries=200_000.0)
    best = highest(path.attempt, None)
    assert best is not None
    assert best.rate == 100_000
    assert set(path.asked) == {None}


def test_one_spoilt_try_does_not_spoil_the_answer() -> None:
    best = highest(Path40k(spoilt=1).attempt, 39_000.0)
    assert best is not None
    assert best.rate > 0.94 * 40_000


def test_a_dead_path_has_no_highest_rate() -> None:
    assert highest(Path40k(carries=0.0).attempt, 1_000.0) is None


@pytest.mark.parametrize("size", [128, 1_400, 8_900])
def test_frames_of_both_kinds_are_as_long_as_asked(size: int) -> None:
    ours, theirs = gdp_frame(MACS, size, SINK, SOURCE), ip_frame(MACS, size, "10.99.4.2", "10.99.1.1")
    assert len(ours) == len(theirs) == size
    assert ours[12:14] == ETHERTYPE.to_bytes(2, "big")
    header = decode(ours[ETHER_BYTES:])
    assert (header.destination, header.source) == (SINK, SOURCE)
    assert ours[NAME_AT : NAME_AT + NAME_BYTES] == SINK


def test_an_ip_header_sums_up_to_nothing() -> None:
    frame = ip_frame(MACS, 128, "10.99.4.2", "10.99.1.1")
    assert ip_checksum(frame[14:34]) == 0
    assert struct.unpack_from("!H", frame, 16)[0] == 128 - ETHER_BYTES
