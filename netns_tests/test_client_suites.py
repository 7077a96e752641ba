"""Test suites of public clients against the rosbridge door, in a namespace where it listens at 127.0.0.1:9090.

The suite of roslibpy comes with its source distribution, in the version of ``requirements/dev.lock``. Its other files
reach no server. npm's package of roslib has no tests: ``roslib/client.mjs`` does what its examples do.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Final, TypeAlias

import pytest

from gdp.trust.right import Right
from netns_tests.datacenter.debian_root import cache_folder
from netns_tests.session_lab import SessionLab, lines_of, session_lab
from tests.pages import ROOT
from tests.proxy.doors.fibonacci import FIBONACCI

if shutil.which("nsenter") is None or shutil.which("setpriv") is None:
    pytest.skip("nsenter or setpriv is not installed (util-linux)", allow_module_level=True)
pytest.importorskip("websockets")
pytest.importorskip("roslibpy")

pytestmark = pytest.mark.netns

TYPES: Final = {
    "/chatter": "std_msgs/msg/String",
    "/points": "geometry_msgs/msg/PointStamped",
    "/image": "sensor_msgs/msg/CompressedImage",
    "/rosout": "rcl_interfaces/msg/Log",
    "/fibonacci": FIBONACCI,
    "/switch": "std_srvs/srv/SetBool",
}
BOTH: Final = [Right.READ, Right.PUBLISH]
RIGHTS: Final = {
    "robot": {"/fibonacci": [Right.SERVE], "/switch": [Right.SERVE]},
    "viewer": {
        **dict.fromkeys(("/chatter", "/points", "/image"), BOTH),
        "/rosout": [Right.READ],
        "/fibonacci": [Right.CALL],
        "/switch": [Right.CALL],
    },
}
SERVES: Final = "a client of a door serves nothing to others: no delegation names who answers"
PARAMETERS: Final = "no master and no rosapi node has parameters: a client calls the services of the node that has them"
WITHOUT_TYPE: Final = "actionlib's messages are no standard types of ROS 2, and no far node describes them"
REPUBLISHER: Final = "it needs the node tf2_web_republisher, which serves clients of the same ROS 1 graph"
NODES: Final = "the overlay has members, not nodes, and shows a client none"
# of each test the reason for which it cannot pass; empty: it passes
ROSLIBPY: Final[Mapping[str, str]] = {
    "ros1/test_actionlib.py::test_action_success": WITHOUT_TYPE,
    "ros1/test_actionlib.py::test_action_preemt": WITHOUT_TYPE,
    "ros1/test_param.py::test_param_manipulation": PARAMETERS,
    "ros1/test_ros.py::test_reconnect_does_not_trigger_on_client_close": "",
    "ros1/test_ros.py::test_connection": "",
    "ros1/test_ros.py::test_url_connection": "",
    "ros1/test_ros.py::test_closing_event": "",
    "ros1/test_ros.py::test_multithreaded_connect_disconnect": "",
    "ros1/test_rosapi.py::test_rosapi_topics": "",
    "ros1/test_rosapi.py::test_rosapi_topics_blocking": "",
    "ros1/test_rosapi.py::test_connection_fails_when_missing_port": "",
    "ros1/test_rosapi.py::test_connection_fails_when_schema_not_ws": "",
    "ros1/test_service.py::test_add_two_ints_service": SERVES,
    "ros1/test_service.py::test_empty_service": SERVES,
    "ros1/test_tf.py::test_tf_test": REPUBLISHER,
    "ros1/test_topic.py::test_topic_pubsub": "",
    "ros1/test_topic.py::test_topic_with_header": "",
    "ros2/test_actions.py::test_fibonacci": "",
    "ros2/test_actions.py::test_cancel": "",
    "ros2/test_ros.py::test_reconnect_does_not_trigger_on_client_close": "",
    "ros2/test_ros.py::test_connection": "",
    "ros2/test_ros.py::test_url_connection": "",
    "ros2/test_ros.py::test_closing_event": "",
    "ros2/test_ros.py::test_multithreaded_connect_disconnect": "",
    "ros2/test_rosapi.py::test_rosapi_topics": "",
    "ros2/test_rosapi.py::test_rosapi_topics_blocking": "",
    "ros2/test_rosapi.py::test_connection_fails_when_missing_port": "",
    "ros2/test_rosapi.py::test_connection_fails_when_schema_not_ws": "",
    "ros2/test_topic.py::test_topic_pubsub": "",
    "ros2/test_topic.py::test_topic_with_header": "",
}
ROSLIB: Final[Mapping[str, str]] = {
    "topics_are_listed": "",
    "topics_are_listed_with_their_definitions": "",
    "the_type_of_a_topic_is_known": "",
    "a_topic_hears_another_of_the_same_client": "",
    "a_topic_hears_another_client": "",
    "a_relative_name_is_the_same_topic": "",
    "an_unsubscribed_topic_hears_nothing": "",
    "a_message_may_come_as_png": "",
    "a_message_may_come_as_cbor": "",
    "a_message_may_come_as_ros_wrote_it": "",
    "action_servers_are_listed": "",
    "a_goal_has_feedback_and_a_result": "",
    "a_goal_is_cancelled": "",
    "a_service_is_called": "",
    "a_client_serves_another": SERVES,
    "a_parameter_is_had_as_it_was_set": PARAMETERS,
    "nodes_are_listed": NODES,
}
URL: Final = "ws://127.0.0.1:9090"
Run: TypeAlias = "tuple[Mapping[str, str], str]"  # the outcome of each test, and all output
# until the far servers are known to the door
WAIT: Final = """
import json, sys
from websockets.sync.client import connect
with connect(sys.argv[1]) as door:
    names = []
    while not {"/switch", "/fibonacci/_action/get_result"} <= set(names):
        door.send(json.dumps({"op": "call_service", "service": "/rosapi/services"}))
        names = json.loads(door.recv())["values"]["services"]
