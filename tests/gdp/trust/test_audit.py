"""Audit trail: chained, and a flood is one line and a count."""

from __future__ import annotations

import dataclasses

import pytest

from gdp.errors import LocalError
from gdp.trust.audit import BEGIN, Action, AuditLine, AuditTrail


def trail() -> AuditTrail:
    made = AuditTrail()
    made.begin()
    return made


def taken(from_: AuditTrail, mono_s: float, after: list[AuditLine] | None = None) -> list[AuditLine]:
    seq, previous = (after[-1].seq, after[-1].hash) if after else (0, BEGIN)
    return from_.poll_lines(mono_s, 1_800_000_000.0 + mono_s, seq, previous)


def test_lines_are_numbered_and_each_holds_the_hash_of_the_one_before() -> None:
    of = trail()
    of.record(Action.ACCEPTED, "name", who="aa", about="bb")
    of.record(Action.REFUSED, "name", who="cc", reason="stale")
    one, two = taken(of, 0.0)
    assert (one.seq, one.previous, two.seq, two.previous) == (1, BEGIN, 2, one.hash)
    assert AuditLine.from_line(two.to_line() + b"\n") == two
    assert not taken(of, 0.0, [one, two])


def test_an_unread_trail_keeps_nothing() -> None:
    of = AuditTrail()
    of.record(Action.ACCEPTED, "name")
    assert not of.is_due(1e9)


def test_a_flood_is_bounded_in_memory_and_in_lines() -> None:
    of = trail()
    lines: list[AuditLine] = []
    for second in range(3_600):
        for number in range(100):
            of.record(Action.REFUSED, "name", who=f"{number}", reason=f"reason {number % 5}")
        lines += taken(of, float(second), lines)
        assert len(of._lines) <= 200
        assert len(of._counts) <= 256
    lines += taken(of, 3_700.0, lines)
    assert sum(line.count for line in lines) == 360_000
    assert len(lines) <= 200 + 3_600 / 10 + 5 * 61


def test_kinds_beyond_the_bound_are_counted_together() -> None:
    of = trail()
    for number in range(10_000):
        of.record(Action.REFUSED, f"kind {number}")
    lines = taken(of, 100.0)
    assert len(lines) <= 200 + 257
    assert sum(line.count for line in lines if line.what == "others") > 9_000


def test_after_a_flood_single_lines_come_again() -> None:
    of = trail()
    for _ in range(1_000):
        of.record(Action.REFUSED, "name")
    lines = taken(of, 0.0)
    lines += taken(of, 70.0, lines)
    lines += taken(of, 1_000.0, lines)
    of.record(Action.ACCEPTED, "name", who="somebody")
    lines += taken(of, 1_200.0, lines)
    of.record(Action.ACCEPTED, "name", who="somebody else")
    (last,) = taken(of, 1_201.0, lines)
    assert (last.who, last.count) == ("somebody else", 1)


@pytest.mark.parametrize("text", [b"", b"{}", b"[]", b'{"seq":1}', b"\xff", b"[" * 5_000])
def test_what_is_no_line_is_our_own_mistake(text: bytes) -> None:
    with pytest.raises(LocalError):
        AuditLine.from_line(text)


def test_a_line_in_another_form_is_refused() -> None:
    of = trail()
    of.record(Action.ACCEPTED, "name")
    (line,) = taken(of, 0.0)
    assert dataclasses.replace(line, seq=2).hash != line.hash
    with pytest.raises(LocalError, match="as the audit log writes it"):
        AuditLine.from_line(line.to_line().replace(b'"seq": 1', b'"seq":  1'))
