"""Whole ring demonstration on real sockets: recordings, links that fail, and an eavesdropper."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from glob import glob
from pathlib import Path
from typing import Final
from unittest import mock

import pytest

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.stores.issue import make_node
from lab.process import calling
from netns_tests.lifetimes import LEASE_S, Lifetime, noted
from proxy.recordings.reader import BagReader
from ring import cli

pytestmark = pytest.mark.netns

PROJECT: Final = Path(__file__).parents[1]
SHARED: Final = PROJECT.parent / "shared" / "data" / "bags"
RECORDINGS: Final = (
    "tilt_laser.bag",
    pytest.param("rosbag2_test", marks=pytest.mark.nightly),
    pytest.param("ros_numpy_test.bag", marks=pytest.mark.nightly),
    pytest.param("event_camera.bag", marks=pytest.mark.nightly),
    pytest.param("ninety_four_types.mcap", marks=pytest.mark.nightly),
    pytest.param("turtlesim.bag", marks=pytest.mark.nightly),
    pytest.param("aruco_compressed.bag", marks=pytest.mark.nightly),
)
PATIENCE_S: Final = 240
LASTING: Final = ("--seconds", 7, "--lease", LEASE_S)  # past three leases
FAST: Final = "sent as fast as it goes: what is compared is the content"


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "ring", *map(str, arguments)]


def ring(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=PATIENCE_S, cwd=PROJECT, check=False
    )


def topics(result: dict[str, object]) -> list[dict[str, object]]:
    rows = result["topics"]
    assert isinstance(rows, list)
    return rows


def crossed(folder: Path, *arguments: object) -> dict[str, object]:
    """Run the ring, and return its JSON after it passed."""
    ended = ring(*arguments, "--json", folder / "result.json")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    result: dict[str, object] = json.loads((folder / "result.json").read_text())
    assert result["passed"] is True
    settings = result["settings"]
    assert isinstance(settings, dict)
    noted.append(Lifetime("the ring", float(settings["lease_s"]), float(str(result["traffic_s"]))))
    return result


def make_demo(folder: Path, seconds: float, *more: str) -> Path:
    path = folder / ("demo.bag" if "--ros1" in more else "demo.mcap")
    script = PROJECT / "scripts" / "make_demo_bag.py"
    argv = [sys.executable, str(script), "--seconds", str(seconds), "-o", str(path), *more]
    subprocess.run(argv, check=True, cwd=PROJECT)
    return path


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_demo(tmp_path_factory.mktemp("demo"), 1)


@pytest.fixture(scope="module")
def longer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_demo(tmp_path_factory.mktemp("longer"), 5)


def test_a_recording_crosses_at_an_even_pace_and_an_eavesdropper_learns_no_topic_no_type_and_no_content(
    demo: Path, tmp_path: Path
) -> None:
    result = crossed(tmp_path, demo, *LASTING, "--out", tmp_path / "out", "--pcap", tmp_path / "seen.pcap")
    with BagReader(demo) as sent:
        assert {row["topic"] for row in topics(result)} == {channel.topic for channel in sent.channels}
        assert sum(int(str(row["messages"])) for row in topics(result)) == sent.count
    assert {row["hops"] for row in topics(result)} == {5}  # three switches in between
    with BagReader(tmp_path / "out" / "recording.mcap") as received:
        assert received.count == sum(int(str(row["messages"])) for row in topics(result))
    assert learned(tmp_path / "seen.pcap", demo) == []


def learned(pcap: Path, recording: Path) -> list[bytes]:
    """Return the names and pieces of messages of a recording that an eavesdropper in the middle has seen."""
    seen = pcap.read_bytes()
    with BagReader(recording) as sent:
        names = {text.encode() for channel in sent.channels for text in (channel.topic, channel.type_name)}
        longest: dict[int, bytes] = {}
        for message in sent.messages():
            longest[message.channel] = max(longest.get(message.channel, b""), message.raw, key=len)
    secrets = {name for name in names if len(name) > 5}  # shorter ones occur by chance in megabytes of noise
    words = {b"base_link", b"frame_id", b"position", b"ranges", b"geometry_msgs", b"MSG: "}
    samples = {raw[at : at + 24] for raw in longest.values() for at in (40, len(raw) // 2) if len(set(raw[at:])) > 8}
    assert len(seen) > sum(map(len, longest.values()))
    return [secret for secret in secrets | words | samples if secret in seen]


@pytest.mark.nightly
@pytest.mark.momentary(FAST)
@pytest.mark.parametrize("encoding", ["cbor", "cdr"])
def test_every_encoding_crosses(demo: Path, tmp_path: Path, encoding: str) -> None:
    result = crossed(tmp_path, demo, "--rate", 0, "--encoding", encoding)
    settings = result["settings"]
    assert isinstance(settings, dict)
    assert settings["encoding"] == encoding


@pytest.mark.nightly
@pytest.mark.momentary(FAST)
def test_a_ros_1_recording_comes_out_as_a_ros_1_bag(tmp_path: Path) -> None:
    crossed(tmp_path, make_demo(tmp_path, 0.3, "--ros1"), "--rate", 0, "--out", tmp_path)
    with BagReader(tmp_path / "recording.bag") as received:
        assert {channel.ros for channel in received.channels} == {1}


@pytest.mark.nightly
@pytest.mark.momentary(FAST)
def test_larger_frames_carry_an_image_in_fewer_parts(demo: Path, tmp_path: Path) -> None:
    small, large = (crossed(tmp_path, demo, "--rate", 0, "--mtu", mtu) for mtu in (1_500, 9_000))
    parts = [max(int(str(row["parts"])) for row in topics(result)) for result in (small, large)]
    assert parts[0] > 5 * parts[1]


@pytest.mark.nightly
@pytest.mark.momentary("this plane forwards like the others, a hundred times slower; leases are no matter of a plane")
def test_the_scapy_plane_carries_the_same(tmp_path: Path) -> None:
    crossed(tmp_path, make_demo(tmp_path, 0.1, "--without-images"), "--data-plane", "scapy")


@pytest.mark.nightly
def test_with_a_link_cut_in_the_middle_all_still_arrives_by_the_other_way(longer: Path, tmp_path: Path) -> None:
    result = crossed(tmp_path, longer, *LASTING, "--cut", "nuc2-nuc3@2")
    (imu,) = (row for row in topics(result) if row["topic"] == "/imu")
    assert imu["hops_seen"] in ([5, 2], [2, 5])


def test_what_fails_and_moves_one_after_the_other_costs_no_message(tmp_path: Path) -> None:
    faults = ["--cut", "nuc1-nuc2@1-4", "--kill", "rib:school@2", "--roam", "robot:nuc2@5", "--kill", "switch:nuc1@6"]
    words = ["--seconds", 10, "--lease", LEASE_S, *faults, "--out", tmp_path]
    result = crossed(tmp_path, make_demo(tmp_path, 1, "--ros1"), *words)
    (imu,) = (row for row in topics(result) if row["topic"] == "/imu")
    assert {2, 5} <= set(imu["hops_seen"])  # type: ignore[call-overload]  # over the cut link, and by the other way
    with BagReader(tmp_path / "recording.bag") as received:
        assert {channel.ros for channel in received.channels} == {1}


def run_ordered(least: str, *arguments: str) -> None:
    """Run the ring whose RIB of one domain has the least name: it begins with a small byte; a process of its own."""

    def make(directory: Path, role: Role, label: str, domain: Path) -> Identity:
        identity = make_node(directory, role, label, domain)
        while role is Role.RIB and (identity.name[0] < 0x40) != (domain.name == least):
            identity = make_node(directory, role, label, domain, force=True)
        return identity

    sys.argv = ["ring", *arguments]
    with mock.patch("lab.credentials.make_node", make):
        cli.main()


@pytest.mark.nightly
@pytest.mark.parametrize("least", ["backbone", "school", "cloud"])
def test_every_rib_dies_one_after_the_other_and_no_message_is_lost_whichever_has_the_least_name(
    least: str, demo: Path, tmp_path: Path
) -> None:
    kills = ["--kill", "rib:backbone@0.5", "--kill", "rib:school@12", "--kill", "rib:cloud@12"]
    arguments = [demo, "--seconds", 18.5, "--lease", LEASE_S, *kills, "--json", tmp_path / "result.json"]
    argv = calling(run_ordered, least, *arguments)
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=PATIENCE_S, cwd=PROJECT, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    noted.append(Lifetime("the ring without RIBs", LEASE_S, 18.5 - 12))


@pytest.mark.momentary(FAST)
@pytest.mark.parametrize("recording", RECORDINGS)
def test_a_recording_of_a_real_robot_crosses(recording: str, tmp_path: Path) -> None:
    if not (SHARED / recording).exists():
        pytest.skip(f"{SHARED} is not there")
    crossed(tmp_path, SHARED / recording, "--rate", 0)


@pytest.mark.momentary(FAST)
@pytest.mark.parametrize(
    "recording", ["ninety_four_types.mcap", pytest.param("tilt_laser.bag", marks=pytest.mark.nightly)]
)
def test_with_cdr_the_very_bytes_cross(recording: str, tmp_path: Path) -> None:
    if not (SHARED / recording).exists():
        pytest.skip(f"{SHARED} is not there")
    crossed(tmp_path, SHARED / recording, "--rate", 0, "--encoding", "cdr")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([__file__], "cannot be read: neither a ROS 1 bag nor MCAP nor sqlite3"),
        (["--encoding", "xml"], "--encoding is one of json, cbor, cdr, not 'xml'"),
        *(
            pytest.param(words, complaint, marks=pytest.mark.nightly)
            for words, complaint in (
                (["/nowhere/my.bag"], "no such recording: /nowhere/my.bag"),
                (["--cut", "nuc1-nuc3@1"], "no link nuc1-nuc3"),
                (["--kill", "switch:nuc1@1"], "with switch nuc1 dead, robot has no switch"),
                (["--roam", "cat:nuc2@1"], "no proxy cat"),
                (["--mtu", "100"], "an MTU is 576 to 65521 bytes"),
            )
        ),
    ],
)
def test_wrong_input_is_reported_before_anything_starts(arguments: Sequence[str], complaint: str) -> None:
    ended = ring(*arguments)
    assert ended.returncode == 2
    assert complaint in ended.stderr


def left_of(run: str) -> list[str]:
    """Return the remains of a run: records, namespaces, files, processes."""
    places = ("/run/gdp", "/run/netns", tempfile.gettempdir())
    return [*(path for place in places for path in glob(f"{place}/*{run}*")), *commands_with(run)]


def commands_with(word: str) -> list[str]:
    """Return the command lines of the running processes that have a word; a process may end meanwhile."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            found.append(path.read_bytes().decode(errors="replace").replace("\0", " "))
    return [each for each in found if word in each]
