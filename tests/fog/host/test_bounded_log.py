"""Logs with a bounded size."""

from __future__ import annotations

from pathlib import Path

from fog.host.bounded_log import BoundedLog, last_lines


def test_a_log_never_takes_more_than_its_two_halves(tmp_path: Path) -> None:
    log = BoundedLog(tmp_path / "a.log", half_bytes=100)
    for number in range(100):
        log.write(b"line %d\n" % number)
    log.close()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 200


def test_the_last_lines_reach_into_the_older_half(tmp_path: Path) -> None:
    log = BoundedLog(tmp_path / "a.log", half_bytes=16)
    for number in range(4):
        log.write(b"line %d\n" % number)
    log.close()
    assert last_lines(tmp_path / "a.log", 3) == "line 1\nline 2\nline 3\n"


def test_where_there_is_no_log_there_are_no_lines(tmp_path: Path) -> None:
    assert last_lines(tmp_path / "a.log", 3) == ""
