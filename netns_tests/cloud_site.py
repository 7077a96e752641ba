"""Site of ``fog`` whose machines boot in a data centre: a border, whose proxy is the robot's, and ``fog.yaml``.

I/O; everything belongs to one run. The border runs in the namespace of the caller: ``gdp domain create`` makes it, and
the data centre's machines join it by their tokens, from behind NAT.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from fog.software.wheels import build_wheel, wheels
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Journal
from gdp.errors import GdpError
from gdp.host.run_registry import Run
from gdp.management.control_client import ask_node, find_control_socket
from gdp.state.control_protocol import Command
from netns_tests.datacenter.debian_root import cache_folder
from netns_tests.datacenter.ec2 import UBUNTU
from netns_tests.datacenter.router import CALLER
from tests.pages import ROOT
from tests.script_packages import PYTHON_PATH
from tests.waiting import until

_COMMAND_S: Final = 400.0  # fog launch waits for a machine that boots
_STATUS_S: Final = 5.0
_ROS: Final = ("ros-jazzy-rmw-fastrtps-cpp", "ros-jazzy-std-msgs")


def wheelhouse(folder: Path) -> Path:
    """Return a folder with the wheels of a machine; those of other projects are kept between runs."""
    recipe = (ROOT / "requirements" / "ros2.lock").read_bytes() + (ROOT / "pyproject.toml").read_bytes()
    kept = cache_folder() / f"wheels-{sha256(recipe + repr(_ROS).encode()).hexdigest()[:12]}"
    if not kept.exists():
        for older in cache_folder().glob("wheels-*"):
            shutil.rmtree(older)
        fresh = cache_folder() / f"new-{os.getpid()}"
        wheels(fresh, [str(ROOT / "scripts" / "fog_demo"), *_ROS], build=["empy"])
        fresh.rename(kept)
    shutil.copytree(kept, folder)
    build_wheel(ROOT, folder)
    return folder


class CloudSite:
    """Site in the folder of a run; the caller's namespace has no other switch.

    ``latency``: region -> ``HOST:PORT`` that stands for its public endpoint.
    """

    def __init__(self, run: Run, wheel_folder: Path, latency: Mapping[str, str]) -> None:
        self.folder = run.directory
        self.border = self.folder / "border"
        self.state = self.folder / "state"
        self._run = run
        self._border: subprocess.Popen[bytes] | None = None
        content = {
            "border": "border",
            "state": "state",
            "provider": "aws",
            "aws": {"regions": list(latency), "image_owner": UBUNTU, "image_name": "ubuntu/images/*"},
            "software": {"wheels": str(wheel_folder)},
            "latency": {"endpoints": dict(latency)},
        }
        (self.folder / "fog.yaml").write_text(json.dumps(content), encoding="utf-8")
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": "172",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "PYTHONPATH": PYTHON_PATH,
        }

    def start_border(self) -> None:
        """Create the domain on this host, and start its border, whose proxy is the robot's."""
        argv = [sys.executable, "-m", "gdp.cli.gdp", "domain", "create", "cloud", "--public", str(CALLER)]
        argv += ["--directory", str(self.border), "--no-systemd"]
        with (self.folder / "border.log").open("wb") as log:
            self._border = subprocess.Popen(argv, env=self.environment, stdout=log, stderr=log, start_new_session=True)
        self._run.note_process(self._border.pid)
        until(self._is_border_up, "the border is up")

    def members(self) -> dict[str, str]:
        """Return label -> state of the domain's machines, as ``gdp domain ls`` shows them, removed ones included."""
        argv = ["domain", "ls", "cloud", "--directory", str(self.border), "--all", "--json"]
        done = subprocess.run(
            [sys.executable, "-m", "gdp.cli.gdp", *argv],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=_COMMAND_S,
            check=True,
        )
        return {each["label"]: each["state"] for each in json.loads(done.stdout)}

    def tunnels(self) -> list[str]:
        """Return the labels of the peers of the border's switch."""
        status = ask_node(find_control_socket(self.border / "switch"), Command.STATUS, _STATUS_S)
        links = status.result.get("links")
        return [str(each["label"]) for each in links] if isinstance(links, list) else []

    def run(self, *words: str) -> str:
        """Run ``fog`` for this site and return its output."""
        argv = [sys.executable, "-m", "fog.cli.app", *words, "--site", str(self.folder / "fog.yaml")]
        done = subprocess.run(
            argv,
            env=self.environment,
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=_COMMAND_S,
            check=False,
        )
        assert done.returncode == 0, f"fog {' '.join(words)}: {done.stdout}{done.stderr}{self.log()}"
        return done.stdout

    def log(self) -> str:
        """Return the supervisor's log."""
        path = self.state / "supervisor.log"
        return path.read_text() if path.exists() else ""

    def serving(self, cluster: str) -> list[Record]:
        """Return the machines that serve, by the overlay."""
        if not (self.state / "journal.sqlite3").exists():
            return []
        with closing(Journal(self.state / "journal.sqlite3")) as journal:
            return [each for each in journal.machines(cluster, gone=False) if each.is_serving]

    def events(self, cluster: str) -> list[dict[str, Any]]:
        """Return the events of a cluster, oldest first."""
        lines = self.run("status", cluster, "--events", "--json", "-n", "200").splitlines()
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        """End the border."""
        if self._border is not None:
            self._border.send_signal(signal.SIGINT)
            self._border.wait(timeout=_COMMAND_S)

    def _is_border_up(self) -> bool:
        assert self._border is not None
        log = (self.folder / "border.log").read_text()
        assert self._border.poll() is None, log
        with suppress(GdpError):
            nodes = (find_control_socket(self.border / each) for each in ("switch", "rib", "proxy"))
            return "listening on TCP port" in log and all(
                ask_node(each, Command.STATUS, _STATUS_S).is_ok for each in nodes
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
