"""Comparison of two recordings: identical, lost, doubled and changed messages."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import pytest

from proxy.recordings.compare import TopicComparison, compare
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel
from tests.proxy.recordings.samples import READABLE, recording

TYPE = "std_msgs/msg/UInt8"


def message(value: int, rubbish: int = 0) -> bytes:
    """Return a byte and a double, with the recorder's bytes between them."""
    return b"\x00\x01\x00\x00" + bytes([value]) + bytes([rubbish]) * 7 + struct.pack("<d", value)


def record(path: Path, messages: Sequence[bytes]) -> Path:
    about = Channel("/a", TYPE, 2, hash="RIHS01_0", definition="uint8 a\nfloat64 b\n", definition_format="msg")
    with BagWriter(path, 2) as bag:
        handle = bag.add(about)
        for stamp, raw in enumerate(messages):
            bag.write(handle, 1 + stamp, raw)
    return path


def judged(folder: Path, sent: Sequence[bytes], received: Sequence[bytes], *, exact: bool = True) -> TopicComparison:
    (ack,) = compare(record(folder / "a.mcap", sent), record(folder / "b.mcap", received), exact=exact)
    return ack


SENT = [message(value) for value in range(5)]


def test_what_arrived_whole_is_identical_and_in_order(tmp_path: Path) -> None:
    size = sum(map(len, SENT))
    assert judged(tmp_path, SENT, SENT) == TopicComparison(
        topic="/a",
        type_name=TYPE,
        messages=5,
        bytes=size,
        delivered=5,
        lost=0,
        duplicated=0,
        altered=0,
        identical=True,
        in_order=True,
    )


def test_a_lost_message_is_counted(tmp_path: Path) -> None:
    ack = judged(tmp_path, SENT, SENT[:2] + SENT[3:])
    assert (ack.delivered, ack.lost, ack.identical, ack.in_order) == (4, 1, False, True)


def test_a_duplicate_is_counted_and_is_no_disorder(tmp_path: Path) -> None:
    ack = judged(tmp_path, SENT, [*SENT[:3], SENT[0], *SENT[3:], SENT[4]])
    assert (ack.delivered, ack.duplicated, ack.identical, ack.in_order) == (5, 2, True, True)


def test_equal_messages_sent_twice_are_no_duplicates(tmp_path: Path) -> None:
    ack = judged(tmp_path, [SENT[0], SENT[0]], [SENT[0], SENT[0]])
    assert (ack.delivered, ack.duplicated, ack.identical) == (2, 0, True)


def test_another_order_is_seen(tmp_path: Path) -> None:
    ack = judged(tmp_path, SENT, [SENT[1], SENT[0], *SENT[2:]])
    assert (ack.identical, ack.in_order) == (True, False)


def test_an_altered_message_is_neither_delivered_nor_identical(tmp_path: Path) -> None:
    ack = judged(tmp_path, SENT, [*SENT[:4], message(9)])
    assert (ack.delivered, ack.lost, ack.altered, ack.identical) == (4, 1, 1, False)


def test_rubbish_in_padding_counts_only_where_bytes_are_compared(tmp_path: Path) -> None:
    (tmp_path / "exact").mkdir()
    sent = [message(value, rubbish=value) for value in range(5)]
    assert not judged(tmp_path / "exact", sent, SENT, exact=True).identical
    assert judged(tmp_path, sent, SENT, exact=False).identical


def test_a_topic_on_one_side_alone_is_listed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "empty.mcap", 2) as bag:
        bag.add(Channel("/other", TYPE, 2, hash="RIHS01_0", definition="uint8 data\n", definition_format="msg"))
    sent = record(tmp_path / "a.mcap", SENT)
    gone, none = compare(sent, tmp_path / "empty.mcap", exact=False)
    assert (gone.topic, gone.lost, gone.identical) == ("/a", 5, False)
    assert (none.topic, none.messages, none.identical) == ("/other", 0, True)


def test_publishers_of_one_topic_are_in_order_each_by_itself(tmp_path: Path) -> None:
    def bag(name: str, order: str) -> Path:
        with BagWriter(tmp_path / name, 1) as out:
            handles = {
                who: out.add(
                    Channel(
                        "/a",
                        TYPE,
                        1,
                        hash="7c81",
                        definition="uint8 data\n",
                        definition_format="msg",
                        callerid=f"/{who}",
                    )
                )
                for who in "xy"
            }
            counts = dict.fromkeys("xy", 0)
            for stamp, who in enumerate(order):
                out.write(handles[who], 1 + stamp, bytes([counts[who] + (100 if who == "y" else 0)]))
                counts[who] += 1
        return tmp_path / name

    (ack,) = compare(bag("a.bag", "xyxyxy"), bag("b.bag", "xxyyxy"), exact=True)
    assert ack.identical
    assert ack.in_order


@pytest.mark.parametrize("name", READABLE)
def test_a_shared_recording_equals_itself(name: str) -> None:
    verdicts = compare(recording(name), recording(name), exact=True)
    assert all(ack.identical and ack.in_order and not ack.duplicated for ack in verdicts)
