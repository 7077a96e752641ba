"""Unit files on a booted Debian: each node runs with the rights of its unit, and one that hangs is restarted."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from gdp.host.run_registry import Run, RunRegistry
from lab.datacenter import Router
from lab.debian import BootedMachine, why_not
from lab.process import until
from tests.pages import ROOT

pytestmark = [pytest.mark.netns, pytest.mark.skipif(bool(why_not()), reason=why_not() or "it can")]

UNITS: Final = ROOT / "gdp" / "enrolment" / "service"
NODES: Final = ("switch", "rib", "proxy")
PREFIX: Final = "usr/lib/gdp-ros"
STATE: Final = "/var/lib/gdp-ros"
BOOT_S: Final = 60.0
START_S: Final = 30.0
WATCHDOG_S: Final = 4  # of the switch here; 30 in its unit
NET_ADMIN, NET_RAW, PERFMON, BPF = 1 << 12, 1 << 13, 1 << 38, 1 << 39
BOUND: Final = NET_ADMIN | NET_RAW | PERFMON | BPF
FIRST: Final = """\
import os, pathlib, sys
status = pathlib.Path("/proc/self/status").read_text()
pathlib.Path("/var/lib/gdp-ros", pathlib.Path(sys.argv[0]).name + ".rights").write_text(status)
"""  # what the unit alone gives a process, before the node drops rights of its own
SCRIPT: Final = """\
#!/usr/bin/python3 -B
import sys
sys.path.insert(0, "/usr/lib/gdp-ros/packages")
{first}
from {module} import main
main()
"""


def gdp(*words: str, cwd: Path) -> None:
    subprocess.run([sys.executable, "-m", *words], cwd=cwd, check=True, capture_output=True, text=True)


def install(root: Path, wheels: Path) -> None:
    """Put the packages, the commands and the units into a machine's files, as a package would."""
    files = [str(each) for each in sorted(wheels.glob("*.whl")) if not each.name.startswith(("ros_", "fog_demo"))]
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*words, "--target", str(root / PREFIX / "packages"), *files], check=True, capture_output=True)
    commands = {"switch": "gdp.cli.switch", "rib": "gdp.cli.rib", "proxy": "proxy.cli.proxy"}
    (root / PREFIX / "bin").mkdir()
    for name, module in commands.items():
        path = root / PREFIX / "bin" / f"gdp-{name}"
        path.write_text(SCRIPT.format(first=FIRST, module=module))
        path.chmod(0o755)
    for unit in UNITS.glob("*.service"):
        target = root / "usr/lib/systemd/system" / unit.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(unit, target)


def configure(root: Path, work: Path) -> None:
    """Make a lab whose switch, RIB and recording proxy all run on this one machine."""
    work.mkdir()
    gdp("gdp.cli.gdp", "lab", "robot", "server", "--iface", "eth0", cwd=work)
    proxy = (
        "identity: {0}/proxy\ndomain: {{root: {0}/proxy/root.crt}}\ndelegations: {0}/proxy/delegations\n"
        "iface: proxy0\nimport:\n"
        "  - {{name: /camera/image, type: sensor_msgs/msg/Image, owner: {0}/owner.pub}}\n"
    )
    (work / "robot/proxy.yaml").write_text(proxy.format("."))
    gdp("proxy.cli.delegate", "--owner", "owner", "robot/proxy.yaml", cwd=work)
    shutil.copytree(work / "robot", root / STATE.lstrip("/"))
    configs = root / "etc/gdp"
    configs.mkdir(parents=True)
    own = f"identity: {STATE}/%s\ndomain: {{root: {STATE}/%s/root.crt}}\n"
    (configs / "switch.yaml").write_text(
        own % ("switch", "switch") + "ports: [{iface: eth0}]\nattach: [rib0, proxy0]\n"
    )
    (configs / "rib.yaml").write_text(own % ("rib", "rib") + "iface: rib0\n")
    (configs / "proxy.yaml").write_text(proxy.format(STATE) + f"record: {{path: {STATE}/received.mcap}}\n")


@pytest.fixture
def machine(image: Path, wheels: Path, tmp_path: Path, space: object) -> Iterator[BootedMachine]:
    run: Run = RunRegistry(tmp_path / "runs").start()
    root = run.directory / "m1" / "upper"
    root.mkdir(parents=True)
    install(root, wheels)
    configure(root, tmp_path / "lab")
    quick = root / "etc/systemd/system/gdp-switch.service.d/quick.conf"
    quick.parent.mkdir(parents=True)
    quick.write_text(f"[Service]\nWatchdogSec={WATCHDOG_S}\n")
    (root / "etc/cloud").mkdir()
    (root / "etc/cloud/cloud-init.disabled").touch()
    booted = BootedMachine(run, "m1", image, Router(run).add("m1"))
    try:
        yield booted
    finally:
        booted.power_off()
        run.end()


def shows(machine: BootedMachine, unit: str, *keys: str) -> dict[str, str]:
    text = machine.run("systemctl", "show", *(f"--property={key}" for key in keys), unit)
    return dict(line.split("=", 1) for line in text.splitlines())


def is_booted(machine: BootedMachine) -> bool:
    try:
        return machine.run("systemctl", "is-active", "basic.target").strip() == "active"
    except (subprocess.CalledProcessError, IndexError, FileNotFoundError):
        return False  # systemd has not begun, or its target is not reached


@pytest.mark.nightly
def test_each_node_runs_under_the_rights_of_its_unit_and_a_hung_one_is_restarted(machine: BootedMachine) -> None:
    until(lambda: is_booted(machine), "the machine boots", BOOT_S)
    names = [f"gdp-{each}" for each in NODES]
    try:
        machine.run("systemctl", "start", *names)  # returns when each has reported READY=1
    except subprocess.CalledProcessError as error:
        journal = machine.run("journalctl", "--no-pager", "--lines=80", *(f"--unit={each}" for each in names))
        pytest.fail(f"{error.stderr}\n{journal}")
    for name in NODES:
        state = shows(machine, f"gdp-{name}", "ActiveState", "MainPID", "WatchdogUSec")
        assert state["ActiveState"] == "active"
        assert state["WatchdogUSec"] == (f"{WATCHDOG_S}s" if name == "switch" else "30s")
        text = machine.run("cat", f"{STATE}/gdp-{name}.rights")
        given = dict(line.split(":\t", 1) for line in text.splitlines() if ":\t" in line)
        assert int(given["CapBnd"], 16) == BOUND
        assert int(given["CapEff"], 16) == BOUND
        assert (given["NoNewPrivs"], given["Seccomp"]) == ("1", "2")
        assert given["Uid"].split()[0] != "0"
    until(
        lambda: "is attached" in machine.run("journalctl", "--no-pager", "--output=cat", "--unit=gdp-proxy"),
        "the proxy finds the switch and the RIB",
        START_S,
    )
    pid = shows(machine, "gdp-switch", "MainPID")["MainPID"]
    machine.run("kill", "-STOP", pid)  # a loop that hangs
    until(
        lambda: shows(machine, "gdp-switch", "MainPID", "ActiveState") != {"MainPID": pid, "ActiveState": "active"},
        "the watchdog ends the hung switch",
        60.0,
    )
    until(
        lambda: shows(machine, "gdp-switch", "ActiveState")["ActiveState"] == "active", "it is started again", START_S
    )
    assert shows(machine, "gdp-switch", "NRestarts")["NRestarts"] == "1"
    assert machine.run("systemctl", "--failed", "--no-legend").strip() == ""
