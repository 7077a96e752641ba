"""Site of ``fog`` whose machines boot in a data centre: a robot, its switch's end of the tunnels, and ``fog.yaml``.

I/O; everything belongs to one run. The robot's side (switch, RIB, proxy) runs in the namespace of the caller. The
data centre's machines reach it through NAT, and their tunnels end in one VXLAN device here, as an operator makes it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from fog.enrolment.bootstrap import RobotDevices, robot_boot
from fog.enrolment.members import Authority
from fog.host.bundle import install
from fog.host.status import Status
from fog.machine import MachineState
from fog.software.wheels import build_wheel, wheels
from fog.supervisor.journal import Journal
from fog.supervisor.record import Record
from gdp.host.run_registry import Run
from gdp.stores.issue import make_domain, make_owner
from netns_tests.datacenter.debian_root import cache_folder
from netns_tests.datacenter.ec2 import UBUNTU
from netns_tests.datacenter.router import CALLER, Lease
from netns_tests.local_site import until
from tests.pages import ROOT
from tests.script_packages import PYTHON_PATH

__all__ = ["TUNNEL_ID", "CloudSite", "wheelhouse"]

TUNNEL_ID: Final = 42
_TUNNEL: Final = "fog0"
_COMMAND_S: Final = 400.0  # fog launch waits for a machine that boots
_DEVICES: Final = RobotDevices(uplink=_TUNNEL, proxy="robot0", rib="rib0", watch="watch0")
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

    Args:
        latency: region -> ``HOST:PORT`` that stands for its public endpoint.
    """

    def __init__(self, run: Run, wheel_folder: Path, latency: Mapping[str, str]) -> None:
        self.folder = run.directory
        self.state = self.folder / "state"
        self._run = run
        self._robot: subprocess.Popen[bytes] | None = None
        make_domain(self.folder / "domain", "cloud")
        make_owner(self.folder / "owner")
        scratch = self.folder / "scratch"
        scratch.mkdir(mode=0o700)
        self._home = self.folder / "robot"
        install(
            self._home, robot_boot(Authority(self.folder / "domain", self.folder / "owner", scratch), _DEVICES, days=1)
        )
        for each in ("proxy/delegations", "revocations"):
            (self._home / each).mkdir(mode=0o700)
        content = {
            "domain": "domain",
            "owner": "owner",
            "robots": ["robot/proxy.yaml"],
            "switch": "robot/switch.yaml",
            "watch": _DEVICES.watch,
            "state": "state",
            "provider": "aws",
            "aws": {
                "regions": list(latency),
                "image_owner": UBUNTU,
                "image_name": "ubuntu/images/*",
                "setup": {"vxlan": {"remote": str(CALLER), "id": TUNNEL_ID, "device": _TUNNEL}},
            },
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

    def start_robot(self, device: str) -> None:
        """Make the robot's end of the tunnels on the device to the data centre, and start switch, RIB and proxy."""
        link = f"link add {_TUNNEL} type vxlan id {TUNNEL_ID} local {CALLER} dstport 4789 dev {device}"
        for words in (link, f"link set {_TUNNEL} up"):
            subprocess.run(["ip", *words.split()], check=True)
        argv = [sys.executable, "-m", "fog.host.cli", "--home", str(self._home)]
        with (self.folder / "robot.log").open("wb") as log:
            self._robot = subprocess.Popen(argv, env=self.environment, stdout=log, stderr=log, start_new_session=True)
        self._run.note_process(self._robot.pid)
        until(self._is_robot_up, "the robot's side is up")

    def attach(self, lease: Lease) -> None:
        """Make the robot's end of the tunnel reach a new machine."""
        entry = f"fdb append 00:00:00:00:00:00 dev {_TUNNEL} dst {lease.public}"
        subprocess.run(["bridge", *entry.split()], check=True)

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
        """End the robot's side."""
        if self._robot is not None:
            self._robot.send_signal(signal.SIGTERM)
            self._robot.wait(timeout=_COMMAND_S)

    def _is_robot_up(self) -> bool:
        assert self._robot is not None
        assert self._robot.poll() is None, (self.folder / "robot.log").read_text()
        status = Status.read(self._home)
        return status is not None and status.state is MachineState.RUNNING
