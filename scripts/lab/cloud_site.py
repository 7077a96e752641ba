"""Sites of ``fog``: any, and one whose machines boot in a data centre: a border, whose proxy is the robot's.

I/O; everything of the latter belongs to one run. The border runs in the namespace of the caller: ``gdp domain create``
makes it, and the data centre's machines join it by their tokens, from behind NAT.
"""

from __future__ import annotations

import json
import shutil
import socket
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final

from fog.software.wheels import build_wheel, wheels
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Journal
from gdp.errors import GdpError
from gdp.host.run_registry import Run
from lab.datacenter import CALLER
from lab.debian import built_once
from lab.ec2 import UBUNTU
from lab.machine import GDP, LabMachine
from lab.process import ROOT, LabProcess, until

_COMMAND_S: Final = 400.0  # fog launch waits for a machine that boots
_ROS: Final = ("ros-jazzy-rmw-fastrtps-cpp", "ros-jazzy-std-msgs")


def wheelhouse(folder: Path) -> Path:
    """Return a folder with the wheels of a machine; those of other projects are kept between runs."""
    recipe = (ROOT / "requirements" / "ros2.lock").read_text() + (ROOT / "pyproject.toml").read_text() + repr(_ROS)
    wanted = [str(ROOT / "scripts" / "fog_demo"), *_ROS]
    shutil.copytree(built_once("wheels", recipe, lambda fresh: wheels(fresh, wanted, build=["empy"])), folder)
    build_wheel(ROOT, folder)
    return folder


class FogSite:
    """Command ``fog`` on a machine, with a state folder of its own.

    ``words``: options of every command. ``environment``: extends the present one, for the robot's nodes, too.
    """

    def __init__(self, host: LabMachine, state: Path, *words: str) -> None:
        self.host, self.state, self._words = host, state, words
        discovery = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
        self.environment = host.environment
        self.environment |= discovery

    def run(self, *words: str) -> str:
        """Run ``fog`` for this site and return its output."""
        done = self.host.run(sys.executable, "-m", "fog.cli.app", *words, *self._words, patience_s=_COMMAND_S)
        assert done.returncode == 0, f"fog {' '.join(words)}: {done.stdout}{done.stderr}{self.log()}"
        return done.stdout

    def log(self) -> str:
        """Return the supervisor's log."""
        path = self.state / "supervisor.log"
        return path.read_text() if path.exists() else ""

    def machines(self, cluster: str) -> list[Record]:
        """Return the machines of a cluster that are not gone."""
        if not (self.state / "journal.sqlite3").exists():
            return []
        with closing(Journal(self.state / "journal.sqlite3")) as journal:
            return journal.machines(cluster, gone=False)

    def start_caller(self, hz: float, *more: str, heard: bool = True) -> LabProcess:
        """Start the robot's node, which calls ``/echo``; a line of JSON from time to time says what was answered."""
        words = ["-m", "fog_demo.caller", "--ros-args", "-p", f"rate_hz:={hz}"]
        options = [word for each in more for word in ("-p", each)]
        return self.host.launch([sys.executable, *words, *options], "caller", heard=heard)


class CloudSite(FogSite):
    """Site in the folder of a run; the caller's namespace has no other switch.

    ``latency``: region -> ``HOST:PORT`` that stands for its public endpoint.
    """

    def __init__(self, run: Run, wheel_folder: Path, latency: Mapping[str, str]) -> None:
        self.folder = run.directory
        self.border = self.folder / "border"
        self._border: LabProcess | None = None
        content = {
            "border": "border",
            "state": "state",
            "provider": "aws",
            "aws": {"regions": list(latency), "image_owner": UBUNTU, "image_name": "ubuntu/images/*"},
            "software": {"wheels": str(wheel_folder)},
            "latency": {"endpoints": dict(latency)},
        }
        (self.folder / "fog.yaml").write_text(json.dumps(content), encoding="utf-8")
        host = LabMachine(self.folder, run=run, environment={"ROS_DOMAIN_ID": "172"})
        super().__init__(host, self.folder / "state", "--site", str(self.folder / "fog.yaml"))

    def start_border(self) -> None:
        """Create the domain on this host, and start its border, whose proxy is the robot's."""
        words = ["domain", "create", "cloud", "--public", str(CALLER), "--directory", str(self.border), "--no-systemd"]
        self._border = self.host.launch([*GDP, *words], "border", heard=False)
        until(self._is_border_up, "the border is up")

    def members(self) -> dict[str, str]:
        """Return label -> state of the domain's machines, as ``gdp domain ls`` shows them, removed ones included."""
        listed = self.host.gdp("domain", "ls", "cloud", "--directory", self.border, "--all", "--json")
        return {each["label"]: each["state"] for each in json.loads(listed)}

    def tunnels(self) -> list[str]:
        """Return the labels of the peers of the border's switch."""
        return [str(each["label"]) for each in self.host.status("border/switch").get("links", [])]

    def serving(self, cluster: str) -> list[Record]:
        """Return the machines that serve, by the overlay."""
        return [each for each in self.machines(cluster) if each.is_serving]

    def events(self, cluster: str) -> list[dict[str, Any]]:
        """Return the events of a cluster, oldest first."""
        lines = self.run("status", cluster, "--events", "--json", "-n", "200").splitlines()
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        """End the border and the robot's node."""
        if self._border is not None:
            self._border.finish(patience_s=_COMMAND_S)
        self.host.close()

    def _is_border_up(self) -> bool:
        assert self._border is not None
        log = self._border.logged
        assert self._border.code is None, log
        with suppress(GdpError):
            return "listening on TCP port" in log and all(
                map(self.host.status, ("border/switch", "border/rib", "border/proxy"))
            )
        return False


def launch_file(folder: Path) -> Path:
    """Write a launch file of one replica."""
    path = folder / "echo.launch.py"
    path.write_text(
        "from fog import FogCluster, LaunchDescription, Node, SpotMachine\n\n\n"
        "def generate_launch_description():\n"
        "    FogCluster(name='echo', cloud_nodes=[Node(package='fog_demo', executable='echo')], replicas=1,\n"
        "        deployments=[SpotMachine(hardware='cpu:2')], services={'/echo': 'std_srvs/srv/SetBool'})\n"
        "    return LaunchDescription([])\n",
        encoding="utf-8",
    )
    return path


def start_echo(delay_s: float) -> int:
    """Start an echo service that stands for a region's public endpoint; return its port."""
    echo = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    echo.bind(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            datagram, peer = echo.recvfrom(2_048)
            time.sleep(delay_s)  # this is the distance
            echo.sendto(datagram, peer)

    threading.Thread(target=serve, name="echo", daemon=True).start()
    return int(echo.getsockname()[1])
