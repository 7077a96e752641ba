"""Writer of recordings: what was flushed can be read, whatever happens to the process, the machine or the disk."""

from __future__ import annotations

import contextlib
import io
import os
import resource
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import mcap.exceptions
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner

from gdp.errors import LocalError
from proxy.cli.recording import app
from proxy.recordings.split import SplitWriter
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import RosVersion
from tests.draws import draws
from tests.proxy.recordings.test_reader import LATCHED, PLAIN, START_NS, raw, read, string

FILES = [(1, "a.bag"), (2, "a.mcap")]


def texts(path: Path) -> list[bytes]:
    return [message.raw for message in read(path)[0]]


@pytest.fixture(autouse=True)
def _space(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the disk space, whatever this machine has."""
    monkeypatch.setattr(os, "fstatvfs", lambda _: SimpleNamespace(f_bavail=1 << 40, f_frsize=1))


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size: writing fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_the_mcap_library_and_rosbags_read_the_file_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    channels = [
        string(2, qos=(LATCHED,), latched=True),
        string(2, "/b", qos=(PLAIN, LATCHED)),
        string(2, "/c", hash=""),
    ]
    with BagWriter(path, 2) as bag:
        handles = [bag.add(channel) for channel in channels]
        for number in range(60):
            bag.write(handles[number % 2], START_NS + number, raw(2, b"%d" % number * 20_000))
    with path.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 60
        assert summary.statistics.message_start_time == START_NS
        assert summary.statistics.message_end_time == START_NS + 59
        assert {each.topic for each in summary.channels.values()} == {"/chatter", "/b", "/c"}
        assert len(summary.chunk_indexes) > 1
        found = [(channel.topic, message.log_time) for _, channel, message in reader.iter_messages(topics=["/b"])]
        assert found == [("/b", START_NS + number) for number in range(1, 60, 2)]
        (about,) = [each.metadata for each in summary.channels.values() if each.topic == "/chatter"]
        assert about["topic_type_hash"] == channels[0].hash
    with AnyReader([path]) as bag2:
        assert [raw_ for _, _, raw_ in bag2.messages()] == [raw(2, b"%d" % number * 20_000) for number in range(60)]
        offered = {each.topic: each.ext.offered_qos_profiles for each in bag2.connections}  # type: ignore[union-attr]
        assert len(offered["/b"]) == 2


@pytest.mark.parametrize(("ros", "name"), FILES)
def test_what_was_flushed_is_read_after_a_kill(ros: RosVersion, name: str, tmp_path: Path) -> None:
    program = textwrap.dedent(f"""
        import os, signal, sys
        from pathlib import Path
        from proxy.recordings.writer import BagWriter
        from tests.proxy.recordings.test_reader import START_NS, raw, string
        bag = BagWriter(Path({str(tmp_path / name)!r}), {ros})
        handle = bag.add(string({ros}))
        for number in range(30):
            bag.write(handle, START_NS + number, raw({ros}, b"%d" % number))
            if number == 19:
                bag.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    """)
    done = subprocess.run([sys.executable, "-c", program], check=False, cwd=Path(__file__).parents[3])
    assert done.returncode == -signal.SIGKILL
    partial = tmp_path / f"{name}.partial"
    assert texts(partial) == [raw(ros, b"%d" % number) for number in range(20)]
    said = CliRunner().invoke(app, ["finish", str(partial)])
    assert said.exit_code == 0, said.output
    assert f"20 messages are in {tmp_path / name}" in said.output
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with AnyReader([tmp_path / name]) as whole:
        assert whole.message_count == 20
    assert read(tmp_path / name)[1] == ""


@draws(8)
@given(sizes=st.lists(st.tuples(st.integers(0, 5_000), st.booleans()), min_size=1, max_size=30), cut=st.floats(0, 1))
@pytest.mark.parametrize(("ros", "name"), FILES)
def test_a_file_that_is_cut_anywhere_gives_all_complete_chunks(
    ros: RosVersion, name: str, tmp_path_factory: pytest.TempPathFactory, sizes: list[tuple[int, bool]], cut: float
) -> None:
    path = tmp_path_factory.mktemp("cut") / name
    ends = [(0, 0)]  # of the file after each flush, and the messages before it
    bag = BagWriter(path, ros)
    handle = bag.add(string(ros))
    sent = [raw(ros, b"x" * size) for size, _ in sizes]
    for number, (_, flushes) in enumerate(sizes):
        bag.write(handle, START_NS + number, sent[number])
        if flushes:
            bag.flush()
            ends.append((bag.partial.stat().st_size, bag.written))
    bag.close()
    whole = path.read_bytes()
    end = round(cut * len(whole))
    path.write_bytes(whole[:end])
    held = max(count for size, count in ends if size <= end)
    if held:
        assert texts(path)[:held] == sent[:held]


@pytest.mark.parametrize(("ros", "name"), FILES)
def test_a_disk_that_fills_ends_the_recording_while_there_is_space_for_its_index(
    ros: RosVersion, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = BagWriter(tmp_path / name, ros)
    handle = bag.add(string(ros))

    def free(_: int) -> SimpleNamespace:
        return SimpleNamespace(f_bavail=(3 << 20) - bag.partial.stat().st_size, f_frsize=1)

    monkeypatch.setattr(os, "fstatvfs", free)
    taken = 0
    with file_limit(3 << 20):
        while not bag.failure and taken < 100:
            with contextlib.suppress(LocalError):
                bag.write(handle, START_NS + taken, raw(ros, b"x" * 100_000))
                taken += 1
        bag.close()
    assert bag.failure.startswith("no space is left on the disk of ")
    with pytest.raises(LocalError, match="closed"):
        bag.write(handle, START_NS, raw(ros, b""))
    assert bag.written == taken >= 20
    assert len(texts(tmp_path / name)) == taken
    with AnyReader([tmp_path / name]) as whole:
        assert whole.message_count == taken


@pytest.mark.parametrize(("ros", "name"), FILES)
def test_a_write_that_fails_costs_the_last_chunk_only(ros: RosVersion, name: str, tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / name, ros)
    handle = bag.add(string(ros))
    with file_limit(2 << 20):
        number = 0
        while not bag.failure and number < 60:
            with contextlib.suppress(LocalError):
                bag.write(handle, START_NS + number, raw(ros, b"%d" % number * 50_000))
                bag.flush()
                number += 1
        assert bag.failure == f"{bag.path} cannot be written: File too large"
        said = ""
        try:
            bag.close()
        except LocalError as error:
            said = str(error)
    kept = bag.written
    assert 10 <= kept < 60
    if said:  # a bag of ROS 1: its library cannot take the torn chunk back
        assert said.endswith(f"{kept} messages are in {bag.partial}: gdp recording finish {bag.partial}")
    assert len(texts(bag.partial if said else bag.path)) >= kept


def test_the_parts_of_a_split_recording_hold_each_message_once(tmp_path: Path) -> None:
    bag = SplitWriter(tmp_path / "a.mcap", 2, max_bytes=1_000)
    handles = [bag.add(string(2)), bag.add(string(2, "/b"))]
    sent = [raw(2, b"%d" % number * 30) for number in range(100)]
    for number, each in enumerate(sent):
        bag.write(handles[number % 7 == 0], START_NS + number, each)
    bag.close()
    assert (bag.received, bag.written, bag.failure) == (100, 100, "")
    assert [path.name for path in bag.paths] == [f"a_{number}.mcap" for number in range(len(bag.paths))]
    assert len(bag.paths) > 3
    assert [message for path in bag.paths for message in texts(path)] == sent
    with pytest.raises(LocalError, match=r"a_0\.mcap exists already"):
        SplitWriter(tmp_path / "a.mcap", 2, max_bytes=1_000)


def test_a_part_that_cannot_be_made_ends_the_recording(tmp_path: Path) -> None:
    (tmp_path / "a_1.mcap").touch()
    bag = SplitWriter(tmp_path / "a.mcap", 2, max_bytes=100)
    handle = bag.add(string(2))
    bag.write(handle, START_NS, raw(2, b"x" * 80))
    with pytest.raises(LocalError, match="exists already"):
        bag.write(handle, START_NS, raw(2, b"x" * 80))
    assert bag.failure.endswith("a_1.mcap exists already")
    bag.close()
    assert (bag.received, bag.written) == (2, 1)


def test_a_new_run_records_and_keeps_what_a_killed_one_left(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for run in range(3):
        bag = BagWriter(tmp_path / "a.mcap", 2)
        bag.write(bag.add(string(2)), START_NS, raw(2, b"%d" % run))
        bag.flush()
        if run < 2:
            bag._syncs.shutdown()
            bag._format.file.close()  # as the kernel does when a process is killed
    with pytest.raises(LocalError, match="is being written by another process"):
        BagWriter(tmp_path / "a.mcap", 2)
    bag.close()
    left = [tmp_path / f"a-killed{number}.mcap.partial" for number in (1, 2)]
    assert [texts(path) for path in (*left, bag.path)] == [[raw(2, b"%d" % run)] for run in range(3)]
    assert f"gdp recording finish {left[1]}" in caplog.text
    assert CliRunner().invoke(app, ["finish", str(left[0])]).exit_code == 0
    assert texts(tmp_path / "a-killed1.mcap") == [raw(2, b"0")]


def test_a_recording_that_is_being_written_is_not_finished_by_another(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", 2) as bag:
        said = CliRunner().invoke(app, ["finish", str(bag.partial)])
        assert said.exit_code == 2
        assert "is being written at present" in said.output
    assert bag.path.exists()


def test_a_damaged_recording_of_others_is_finished_next_to_it(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", 2) as bag:
        handle = bag.add(string(2))
        for number in range(10):
            bag.write(handle, START_NS + number, raw(2, b"%d" % number))
            bag.flush()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.path.read_bytes()[:1_000])
    with pytest.raises(mcap.exceptions.McapError):
        SeekingReader(io.BytesIO(cut.read_bytes())).get_summary()
    assert CliRunner().invoke(app, ["finish", str(cut)]).exit_code == 2
    said = CliRunner().invoke(app, ["finish", str(cut), "-o", str(tmp_path / "whole.mcap"), "--json"])
    assert said.exit_code == 0
    assert '"unread":"the file ends in the middle' in said.output
    assert cut.exists()
    with AnyReader([tmp_path / "whole.mcap"]) as whole:
        assert whole.message_count == len(texts(cut)) > 0


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"compression": CompressionType.ZSTD}])
def test_a_finished_recording_keeps_the_publishers_time_and_number_of_each_message(
    tmp_path: Path, options: dict[str, object]
) -> None:
    sent = [(START_NS, START_NS - 5, 7, 10), (START_NS, 1, 2**32 - 1, 200_000), (START_NS + 1, 2**64 - 1, 0, 10)]
    with (tmp_path / "a.mcap.partial").open("wb") as file:
        made = Writer(file, **options)  # type: ignore[arg-type]
        made.start("ros2")
        schema = made.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = made.register_channel("/a", "cdr", schema)
        for log_ns, published_ns, sequence, size in sent:
            made.add_message(channel, log_ns, raw(2, b"x" * size), published_ns, sequence)
        made.finish()  # type: ignore[no-untyped-call]
    assert CliRunner().invoke(app, ["finish", str(tmp_path / "a.mcap.partial")]).exit_code == 0
    with (tmp_path / "a.mcap").open("rb") as file:
        found = [
            (each.log_time, each.publish_time, each.sequence, each.data)
            for _, _, each in SeekingReader(file).iter_messages()
        ]
    assert found == [(*head, raw(2, b"x" * size)) for *head, size in sent]
