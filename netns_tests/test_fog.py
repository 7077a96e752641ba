"""``fog`` command with real machines, switches, proxies and ROS nodes: launch, faults, scale, down."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from fog.supervisor.core.record import Record
from fog.supervisor.journal import Journal
from lab.cloud_site import FogSite
from lab.machine import GDP, LabMachine
from lab.namespaces import Space
from lab.process import python_path, until
from netns_tests.local_site import PATIENCE_S
from netns_tests.test_ring import commands_with
from tests.pages import ROOT

pytestmark = pytest.mark.netns
pytest.importorskip("rclpy", reason="needs the extra ros2")
_LAUNCH = ROOT / "examples" / "echo.launch.py"
_MACHINES_S = 3 * PATIENCE_S


class Fog(FogSite):
    """Site with a state folder of its own, in the namespace of the test."""

    def __init__(self, folder: Path) -> None:
        state = folder / "state"
        paths = {"FOG_STATE": str(state), "PYTHONPATH": python_path(ROOT / "examples" / "grasp")}
        super().__init__(LabMachine(folder, environment={"ROS_DOMAIN_ID": "171", **paths}), state)

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.run("status", "--json"))
        return found

    def living(self) -> list[Record]:
        return self.machines("echo")

    def events(self) -> list[str]:
        with closing(Journal(self.state / "journal.sqlite3")) as journal:
            return [each.what for each in journal.events("echo")]

    def serving(self) -> list[str]:
        return [each.name for each in self.living() if each.is_serving]

    def until(self, is_met: Callable[[], object], what: str) -> None:
        until(is_met, lambda: f"{what}: {self.log()}", _MACHINES_S)


@pytest.fixture
def fog(tmp_path: Path, space: Space) -> Iterator[Fog]:
    space.ip("link", "set", "lo", "up")
    made = Fog(tmp_path)
    yield made
    made.run("down", "--all")
    made.host.close()
    assert not left_of(made)


def test_calls_go_on_while_machines_are_taken_and_killed_and_the_supervisor_is(fog: Fog) -> None:
    fog.run("launch", str(_LAUNCH), "--detach")
    caller = fog.start_caller(20.0)
    while not caller.read(PATIENCE_S)["answered"]:
        pass
    first, second = fog.serving()
    os.kill(fog.status()["supervisor_pid"], signal.SIGKILL)
    fog.run("local", "kill", first)  # the fault is not observed yet
    fog.run("status")  # any command starts another supervisor
    fog.until(lambda: len({*fog.serving()} - {first}) == 2, "a killed machine is replaced")
    fog.run("local", "notice", second, "--seconds", "5")
    fog.until(lambda: len({*fog.serving()} - {first, second}) == 2, "a machine with notice is replaced")
    last = json.loads(caller.finish().splitlines()[-1])
    assert last["done"]
    assert last["failed"] == last["wrong"] == last["unserved"] == 0
    events = [json.loads(line) for line in fog.run("status", "--events", "--json", "-n", "200").splitlines()]
    assert {"enrolled", "preempted", "notice", "draining"} <= {each["what"] for each in events}
    assert "alarm" not in {each["what"] for each in events}
    assert [each["what"] for each in events].count("reconciled") == 2
    assert all(each["since_unix_s"] <= each["unix_s"] for each in events if each["what"] in ("preempted", "notice"))
    assert "ready" in fog.run("logs", first, "node")
    fog.run("scale", "down")
    fog.until(lambda: len(fog.living()) == 1, "one replica is let go")
    fog.run("down")
    assert json.loads(fog.run("ls", "--json")) == []
    assert not left_of(fog)


@pytest.mark.nightly
def test_the_live_view_shows_machines_first_answers_and_a_loss(fog: Fog) -> None:
    fog.run("launch", str(_LAUNCH), "--detach")
    first, second = fog.serving()
    fog.start_caller(20.0, heard=False)
    view = fog.host.launch([*GDP, "dashboard", "--json"])
    url = str(view.read(PATIENCE_S)["url"])
    with connect(url.replace("http", "ws", 1) + "live", max_size=None) as page:
        shown = Shown(page)
        shown.until(lambda: shown.serving() == 2 and len(shown.first_answers()) == 2)
        assert {each["name"] for each in shown.cluster()["machines"]} >= {first, second}
        before = sum(shown.first_answers().values())
        shown.until(lambda: sum(shown.first_answers().values()) > before + 20)
        fog.run("local", "kill", first)
        shown.until(lambda: any(first in text for text in shown.bad))
        shown.until(lambda: shown.serving() == 2 and first not in fog.serving())
    view.finish()
    assert view.code == 0


@pytest.mark.parametrize("command", ["fog launch", "ros2 launch"])
def test_the_listing_of_the_paper_plans_grasps_on_two_machines_and_the_robot_finds_each_right(
    command: str, fog: Fog, tmp_path: Path
) -> None:
    for module in ("cv2", "scipy"):
        pytest.importorskip(module, reason="needs the extra experiments")
    patient = "cloud_nodes=[planner],\n        timeout_s=60.0,"  # a busy machine plans longer than a call waits
    written = (ROOT / "examples" / "listing1.launch.py").read_text().replace("cloud_nodes=[planner],", patient)
    listing = str(tmp_path / "listing1.launch.py")
    Path(listing).write_text(written)
    if command == "fog launch":
        said = fog.run("launch", listing)
        assert {"us-west-1", "us-west-2"} <= set(said.split())
    elif (ros2 := shutil.which("ros2")) is None:
        pytest.skip("ROS 2's launch is not installed: no command ros2")
    else:
        done = fog.host.run("env", "PYTHONUNBUFFERED=1", ros2, "launch", listing, patience_s=_MACHINES_S)
        said = done.stdout + done.stderr
    assert "3 of 3 grasps are right" in said
    assert said.count("planned on m") == 3  # a machine of the cluster, not the robot
    assert json.loads(fog.run("ls", "--json")) == []  # the cluster ended with the launch


_SCALED = """
from fog import FogCluster, LaunchDescription, Node, SpotMachine

