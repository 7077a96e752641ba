"""``gdp unit`` on a booted Debian: the units run, survive a reboot, and leave nothing once they are removed."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import pytest

from gdp.host.run_registry import Run, RunRegistry
from lab.datacenter import Router
from lab.debian import BootedMachine, why_not
from lab.process import until
from netns_tests.test_service_units import BOOT_S, PREFIX, SCRIPT, START_S, gdp, install, is_booted, shows

pytestmark = [pytest.mark.netns, pytest.mark.skipif(bool(why_not()), reason=why_not() or "it can")]

NODES: Final = ("switch", "rib", "proxy")
UNITS: Final = [f"gdp-robot-{each}.service" for each in NODES]
LEFT: Final = ("/etc/systemd/system", "/run/gdp-locks", "/run/systemd/transient")


@pytest.fixture
def boot(image: Path, wheels: Path, tmp_path: Path, space: object) -> Iterator[Callable[[], BootedMachine]]:
    """Yield a function that boots the machine, each time with the files that it left."""
    run: Run = RunRegistry(tmp_path / "runs").start()
    root = run.directory / "m1" / "upper"
    root.mkdir(parents=True)
    install(root, wheels)
    command = root / PREFIX / "bin" / "gdp"
    command.write_text(SCRIPT.format(first="", module="gdp.cli.gdp"))
    command.chmod(0o755)
    packages = root / "usr/lib/python3/dist-packages"
    packages.mkdir(parents=True)
    (packages / "gdp.pth").write_text(f"import sys; sys.path.insert(0, '/{PREFIX}/packages')\n")
    shutil.rmtree(root / "usr/lib/systemd/system")
    work = tmp_path / "lab"
    work.mkdir()
    gdp("gdp.cli.gdp", "lab", "robot", "--iface", "eth0", cwd=work)
    (work / "robot/switch.yaml").unlink()
    (work / "robot/rib.yaml").unlink()
    (work / "robot/machine.yaml").write_text("switch: {ports: [{iface: eth0}]}\nrib:\nproxy: proxy.yaml\n")
    (work / "robot/proxy.yaml").write_text(
        "identity: proxy\ndomain: {root: proxy/root.crt}\ndelegations: proxy/delegations\niface: proxy0\n"
        "import:\n  - {name: /camera/image, type: sensor_msgs/msg/Image, owner: owner.pub}\n"
    )
    gdp("proxy.cli.delegate", "--owner", "owner", "robot/proxy.yaml", cwd=work)
    shutil.copytree(work / "robot", root / "srv/robot")
    (root / "etc/cloud").mkdir(parents=True)
    (root / "etc/cloud/cloud-init.disabled").touch()
    lease = Router(run).add("m1")
    with ExitStack() as stack:
        stack.callback(run.end)

        def booted() -> BootedMachine:
            machine = BootedMachine(run, "m1", image, lease)
            stack.callback(machine.power_off)
            until(lambda: is_booted(machine), "the machine boots", BOOT_S)
            return machine

        yield booted


def files(machine: BootedMachine) -> list[str]:
    """Return the files of the folders in which units leave traces."""
    there = [each for each in LEFT if machine.run("sh", "-c", f"test -e {each} && echo yes || true")]
    return sorted(machine.run("find", *there).split())


def command(machine: BootedMachine, *words: str) -> str:
    try:
        return machine.run(f"/{PREFIX}/bin/gdp", "unit", *words)
    except subprocess.CalledProcessError as error:
        pytest.fail(f"{error.stdout}{error.stderr}{machine.run('journalctl', '--no-pager', '--lines=60')}")


def states(machine: BootedMachine) -> dict[str, dict[str, Any]]:
    done = machine.run("sh", "-c", f"/{PREFIX}/bin/gdp unit status --json || true")
    return {each["unit"]: each for each in json.loads(done)["units"]}


@pytest.mark.nightly
def test_installed_units_run_survive_a_reboot_and_leave_nothing_when_removed(
    boot: Callable[[], BootedMachine],
) -> None:
    machine = boot()
    before = files(machine)
    shown = json.loads(command(machine, "install", "/srv/robot", "--dry-run", "--json"))["files"]
    assert [Path(each).name for each in shown] == UNITS
    assert files(machine) == before
    command(machine, "install", "/srv/robot")
    until(lambda: all(each["well"] for each in states(machine).values()), "the nodes are ready", START_S)
    assert {unit: state["enabled"] for unit, state in states(machine).items()} == dict.fromkeys(UNITS, True)
    for unit in UNITS:
        state = shows(machine, unit, "ActiveState", "ProtectSystem", "NoNewPrivileges")
        assert state == {"ActiveState": "active", "ProtectSystem": "strict", "NoNewPrivileges": "yes"}
    machine.run("systemctl", "poweroff", "--no-block")
    until(lambda: not machine.is_up, "the machine ends", BOOT_S)
    machine.power_off()

    machine = boot()
    until(lambda: all(each["well"] for each in states(machine).values()), "the nodes are ready again", START_S)
    machine.run("systemctl", "kill", "--signal=KILL", UNITS[1])
    until(lambda: states(machine)[UNITS[1]]["restarts"] == 1, "systemd restarts the RIB", START_S)
    until(lambda: states(machine)[UNITS[1]]["well"], "the RIB is ready", START_S)
    assert json.loads(command(machine, "remove", "--json"))["removed"] == UNITS
    assert files(machine) == before
    assert machine.run("systemctl", "--failed", "--no-legend").strip() == ""
    assert "rib0" not in machine.run("ip", "-br", "link")