"""
SUITE_S: Final = 75.0
_RESULT: Final = re.compile(r"^tests/(\S+?)(?:\[\w+\])? (PASSED|FAILED|ERROR|SKIPPED)", re.MULTILINE)


@pytest.fixture(scope="session")
def suite() -> Path:
    """Return roslibpy's sources, which are kept between runs."""
    lock = (ROOT / "requirements" / "dev.lock").read_text()
    pinned = re.search(r"^roslibpy==(\S+)(?: \\\n +--hash=\S+)+", lock, re.MULTILINE)
    assert pinned is not None
    folder = cache_folder() / f"roslibpy-{pinned[1]}"
    if not folder.is_dir():
        fresh = cache_folder() / f"new-{os.getpid()}"
        fresh.mkdir()
        (fresh / "roslibpy.lock").write_text(pinned[0] + "\n")
        words = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary=:all:"]
        words += ["--require-hashes", "--dest", str(fresh), "-r", str(fresh / "roslibpy.lock")]
        got = subprocess.run(words, capture_output=True, text=True, check=False)
        if got.returncode:
            shutil.rmtree(fresh)
            pytest.skip(f"roslibpy's sources cannot be had: {got.stderr.strip().splitlines()[-1:]}")
        with tarfile.open(fresh / f"roslibpy-{pinned[1]}.tar.gz") as archive:
            archive.extractall(fresh, filter="data")
        (fresh / folder.name).rename(folder)
        shutil.rmtree(fresh)
    return folder


@pytest.fixture(scope="session")
def roslib() -> Path:
    """Return a folder with roslib and its dependencies, as ``roslib/package-lock.json`` states them; it is kept."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("node or npm is not installed")
    source = ROOT / "netns_tests" / "roslib"
    digest = sha256((source / "package-lock.json").read_bytes()).hexdigest()[:12]
    folder = cache_folder() / f"roslib-{digest}"
    if not folder.is_dir():
        fresh = cache_folder() / f"new-{os.getpid()}"
        shutil.copytree(source, fresh)
        got = subprocess.run(
            [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"],
            cwd=fresh,
            capture_output=True,
            text=True,
            check=False,
        )
        if got.returncode:
            shutil.rmtree(fresh)
            pytest.skip(f"roslib cannot be had: {got.stderr.strip().splitlines()[:1]}")
        fresh.rename(folder)
    shutil.copy2(source / "client.mjs", folder)
    return folder


@pytest.fixture(scope="module")
def lab() -> Iterator[SessionLab]:
    """Run a node with servers, and a door that needs no token: the suites' addresses have none."""
    with session_lab(RIGHTS, TYPES) as lab:
        robot = lab.start("-m", "netns_tests.action_child", "robot")
        assert lines_of(robot, 1) == ['{"event": "ready"}']
        door = lab.start("-m", "gdp.cli.gdp", "rosbridge", "viewer", "--json", "--no-token")
        assert json.loads(lines_of(door, 1)[0])["url"] == URL
        lab.output(lab.start("-c", WAIT, URL))
        yield lab


@pytest.fixture(scope="module", params=["twisted", pytest.param("asyncio", marks=pytest.mark.nightly)])
def roslibpy_run(request: pytest.FixtureRequest, suite: Path, lab: SessionLab) -> Run:
    """Return the outcomes of roslibpy's tests over one of its transports."""
    files = sorted({f"tests/{name.partition('::')[0]}" for name in ROSLIBPY})
    words = ["env", f"--chdir={suite}", f"ROSLIBPY_TRANSPORT={request.param}", sys.executable, "-m", "pytest"]
    output = _output(lab, [*words, "-p", "no:cacheprovider", "-o", "addopts=", "-v", "--tb=short", *files])
    return dict(_RESULT.findall(output)), output


@pytest.fixture(scope="module")
def roslib_run(roslib: Path, lab: SessionLab) -> Run:
    """Return the outcomes of what the examples of roslib promise."""
    output = _output(lab, ["node", str(roslib / "client.mjs"), URL])
    return {name: outcome for outcome, name in re.findall(r"^(PASSED|FAILED) (\S+)", output, re.MULTILINE)}, output


def _output(lab: SessionLab, command: Sequence[str]) -> str:
    tests = lab.start_command(command)
    try:
        out, errors = tests.communicate(timeout=SUITE_S)
    except subprocess.TimeoutExpired:
        tests.kill()
        out, errors = tests.communicate()
    return out + errors


def _rows(suite: Mapping[str, str]) -> list[object]:
    return [
        pytest.param(name, marks=[pytest.mark.xfail(reason=reason, strict=True)] if reason else [])
        for name, reason in suite.items()
    ]


@pytest.mark.parametrize("name", _rows(ROSLIBPY))
def test_roslibpy(roslibpy_run: Run, name: str) -> None:
    outcomes, output = roslibpy_run
    assert outcomes.get(name, "did not end") == "PASSED", output[-20_000:]


def test_every_test_of_roslibpy_that_connects_is_listed(roslibpy_run: Run) -> None:
    assert set(roslibpy_run[0]) == set(ROSLIBPY), roslibpy_run[1][-20_000:]


@pytest.mark.parametrize("name", _rows(ROSLIB))
def test_roslib(roslib_run: Run, name: str) -> None:
    outcomes, output = roslib_run
    assert outcomes.get(name, "did not end") == "PASSED", output


def test_every_promise_of_roslib_is_listed(roslib_run: Run) -> None:
    assert set(roslib_run[0]) == set(ROSLIB), roslib_run[1]
