"""Examples of the library with a real switch, a RIB and real keys."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator

import pytest

from gdp.trust.right import Right
from netns_tests.session_lab import EXAMPLES, SessionLab, lines_of, session_lab

pytestmark = pytest.mark.netns


RIGHTS = {
    "robot": {"greeting": [Right.PUBLISH], "camera": [Right.PUBLISH], "reverse": [Right.CALL]},
    "server": {"greeting": [Right.READ], "camera": [Right.READ]},
    "edge": {"reverse": [Right.SERVE]},
    "cloud": {"reverse": [Right.SERVE]},
}


@pytest.fixture(scope="module")
def lab() -> Iterator[SessionLab]:
    with session_lab(RIGHTS) as lab:
        yield lab


def test_a_subscriber_prints_what_the_example_publishes(lab: SessionLab) -> None:
    subscriber = lab.python(str(EXAMPLES / "publish_subscribe.py"), "subscribe", "server")
    lab.output(sys.executable, str(EXAMPLES / "publish_subscribe.py"), "publish", "robot")
    said = subscriber.output().splitlines()
    assert [line.split(" from ")[0] for line in said] == [f"{number + 1} hello {number}" for number in range(10)]


def test_a_client_gets_responses_while_one_of_two_replicas_is_killed(lab: SessionLab) -> None:
    servers = [lab.python(str(EXAMPLES / "request_response.py"), "serve", label) for label in ("edge", "cloud")]
    assert [lines_of(server, 1) for server in servers] == [["serving"], ["serving"]]
    before = lab.output(sys.executable, str(EXAMPLES / "request_response.py"), "call", "robot").splitlines()
    servers[0].send(signal.SIGKILL)
    after = lab.output(sys.executable, str(EXAMPLES / "request_response.py"), "call", "robot").splitlines()
    words = ["tobor", "rosnes", "rennalp"]
    assert [line.split()[0] for line in before] == words
    assert [line.split()[0] for line in after] == words


def test_the_camera_example_shows_images_of_full_size(lab: SessionLab) -> None:
    viewer = lab.python(str(EXAMPLES / "camera.py"), "show", "server")
    sender = lab.python(str(EXAMPLES / "camera.py"), "send", "robot")
    first = lines_of(viewer, 3)
    sender.output()
    assert all("307200 bytes" in line for line in first), first


@pytest.mark.parametrize("name", ["publish_subscribe.py", "request_response.py", "camera.py"])
def test_an_example_is_shorter_than_thirty_lines(name: str) -> None:
    code = (EXAMPLES / name).read_text().splitlines()
    assert len(code) < 30
