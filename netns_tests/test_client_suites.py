"""Test suites of public clients against the rosbridge door, in a namespace where it listens at 127.0.0.1:9090.

The suite of roslibpy comes with its source distribution, in the version of ``requirements/dev.lock``. Its other files
reach no server. npm's package of roslib has no tests: ``roslib/client.mjs`` does what its examples do.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Final, TypeAlias

import pytest

from gdp.crypto.keys import PublicKey
from gdp.nodes.delegation_store import DelegationStore
from gdp.trust.right import Right
from lab.debian import cache_folder
from lab.process import calling
from netns_tests.session_lab import SessionLab, lines_of, session_lab
from proxy.bridge.bridge import Bridge
from proxy.bridge.core.delegated_rules import DelegatedRules
from proxy.config.rule import Rule
from proxy.endpoints.core.qos import default
from proxy.node.member_config import member_config
from proxy.node.node import run_node
from tests.gdp_extensions.doors.fibonacci import FEEDBACK, FIBONACCI, SERVICES, STATUS
from tests.pages import ROOT
from tests.proxy.bridge import known
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph, Publication

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


STEP_S: Final = 0.3
_TICK_S: Final = 0.05
_CDR: Final = b"\0\1\0\0"
_ID: Final = slice(4, 20)
_SUCCEEDED, _CANCELED = 4, 5
Done = Callable[[bytes | str], None]


@dataclass(slots=True)
class _Goal:
    order: int
    due_s: float
    sequence: list[int] = field(default_factory=lambda: [0, 1])
    status: int = 0  # 0: it is executed
    done: Done | None = None

    @property
    def body(self) -> bytes:
        return struct.pack(f"<I{len(self.sequence)}i", len(self.sequence), *self.sequence)


class Server:
    """Node that serves the action, a step each ``STEP_S`` seconds."""

    def __init__(self, graph: FakeGraph) -> None:
        self._goals: dict[bytes, _Goal] = {}
        for part, ask in (("send_goal", self._accept), ("cancel_goal", self._cancel), ("get_result", self._wait)):
            graph.serve("/server", f"/fibonacci/_action/{part}", SERVICES[part].type_name, ask)
        self._feedback: Publication = graph.publish("/server", "/fibonacci/_action/feedback", FEEDBACK.type_name)
        graph.publish("/server", "/fibonacci/_action/status", STATUS, default(latched=True, depth=1))

    def _accept(self, raw: bytes, done: Done) -> None:
        self._goals[raw[_ID]] = _Goal(struct.unpack_from("<i", raw, 20)[0], time.monotonic() + STEP_S)
        done(_CDR + struct.pack("<B3xiI", 1, 0, 0))

    def _cancel(self, raw: bytes, done: Done) -> None:
        self._goals[raw[_ID]].status = _CANCELED
        done(_CDR + struct.pack("<b3xI", 0, 0))

    def _wait(self, raw: bytes, done: Done) -> None:
        self._goals[raw[_ID]].done = done

    def work(self, now_s: float) -> None:
        """Execute the goals."""
        for goal_id, goal in list(self._goals.items()):
            if goal.status == 0 and now_s >= goal.due_s:
                goal.due_s = now_s + STEP_S
                goal.sequence.append(sum(goal.sequence[-2:]))
                self._feedback.publish(_CDR + goal_id + goal.body)
                goal.status = _SUCCEEDED if len(goal.sequence) > goal.order else 0
            if goal.status and goal.done is not None:
                goal.done(_CDR + struct.pack("<b3x", goal.status) + goal.body)
                del self._goals[goal_id]


def serve(node_directory: str) -> None:
    """Run a proxy node with servers of an action and a service, until a signal; a process of its own.

    Its graph is in memory, since this machine may have no ROS; bridge, switch and delegations are real.
    """
    config, delegations = member_config(Path(node_directory).absolute(), None, None)
    services = known.services() | {each.type_name: each for each in SERVICES.values()}
    graph = FakeGraph(2, {**known.channels(), FEEDBACK.type_name: FEEDBACK}, services)
    graph.serve("/server", "/switch", known.SET_BOOL, lambda raw, done: done(known.switched("done")))
    endpoint, server = FakeEndpoint(graph, "/bridge"), Server(graph)
    with run_node(config) as node:
        held = DelegationStore(delegations, node.identity)
        owner = PublicKey.from_compressed(next(iter(held)).delegation.subject.owner_key)
        action = Rule.model_validate({"kind": "action", "name": "/fibonacci", "type": FIBONACCI, "owner": owner})
        service = Rule.model_validate({"kind": "service", "name": "/switch", "type": known.SET_BOOL, "owner": owner})
        rules = DelegatedRules([action, service], [])
        bridge = Bridge(node.state.context, rules, [endpoint], held)
        node.runtime.watch(endpoint)
        is_ready = False
        while not node.runtime.is_stopped:
            node.runtime.step(time.monotonic() + _TICK_S)
            now_s = time.monotonic()
            server.work(now_s)
            bridge.work(now_s)
            node.member.flush(now_s)
            if not is_ready and node.member.attachment.is_attached and bridge.is_settled:
                is_ready = True
                print(json.dumps({"event": "ready"}), flush=True)
        node.runtime.unwatch(endpoint)


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
        robot = lab.launch(calling(serve, "robot"))
        assert lines_of(robot, 1) == ['{"event": "ready"}']
        door = lab.python("-m", "gdp.cli.gdp", "rosbridge", "viewer", "--json", "--no-token")
        assert json.loads(lines_of(door, 1)[0])["url"] == URL
        lab.output(sys.executable, "-c", WAIT, URL)
        yield lab


@pytest.fixture(scope="module", params=["twisted", pytest.param("asyncio", marks=pytest.mark.nightly)])
def roslibpy_run(request: pytest.FixtureRequest, suite: Path, lab: SessionLab) -> Run:
    """Return the outcomes of roslibpy's tests over one of its transports: those that this session selects."""
    items = [
        each for each in request.session.items if isinstance(each, pytest.Function) and each.module is request.module
    ]
    names = {str(each.callspec.params["name"]) for each in items if each.originalname == "test_roslibpy"}
    files = sorted({f"tests/{name if names < ROSLIBPY.keys() else name.partition('::')[0]}" for name in names})
    words = ["env", f"--chdir={suite}", f"ROSLIBPY_TRANSPORT={request.param}", sys.executable, "-m", "pytest"]
    output = _output(lab, [*words, "-p", "no:cacheprovider", "-o", "addopts=", "-v", "--tb=short", *files])
    return dict(_RESULT.findall(output)), output


