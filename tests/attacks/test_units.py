"""Sandboxes of the services: systemd's rating of the units, and the separation of user code from the machine's keys."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from fog.host.bounded_log import BoundedLog
from fog.host.bundle import pack, read_programs
from fog.host.managed_process import NODE_USER, ManagedProcess
from fog.machine import MachineBundle, Program
from fog.providers.cloud_init import HOME, Setup, cloud_config, placed
from gdp.enrolment import service_units
from gdp.enrolment.programs import Machine, MachineProgram
from gdp.enrolment.service_units import service_texts
from lab.process import until
from tests.fog.bootstrap.desk import made_desk
from tests.pages import ROOT

UNITS = sorted((ROOT / "gdp" / "enrolment" / "service").glob("*.service"))
EXPOSURE_MAX = {  # tenths; 96 without fences
    "gdp-switch": 27,
    "gdp-relay": 27,
    "gdp-rib": 23,
    "gdp-proxy": 23,
    "gdp-fog": 23,
    "fog-machine": 50,
    "gdp-enrolment": 25,
    "gdp-agent": 23,
    "fog-log@": 40,
}
FENCES = (
    *("NoNewPrivileges=yes", "ProtectSystem=strict", "ProtectHome=yes", "PrivateTmp=yes", "CapabilityBoundingSet="),
    *("RestrictAddressFamilies=", "SystemCallFilter=", "MemoryMax=", "TasksMax="),
    "LimitNOFILE=",
)
JOINED = ("switch", "relay", "rib", "proxy", "enrolment", "agent")  # all programs of a machine that joined a domain
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may become another user")
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
LOOKS = """
import json, os, pathlib, sys
status = dict(l.split(":\\t", 1) for l in open("/proc/self/status").read().splitlines() if ":\\t" in l)
def reads(path):
    try:
        return bool(pathlib.Path(path).read_bytes())
    except OSError as error:
        return error.errno
print(json.dumps({
    "uid": os.getuid(), "gid": os.getgid(), "home": os.environ["HOME"], "cwd": os.getcwd(),
    "caps": [int(status[k], 16) for k in ("CapEff", "CapPrm", "CapBnd", "CapAmb")], "nnp": status["NoNewPrivs"],
    "key": reads(sys.argv[1]),
}), flush=True)
"""


def machine_unit(name: str = "fog-machine") -> str:
    (unit,) = (file for file in placed({}, Setup()) if file.path.endswith(f"{name}.service"))
    return unit.content.decode()


def joined_units(directory: Path) -> dict[str, str]:
    """Return the units that joining writes, by the name of the program."""
    directory.mkdir(exist_ok=True)
    programs = tuple(
        MachineProgram(
            name=name, title=name, argv=("/bin/true",), capabilities=("CAP_NET_BIND_SERVICE",) * (name == "enrolment")
        )
        for name in JOINED
    )
    texts = service_texts(Machine(directory=directory, programs=programs, is_member=True))
    return dict(zip(JOINED, texts.values(), strict=True))


@pytest.fixture(params=[*UNITS, "fog-machine", "fog-log@", *JOINED], ids=lambda each: getattr(each, "stem", each))
def unit(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Unit file with an existing program: each that is packaged, or written on a machine."""
    for name in ("_PRIVATE_TMP", "_HOMES"):
        monkeypatch.setattr(service_units, name, ())  # where tests and their Python are
    if request.param in JOINED:
        text, path = joined_units(tmp_path / "lab")[request.param], tmp_path / f"gdp-{request.param}.service"
    elif isinstance(request.param, str):
        text, path = machine_unit(request.param), tmp_path / f"{request.param}.service"
    else:
        text, path = request.param.read_text(), tmp_path / request.param.name
    path.write_text(re.sub(r"(?m)^(Exec\w+=\+?)/(?:opt|usr/local|usr/lib/gdp-ros)/\S+", r"\1/bin/true", text))
    return path


@needs_systemd
def test_a53_systemd_understands_the_unit(unit: Path) -> None:
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)],
        env={**os.environ, "SYSTEMD_UNIT_PATH": f"{unit.parent}:"},
        capture_output=True,
        text=True,
        check=False,
    )
    ours = [line for line in done.stderr.splitlines() if unit.name in line and "gdp-switch.service" not in line]
    assert ours == []


@needs_systemd
def test_a53_systemd_finds_the_unit_fenced(unit: Path) -> None:
    words = ["systemd-analyze", "security", "--offline=true", "--no-pager", f"--threshold={EXPOSURE_MAX[unit.stem]}"]
    done = subprocess.run([*words, str(unit)], capture_output=True, text=True, check=False)
    if "unrecognized option" in done.stderr or "nknown" in done.stderr:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, f"{done.stdout}{done.stderr}".splitlines()[-1]


def test_a53_the_unit_has_every_fence(unit: Path) -> None:
    lines = unit.read_text().splitlines()
    lacking = [fence for fence in FENCES if not any(line.startswith(fence) for line in lines)]
    assert lacking == []
    kept = set(re.findall(r"CAP_\w+", " ".join(line for line in lines if line.startswith("CapabilityBoundingSet="))))
    assert not kept & {"CAP_SYS_ADMIN", "CAP_SYS_PTRACE", "CAP_SYS_MODULE", "CAP_DAC_READ_SEARCH", "CAP_SYS_RAWIO"}
    if unit.stem in ("fog-machine", "fog-log@", "gdp-enrolment", "gdp-agent"):
        return
    assert {"Type=notify", "NotifyAccess=main"} <= set(lines)
    assert any(line.startswith("WatchdogSec=") for line in lines)
    assert "DynamicUser=yes" in lines or f"ReadWritePaths={unit.parent / 'lab'}" in lines


