"""Real ROS nodes at both ends of the ring: messages cross from one side to the other, and nothing stays behind."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.run_registry import RunRegistry
from lab.process import python_environment, python_path
from netns_tests.lifetimes import LEASE_S
from netns_tests.test_ring import PROJECT, command, crossed, left_of, ring, topics
from proxy.endpoints.ros1.install import rospy_folder
from ring.nodes.content import LAMP, TALKS

pytestmark = pytest.mark.netns

SECONDS = 7  # past three leases
CAMERA_HZ = 5.0  # JSON of 15 images a second needs most of two cores, and another lane of tests has its share of them
CAMERA = ("--camera-hz", CAMERA_HZ)


def needs(mode: str) -> None:
    """Skip where a ROS distribution is missing."""
    if mode != "ros1":
        for package in ("rclpy", "std_msgs", "sensor_msgs", "nav_msgs", "std_srvs"):
            if importlib.util.find_spec(package) is None:
                pytest.skip(f"{package} is not installed: pip install 'gdp-ros[ros2]', or source ROS 2")
    if mode != "ros2":
        try:
            folder = rospy_folder()
        except LocalError as error:
            pytest.skip(str(error))
        if not (Path(folder) / "rosmaster").is_dir():
            pytest.skip("there is no rosmaster here: run sudo scripts/setup_ros1.sh")


def kept(mode: str) -> str:
    """Run a ring that stays up; return its id."""
    ended = ring("--live", mode, "--seconds", SECONDS, "--keep", *CAMERA)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stderr.split("The ring of run ")[1].split(" ")[0]


_SAME = [pytest.param(each, marks=pytest.mark.nightly) for each in ("ros1", "ros2")]


@pytest.mark.parametrize("mode", ["mixed", *_SAME])
def test_what_real_nodes_say_is_heard_at_the_other_end(mode: str, tmp_path: Path) -> None:
    needs(mode)
    result = crossed(tmp_path, "--live", mode, "--seconds", SECONDS, "--lease", LEASE_S, *CAMERA)
    rows = {str(row["topic"]): row for row in topics(result)}
    assert list(rows) == [*(talk.topic for talk in TALKS), LAMP]
    for talk in TALKS:
        row = rows[talk.topic]
        hz = CAMERA_HZ if talk.node == "camera" else talk.hz
        assert row["messages"] == row["delivered"] == round(hz * SECONDS)
        assert (row["kind"], row["identical"], row["hops"]) == ("topic", True, 5)
    lamp = rows[LAMP]
    assert (lamp["kind"], lamp["messages"], lamp["delivered"]) == ("service", 5 * SECONDS, 5 * SECONDS)
    settings = result["settings"]
    assert isinstance(settings, dict)
    assert settings["live"] == mode


@pytest.mark.nightly
def test_with_a_link_cut_in_the_middle_nodes_go_on_by_the_other_way(tmp_path: Path) -> None:
    needs("ros2")
    result = crossed(
        tmp_path,
        "--live",
        *("--seconds", SECONDS, "--lease", LEASE_S, "--cut", "nuc2-nuc3@1.5", "--encoding", "cdr"),
        *CAMERA,
    )
    (chatter,) = (row for row in topics(result) if row["topic"] == "/chatter")
    assert chatter["hops_seen"] == [2, 5]


@pytest.mark.nightly
@pytest.mark.momentary("what is on the wire is looked at, not how long it lasts")
def test_an_eavesdropper_learns_nothing_of_what_nodes_say(tmp_path: Path) -> None:
    needs("ros2")
    crossed(tmp_path, "--live", "--seconds", 3, *CAMERA, "--pcap", tmp_path / "seen.pcap")
    seen = (tmp_path / "seen.pcap").read_bytes()
    assert len(seen) > 10_000_000
    assert [word for word in (b"/chatter", b"hello ", b"/camera", b"switched", b"std_msgs") if word in seen] == []


@pytest.mark.nightly
def test_kept_nodes_continue_and_the_ring_comes_down_on_command() -> None:
    needs("mixed")
    run = kept("mixed")
    try:
        inside = ["ip", "netns", "exec", f"gdp-{run}-nuc1", "rostopic", "echo", "-n", "2", "/chatter"]
        if os.getuid() == 0 and Path(f"/run/netns/gdp-{run}-nuc1").exists() and Path("/usr/bin/rostopic").exists():
            reported = subprocess.run(inside, capture_output=True, text=True, timeout=30, check=True)
            assert reported.stdout.count("hello") == 2
        assert run not in RunRegistry().sweep()
    finally:
        ring("--down")
    assert left_of(run) == []


@pytest.mark.nightly
def test_an_interrupted_live_run_leaves_nothing() -> None:
    needs("ros2")
    argv = command("--live", "--seconds", 60)
    process = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True, cwd=PROJECT)
    run = ""
    with process:
        assert process.stderr is not None
        for line in process.stderr:
            if " run " in line:
                run = line.split(" run ")[1].split(":")[0]
            if "they hear each other" in line:
                break
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    assert run
    assert left_of(run) == []


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--live", "ros3"], "--live is one of ros2, ros1, mixed, not 'ros3'"),
        *(
            pytest.param(words, complaint, marks=pytest.mark.nightly)
            for words, complaint in (
                (["--live", "--rate", "0"], "--live is without a recording"),
                (["--live", "--camera-hz", "0"], "--camera-hz is 0.1 to 120, not 0"),
                (["--camera-hz", "5"], "--camera-hz is for --live"),
                ([__file__, "--live"], "--live is without a recording"),
            )
        ),
    ],
)
def test_wrong_input_is_reported_before_anything_starts(arguments: Sequence[str], complaint: str) -> None:
    ended = ring(*arguments)
    assert ended.returncode == 2
    assert complaint in ended.stderr


def test_where_a_ros_is_missing_one_sentence_says_so(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.util as util\nfind = util.find_spec\n"
        "util.find_spec = lambda name, *more: None if name == 'rclpy' else find(name, *more)\n"
    )
    where = python_environment({"PYTHONPATH": python_path(tmp_path)})
    ended = subprocess.run(command("--live"), capture_output=True, text=True, timeout=60, env=where, check=False)
    assert ended.returncode == 2
    assert "ROS 2 needs rclpy" in " ".join(ended.stderr.split())
    assert "five namespaces" not in ended.stderr
