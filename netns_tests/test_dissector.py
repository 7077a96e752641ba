"""Frames of a ring on real sockets, as Wireshark shows them."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("gdp_extensions.dissector")

from scapy.utils import RawPcapReader

from gdp.frame.codec import ETHERTYPE, Kind
from gdp.host.run_registry import RunRegistry
from gdp_extensions.dissector.capture_opener import Outcome
from netns_tests.test_ring import FAST, crossed, make_demo
from proxy.recordings.reader import BagReader
from tests.gdp_extensions.dissector.tshark import assert_same, needs_tshark, shown_by_tshark, tshark

pytestmark = pytest.mark.netns


@pytest.mark.nightly
@needs_tshark
@pytest.mark.momentary(FAST)
def test_wireshark_shows_of_each_captured_frame_what_scapy_shows_and_each_message_to_the_reader(tmp_path: Path) -> None:
    bag, seen, plain = make_demo(tmp_path, 0.3), tmp_path / "seen.pcap", tmp_path / "plain.pcapng"
    records = RunRegistry()
    before = {each.run for each in records.all()}
    crossed(tmp_path, bag, "--rate", 0, "--pcap", seen, "--keep")
    (run,) = (records.resume(each.run) for each in records.all() if each.run not in before and each.kept)
    reader = shutil.copytree(run.directory / "nodes" / "proxy-nuc5", tmp_path / "reader")
    run.end()
    argv = [sys.executable, "-m", "gdp.cli.gdp", "decrypt-pcap", seen, "--node", reader, "-o", plain, "--json"]
    ended = subprocess.run([*map(str, argv)], capture_output=True, text=True, check=True, timeout=60)
    with RawPcapReader(str(seen)) as capture:
        frames = [data for data, _ in capture if data[12:14] == ETHERTYPE.to_bytes(2, "big")]
    kinds = {Kind(frame[15]) for frame in frames}
    assert {Kind.DATA, Kind.HEARTBEAT, Kind.ACKNACK, Kind.INTRODUCTION, Kind.KEEPALIVE, Kind.HELLO} <= kinds
    shown = shown_by_tshark(seen, tmp_path)
    assert_same(frames, shown)
    assert [fields for fields in shown if "gdp.malformed.reason" in fields] == []
    rows = json.loads(ended.stdout)["names"]
    assert sum(row["frames"] for row in rows) == len(frames)
    assert {reason for row in rows for reason in row["not_opened"]} == {Outcome.ACK_NACK.value}
    fields = ("-Y", "gdp_opened.rosbody.body", "-T", "fields", "-e", "gdp_opened.topic", "-e", "gdp_opened.sequence")
    opened = {tuple(line.split()) for line in tshark(plain, *fields, folder=tmp_path).splitlines()}
    with BagReader(bag) as sent:
        assert len(opened) == sent.count
        assert len({topic for topic, _ in opened}) == len({channel.topic for channel in sent.channels})