@pytest.mark.parametrize("name", ["enrolment", "agent"])
def test_a95_programs_of_a_joined_machine_that_need_no_device_have_none(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The enrolment server has the domain's root key, and any host may connect to it."""
    monkeypatch.setattr(service_units, "_PRIVATE_TMP", ())
    lines = joined_units(tmp_path)[name].splitlines()
    assert {"PrivateDevices=yes", "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK"} <= set(lines)
    assert f"CapabilityBoundingSet={'CAP_NET_BIND_SERVICE' if name == 'enrolment' else ''}" in lines


def test_a53_nodes_of_a_machine_are_the_users_code(tmp_path: Path) -> None:
    with made_desk(tmp_path) as desk:
        boot = desk.boot("m1")
    programs = read_programs(pack(boot)["boot.json"])
    assert {each.name: each.is_users for each in programs if each.name in ("switch", "proxy")} == {
        "switch": False,
        "proxy": False,
    }
    assert all(each.is_users for each in programs if each.name.startswith("node"))
    assert f"{NODE_USER}=fog-node" in machine_unit()


def test_a53_only_the_middlewares_profile_is_open_to_the_nodes_user(tmp_path: Path) -> None:
    home = tmp_path / "fog"
    (home / "keys").mkdir(parents=True)
    for name in ("keys/own.key", "keys/x.xml", "proxy.yaml", "fastdds.xml"):
        (home / name).write_text("x")
    text = cloud_config(pack(MachineBundle({}, ())), Setup())
    for words in yaml.safe_load(text)["runcmd"]:
        if words[0] in ("chmod", "find"):
            subprocess.run([word.replace(HOME, str(home)) for word in words], check=True)
    modes = {str(path.relative_to(home)): path.stat().st_mode & 0o077 for path in home.rglob("*")}
    assert modes == {"keys": 0, "keys/own.key": 0, "keys/x.xml": 0, "proxy.yaml": 0, "fastdds.xml": 0o044}
    assert home.stat().st_mode & 0o777 == 0o711


@pytest.fixture
def home() -> Iterator[Path]:
    """Machine's folder, as other users see one."""
    with tempfile.TemporaryDirectory(prefix="gdp-test-") as folder:
        Path(folder).chmod(0o711)
        yield Path(folder)


def looked(tmp_path: Path, *, is_users: bool) -> dict[str, object]:
    """Return the view that a machine's program has of itself."""
    key = tmp_path / "own.key"
    key.write_text("secret")
    key.chmod(0o600)

    async def live() -> None:
        log = BoundedLog(tmp_path / "log")
        program = Program("node", ("/usr/bin/python3", "-c", LOOKS, str(key)), is_users=is_users)
        incarnation_id = ManagedProcess(program, tmp_path, log, lambda: None)
        await asyncio.wait_for(incarnation_id.ended, 30)
        log.close()

    asyncio.run(live())
    said: dict[str, object] = json.loads((tmp_path / "log").read_text())
    return said


@needs_root
def test_a53_the_users_code_runs_as_another_user_without_rights(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(NODE_USER, "daemon")
    daemon = pwd.getpwnam("daemon")
    said = looked(home, is_users=True)
    assert (said["uid"], said["gid"], said["home"]) == (daemon.pw_uid, daemon.pw_gid, daemon.pw_dir)
    assert said["cwd"] == os.path.realpath(daemon.pw_dir)
    assert said["caps"] == [0, 0, 0, 0]
    assert said["nnp"] == "1"
    assert said["key"] == 13  # EACCES


@needs_root
def test_a53_the_machines_own_programs_stay_who_they_are(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(NODE_USER, "daemon")
    said = looked(home, is_users=False)
    assert (said["uid"], said["key"]) == (0, True)


def test_a53_a_user_that_is_not_there_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(NODE_USER, "no-user-of-this-name")

    async def live() -> None:
        with contextlib.closing(BoundedLog(tmp_path / "log")) as log:
            ManagedProcess(Program("node", ("true",), is_users=True), tmp_path, log, lambda: None)

    with pytest.raises(OSError, match="no-user-of-this-name"):
        asyncio.run(live())


@needs_root
def test_a53_the_users_code_ends_with_the_machine_although_it_is_another_user(tmp_path: Path) -> None:
    code = (
        "import asyncio, pathlib, sys\n"
        "from fog.host.bounded_log import BoundedLog\n"
        "from fog.host.managed_process import ManagedProcess\nfrom fog.machine import Program\n"
        "async def live():\n"
        "    home = pathlib.Path(sys.argv[1])\n"
        "    program = Program('n', ('sleep', '1000'), is_users=True)\n"
        "    life = ManagedProcess(program, home, BoundedLog(home / 'log'), lambda: None)\n"
        "    await asyncio.sleep(1)\n"
        "    print(life.pid, flush=True)\n"
        "    await life.ended\n"
        "asyncio.run(live())\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT), NODE_USER: "daemon"},
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    with process.stdout:
        node = int(process.stdout.readline())
    assert Path(f"/proc/{node}").stat().st_uid == pwd.getpwnam("daemon").pw_uid
    process.send_signal(signal.SIGKILL)
    process.wait(20)
    until(lambda: not Path(f"/proc/{node}/exe").exists())