def generate_launch_description():
    FogCluster(
        name="echo",
        cloud_nodes=[Node(package="fog_demo", executable="echo")],
        deployments=[SpotMachine(hardware="cpu:1", on_demand=True)],
        services={"/echo": "std_srvs/srv/SetBool"},
        replication="hedged",
        scale={"min": 1, "max": 2, "target_calls_per_s": 10},
    )
    return LaunchDescription([])
"""


@pytest.mark.nightly
def test_load_adds_a_machine_and_one_on_demand_takes_the_place_of_a_spot_machine_that_is_not_to_be_had(
    fog: Fog, tmp_path: Path
) -> None:
    (tmp_path / "scaled.launch.py").write_text(_SCALED)
    fog.run("local", "sold-out")
    fog.run("launch", str(tmp_path / "scaled.launch.py"), "--detach")
    (first,) = fog.living()
    assert not first.spec.offer.is_spot
    fog.run("local", "sold-out", "--off")
    caller = fog.start_caller(20.0)
    fog.until(lambda: len(fog.serving()) == 2, "a second machine for the load")
    last = json.loads(caller.finish().splitlines()[-1])
    assert last["failed"] == last["wrong"] == last["unserved"] == 0
    assert [each.spec.offer.is_spot for each in fog.living()] == [False, True]
    assert "scaled" in fog.events()


class Shown:
    """What a page of the live view has received."""

    def __init__(self, page: ClientConnection) -> None:
        self._page = page
        self._structure: dict[str, Any] = {}
        self._figures: dict[str, Any] = {}
        self.bad: list[str] = []

    def until(self, is_met: Callable[[], object]) -> None:
        what = "the live view shows it"
        until(lambda: self._figures and is_met(), lambda: (what, self._structure, self.bad), _MACHINES_S, self._receive)

    def _receive(self) -> None:
        message = json.loads(self._page.recv(PATIENCE_S))
        if message["kind"] == "structure":
            self._structure = message
        elif message["kind"] == "figures":
            self._figures = message
            self.bad += [each["text"] for each in message["events"] if each["is_bad"] or each["what"] == "cluster"]

    def cluster(self) -> dict[str, Any]:
        (found,) = (each for each in self._structure["clusters"] if each["name"] == "echo")
        return dict(found)

    def serving(self) -> int:
        clusters = [each for each in self._structure["clusters"] if each["name"] == "echo"]
        return int(clusters[0]["serving"]) if clusters else 0

    def first_answers(self) -> dict[str, float]:
        """Return the first answers to ``/echo`` by server."""
        echo = {row[0] for row in self._structure["names"] if row[1] == "/echo"}
        return {row[2]: row[4] for row in self._figures["replicas"] if row[0] in echo and row[4]}


@pytest.mark.nightly
def test_down_ends_everything_though_launch_and_supervisor_were_killed_and_the_journal_is_gone(fog: Fog) -> None:
    launch = fog.host.launch([sys.executable, "-m", "fog.cli.app", "launch", str(_LAUNCH), "--json"])
    launch.read_until('"requested"')
    fog.host.kill(launch)
    pid = int((fog.state / "supervisor.lock").read_text())
    fog.until(lambda: list((fog.state / "local").glob("*.json")), "a machine is begun")
    os.kill(pid, signal.SIGKILL)
    for path in fog.state.glob("journal.sqlite3*"):
        path.unlink()
    fog.run("down", "--all")
    assert not left_of(fog)


def left_of(fog: Fog) -> list[str]:
    """Return the processes and devices of a site that still exist."""
    links = json.loads(subprocess.run(["ip", "-j", "link"], check=True, capture_output=True, text=True).stdout)
    return [*commands_with(str(fog.state)), *(each["ifname"] for each in links if each["ifname"].startswith("fog"))]
