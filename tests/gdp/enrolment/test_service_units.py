"""Units of nodes that were configured by hand: whose they are, what they may write, and what marks them."""

from __future__ import annotations

import os
import pwd
import sys
from pathlib import Path

import pytest

from gdp.enrolment import service_units
from gdp.enrolment.programs import Machine, MachineProgram, read_machine
from gdp.enrolment.service_units import service_texts
from gdp.enrolment.units import installed_units
from gdp.errors import LocalError


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    monkeypatch.setattr(service_units, "_PRIVATE_TMP", ())
    for each in ("switch", "rib"):
        (tmp_path / "robot" / each).mkdir(parents=True)
    (tmp_path / "robot/machine.yaml").write_text("switch: {}\nrib: {}\n")
    return read_machine(tmp_path / "robot")


def test_a_node_runs_as_the_owner_of_its_keys_and_writes_to_its_folder_alone(machine: Machine) -> None:
    texts = service_texts(machine)
    assert list(texts) == ["gdp-robot-switch.service", "gdp-robot-rib.service"]
    user = pwd.getpwuid(os.geteuid()).pw_name
    for text in texts.values():
        lines = text.splitlines()
        assert lines[0] == f"# gdp service: {machine.directory}"
        assert f"User={user}" in lines
        assert f"ReadWritePaths={machine.directory}" in lines
        assert "ProtectSystem=strict" in lines
        assert not any(line.startswith(("DynamicUser", "StateDirectory")) for line in lines)
    assert "After=gdp-robot-switch.service" in texts["gdp-robot-rib.service"]


def test_a_holder_writes_its_capsules_and_reports_nothing_to_systemd(machine: Machine, tmp_path: Path) -> None:
    (machine.directory / "store").mkdir()
    (machine.directory / "store/root.crt").touch()
    (tmp_path / "disk").mkdir()
    (machine.directory / "machine.yaml").write_text("switch: {}\nstore: {holds: {folder: ../disk}}\n")
    lines = service_texts(read_machine(machine.directory))["gdp-robot-store.service"].splitlines()
    (writable,) = [line.partition("=")[2].split() for line in lines if line.startswith("ReadWritePaths=")]
    assert {Path(each).resolve() for each in writable} == {machine.directory, tmp_path / "disk"}
    assert {
        "Type=exec",
        "After=gdp-robot-switch.service",
        "Description=GDP holder: keeps the history of topics in capsules",
    } <= set(lines)
    assert not any(line.startswith(("WatchdogSec", "NotifyAccess", "ExecReload")) for line in lines)
    (command,) = [line for line in lines if line.startswith("ExecStart=")]
    assert command.endswith(f"store serve --config {machine.directory}/machine.yaml --await-iface 60")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_a_node_of_a_user_has_its_locks_in_a_folder_of_that_user(machine: Machine) -> None:
    user = pwd.getpwnam("daemon")
    os.chown(machine.directory / "rib", user.pw_uid, user.pw_gid)
    lines = service_texts(machine)["gdp-robot-rib.service"].splitlines()
    assert {"User=daemon", "RuntimeDirectory=gdp-daemon wireguard"} <= set(lines)
    assert any(line.startswith("Environment=XDG_RUNTIME_DIR=%t/gdp-daemon ") for line in lines)


def test_keys_below_the_state_folder_keep_the_dynamic_user(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_units, "STATE_FOLDER", machine.directory)
    lines = service_texts(machine)["gdp-robot-switch.service"].splitlines()
    assert {"DynamicUser=yes", "User=gdp", "StateDirectory=gdp-ros"} <= set(lines)
    assert any(line.startswith("ExecStart=") and sys.prefix in line for line in lines)


@pytest.mark.parametrize(("workspace", "home"), [("/home/me/ws/install", "read-only"), ("/opt/ws/install", "yes")])
def test_a_proxy_sees_a_workspace_of_ros_in_a_home(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, workspace: str, home: str
) -> None:
    monkeypatch.setattr(service_units, "_HOMES", (Path("/home/me"),))
    environment = (("ROS_DISTRO", "jazzy"), ("PYTHONPATH", f"/opt/ros/jazzy:{workspace}"))
    program = MachineProgram(name="proxy", title="A proxy", argv=("/bin/true",), environment=environment)
    joined = Machine(directory=machine.directory, programs=(program,), is_member=True)
    assert f"ProtectHome={home}" in service_texts(joined)["gdp-robot-proxy.service"].splitlines()


def test_files_that_a_unit_cannot_see_are_refused(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_units, "_PRIVATE_TMP", (machine.directory.parent,))
    with pytest.raises(LocalError, match="units have a /tmp of their own"):
        service_texts(machine)


def test_only_marked_units_of_a_machine_are_found(tmp_path: Path) -> None:
    (tmp_path / "gdp-a-switch.service").write_text("# gdp service: /srv/a\n[Unit]\n")
    (tmp_path / "gdp-b-switch.service").write_text("# gdp service: /srv/b\n[Unit]\n")
    (tmp_path / "gdp-switch.service").write_text("[Unit]\n")
    assert set(installed_units(folder=tmp_path)) == {"gdp-a-switch.service", "gdp-b-switch.service"}
    assert installed_units(Path("/srv/a"), tmp_path) == ["gdp-a-switch.service"]
