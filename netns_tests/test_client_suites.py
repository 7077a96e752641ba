"""Test suites of public clients against the rosbridge door, in a namespace where it listens at 127.0.0.1:9090.

The suite of roslibpy comes with its source distribution, in the version of ``requirements/dev.lock``. Its other files
reach no server. npm's package of roslib has no tests.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import pytest

from gdp.trust.right import Right
from netns_tests.datacenter.debian_root import cache_folder
from netns_tests.session_lab import lines_of, session_lab
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
    "/rosout": "rcl_interfaces/msg/Log",
    "/fibonacci": FIBONACCI,
}
BOTH: Final = [Right.READ, Right.PUBLISH]
RIGHTS: Final = {
    "robot": {"/fibonacci": [Right.SERVE]},
    "viewer": {"/chatter": BOTH, "/points": BOTH, "/rosout": [Right.READ], "/fibonacci": [Right.CALL]},
}
SERVES: Final = "a client of a door serves nothing to others: no delegation names who answers"
PARAMETERS: Final = "parameters of a ROS 1 master do not cross: a name on the overlay has an owner and a type"
WITHOUT_TYPE: Final = "actionlib's messages are no standard types of ROS 2, and no far node describes them"
REPUBLISHER: Final = "it needs the node tf2_web_republisher, which serves clients of the same ROS 1 graph"
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


@pytest.fixture(scope="module", params=["twisted", pytest.param("asyncio", marks=pytest.mark.nightly)])
def outcomes(request: pytest.FixtureRequest, suite: Path) -> Iterator[tuple[Mapping[str, str], str]]:
    """Return the outcome of each test of roslibpy, over one of its transports, and all output."""
    files = sorted({f"tests/{name.partition('::')[0]}" for name in ROSLIBPY})
    with session_lab(RIGHTS, TYPES) as lab:
        robot = lab.start("-m", "netns_tests.action_child", "robot")
        assert lines_of(robot, 1) == ['{"event": "ready"}']
        door = lab.start("-m", "gdp.cli.gdp", "rosbridge", "viewer", "--json", "--no-token")
        ready = json.loads(lines_of(door, 1)[0])
        assert ready["url"] == "ws://127.0.0.1:9090"
        words = ["env", f"--chdir={suite}", f"ROSLIBPY_TRANSPORT={request.param}", sys.executable, "-m", "pytest"]
        words += ["-p", "no:cacheprovider", "-o", "addopts=", "-v", "--tb=short", *files]
        tests = lab.start_command(words)
        try:
            output = tests.communicate(timeout=SUITE_S)[0]
        except subprocess.TimeoutExpired:
            tests.kill()
            output = tests.communicate()[0]
        yield dict(_RESULT.findall(output)), output


def _expected(name: str, reason: str) -> object:
    return pytest.param(name, marks=[pytest.mark.xfail(reason=reason, strict=True)] if reason else [])


@pytest.mark.parametrize("name", [_expected(*each) for each in ROSLIBPY.items()])
def test_roslibpy(outcomes: tuple[Mapping[str, str], str], name: str) -> None:
    each, output = outcomes
    assert each.get(name, "did not end") == "PASSED", output[-20_000:]


def test_every_test_of_roslibpy_that_connects_is_listed(outcomes: tuple[Mapping[str, str], str]) -> None:
    assert set(outcomes[0]) == set(ROSLIBPY)
