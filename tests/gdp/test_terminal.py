"""Output of programs to a pipe: a node continues while its pipe is not read, and what is missing there is counted."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from typing import TextIO

import pytest

from gdp.terminal import unblocked

LINE = "x" * 999 + "\n"
LINES = 1_000  # of a thousand bytes each: more than a pipe holds, and what waits for it
ALARM_S = 60
NODE = f"""
import logging, signal
from gdp.cli.node import Logs, emit, running
signal.alarm({ALARM_S})
with running(Logs()):
    for number in range({LINES}):
        emit("progress", number=number, text="x" * 999)
        logging.getLogger("gdp").info("step %d %s", number, "x" * 999)
"""


@pytest.fixture
def pipe() -> Iterator[tuple[int, TextIO]]:
    """Descriptor of a pipe's end for reading, and the other end as a stream that does not block."""
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with os.fdopen(writing, "w") as stream:
        yield reading, unblocked(stream)
    os.close(reading)


def read(reading: int) -> str:
    """Return what the pipe holds."""
    found = b""
    try:
        while some := os.read(reading, 1 << 16):
            found += some
    except BlockingIOError:
        pass
    return found.decode()


def test_lines_that_are_not_read_are_dropped_whole_and_counted_before_the_next_one(
    pipe: tuple[int, TextIO], caplog: pytest.LogCaptureFixture
) -> None:
    reading, stream = pipe
    for _ in range(LINES):
        stream.write(LINE)
    assert caplog.messages == []
    found = read(reading)
    stream.write("first\n")
    while not found.endswith("first\n"):
        found += read(reading)
        stream.write("")
    kept = found.count(LINE)
    assert found == LINE * kept + "first\n"
    assert [re.findall(r"\d+$", each) for each in caplog.messages] == [[str(LINES - kept)]]


def test_a_line_longer_than_a_pipe_comes_whole_to_who_reads(pipe: tuple[int, TextIO]) -> None:
    reading, stream = pipe
    line = "y" * 200_000 + "\n"
    found = ""
    stream.write(line)
    while len(found) < len(line):
        found += read(reading)
        stream.write("")
    assert found == line


def test_a_stream_without_a_descriptor_stays_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert unblocked(sys.stdout) is sys.stdout
    del capsys


def test_a_log_that_was_not_read_begins_again_with_how_many_lines_it_lacks(pipe: tuple[int, TextIO]) -> None:
    reading, stream = pipe
    handler, logger = logging.StreamHandler(stream), logging.getLogger("gdp.terminal")
    logger.addHandler(handler)
    try:
        for _ in range(LINES):
            logger.warning(LINE.strip())
        found = read(reading)
        logger.warning("next")
    finally:
        logger.removeHandler(handler)
    while not found.endswith("next\n"):
        found += read(reading)
        stream.write("")
    lines = found.splitlines(keepends=True)
    kept = lines.count(LINE)
    assert lines[:kept] == [LINE] * kept
    assert lines[kept].endswith(f"lines={LINES - kept}\n")
    assert lines[kept + 1 :] == ["next\n"]


def test_a_node_ends_although_neither_its_events_nor_its_log_are_read() -> None:
    with subprocess.Popen([sys.executable, "-c", NODE], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as node:
        assert node.wait(ALARM_S) == 0
        assert node.stdout is not None
        assert node.stderr is not None
        events, log = node.stdout.read().splitlines(), node.stderr.read().splitlines()
    numbers = [json.loads(each)["number"] for each in events[:-1]]  # the pipe ends within a line
    assert numbers == list(range(len(numbers)))
    assert log[0].endswith(b"step 0 " + b"x" * 999)