@pytest.fixture(scope="module")
def roslib_run(roslib: Path, lab: SessionLab) -> Run:
    """Return the outcomes of what the examples of roslib promise."""
    output = _output(lab, ["node", str(roslib / "client.mjs"), URL])
    return {name: outcome for outcome, name in re.findall(r"^(PASSED|FAILED) (\S+)", output, re.MULTILINE)}, output


def _output(lab: SessionLab, command: Sequence[str]) -> str:
    tests = lab.launch(command)
    try:
        printed = tests.reap(SUITE_S)
    except subprocess.TimeoutExpired:
        printed = tests.finish(signal.SIGKILL)
    return printed + tests.logged


def _rows(suite: Mapping[str, str], nightly: tuple[str, ...] = ()) -> list[object]:
    """Return the tests of a suite as parameters; ``nightly``: how the names of those begin that others repeat."""
    return [
        pytest.param(
            name,
            marks=[pytest.mark.xfail(reason=reason, strict=True)] * bool(reason)
            + [pytest.mark.nightly] * (bool(nightly and reason) or name.startswith(nightly)),
        )
        for name, reason in suite.items()
    ]


@pytest.mark.parametrize("name", _rows(ROSLIBPY, nightly=("ros1/test_ros.py", "ros1/test_rosapi.py")))
def test_roslibpy(roslibpy_run: Run, name: str) -> None:
    outcomes, output = roslibpy_run
    assert outcomes.get(name, "did not end") == "PASSED", output[-20_000:]


@pytest.mark.nightly
def test_every_test_of_roslibpy_that_connects_is_listed(roslibpy_run: Run) -> None:
    assert set(roslibpy_run[0]) == set(ROSLIBPY), roslibpy_run[1][-20_000:]


@pytest.mark.parametrize("name", _rows(ROSLIB))
def test_roslib(roslib_run: Run, name: str) -> None:
    outcomes, output = roslib_run
    assert outcomes.get(name, "did not end") == "PASSED", output


def test_every_promise_of_roslib_is_listed(roslib_run: Run) -> None:
    assert set(roslib_run[0]) == set(ROSLIB), roslib_run[1]
