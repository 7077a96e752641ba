"""Privileges that a process has dropped, tested in a child process: each forbidden operation is tried."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from gdp.ports.confine import landlock, seccomp
from gdp.ports.confine.capabilities import Capability
from tests.pages import ROOT

CHILD = """
import ctypes, json, os, pathlib, socket, subprocess, sys
from gdp.ports.sandbox import Needs, confine
own, port, parent = pathlib.Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
libc = ctypes.CDLL(None, use_errno=True)
kept = open(own / "kept", "w")
code = [pathlib.Path(each) for each in ("/proc", "/usr", "/lib", "/lib64", sys.prefix, sys.base_prefix)]
rights = confine(Needs(writes=(own / "mine",), reads=(*code, own / "mine"), tcp_ports=()))
found = {}

def attempt(name, act):
    try:
        found[name] = "done" if act() in (None, 0) or name == "own" else ctypes.get_errno()
    except OSError as error:
        found[name] = error.errno

def call(act, *words):
    ctypes.set_errno(0)
    result = act(*words)
    return 0 if result >= 0 else 1

attempt("own", lambda: (own / "mine" / "x").write_text("x"))
attempt("kept", lambda: kept.flush())
attempt("write", lambda: (own / "theirs").write_text("x") and None)
attempt("read", lambda: (own / "secret").read_text() and None)
attempt("execute", lambda: os.execv("/bin/true", ["true"]))
attempt("connect", lambda: socket.create_connection(("127.0.0.1", port)).close())
attempt("signal", lambda: os.kill(parent, 0))
attempt("unshare", lambda: call(libc.unshare, 0))
attempt("mount", lambda: call(libc.mount, b"none", b"/mnt", b"tmpfs", 0, None))
attempt("ptrace", lambda: call(libc.ptrace, 0, 0, 0, 0))
attempt("setns", lambda: call(libc.setns, 0, 0))
attempt("raw", lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0).close())
status = dict(line.split(":\\t", 1) for line in open("/proc/self/status").read().splitlines() if ":\\t" in line)
found["status"] = {key: status[key].strip() for key in ("CapEff", "CapPrm", "CapBnd", "NoNewPrivs", "Seccomp")}
found["rights"] = rights.to_text()
print(json.dumps(found))
"""


OPEN_ALONE = """
from gdp.errors import LocalError
from gdp.ports.kernel.keepalives import KeepaliveSessions
from gdp.ports.kernel.program import LICENCE
from gdp.ports.kernel.syscall import load_program
from gdp.ports.kernel.assembler import Assembler
from gdp.ports.sandbox import Capability, Needs, confine
try:
    sessions = KeepaliveSessions()
except LocalError as refused:
    print("skip", str(refused).partition(chr(10))[0])
    raise SystemExit
passing = Assembler()
passing.leave(-1)
code = passing.assemble()
confine(Needs(capabilities=frozenset(Capability), uses_open_programs=True))
sessions._slots.put_many([bytes(4)], [bytes(4)])
sessions._ends.put(bytes(36), bytes(4))
print(sessions._ends.remove(bytes(36)))
sessions._run(1)
for attempt in (lambda: load_program(code, "more", LICENCE), KeepaliveSessions):
    try:
        attempt()
        print("done")
    except LocalError as refused:
        print("EPERM" in str(refused))
"""


def test_a53_an_end_runs_the_programs_that_it_has_open_and_loads_no_other() -> None:
    if not seccomp.denied(os.uname().machine):
        pytest.skip("no list of system calls for this machine")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", OPEN_ALONE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    if done.stdout.startswith("skip"):
        pytest.skip(done.stdout)
    assert done.stdout.split() == ["True"] * 3


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """Result of each attempt: ``done``, or an error number."""
    folder = tmp_path_factory.mktemp("sandbox")
    (folder / "mine").mkdir()
    (folder / "secret").write_text("x")
    with socket.create_server(("127.0.0.1", 0)) as server:
        words = [str(folder), str(server.getsockname()[1]), str(os.getpid())]
        done = subprocess.run(
            [sys.executable, "-c", CHILD, *words],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
    assert done.returncode == 0, done.stderr
    said: dict[str, object] = json.loads(done.stdout)
    return said


def needs_landlock(version: int) -> None:
    if landlock.abi() < version:
        pytest.skip(f"this kernel has Landlock {landlock.abi()}, not {version}")


def test_a53_a_process_that_gave_its_rights_away_has_none(found: dict[str, object]) -> None:
    status = found["status"]
    assert isinstance(status, dict)
    assert int(status["CapEff"], 16) == int(status["CapPrm"], 16) == 0
    assert status["NoNewPrivs"] == "1"
    assert found["raw"] == 1
    if os.geteuid() == 0:
        assert int(status["CapBnd"], 16) == 0


def test_a53_what_it_needs_it_can_still_do(found: dict[str, object]) -> None:
    assert (found["own"], found["kept"]) == ("done", "done")


@pytest.mark.parametrize("call", ["unshare", "mount", "ptrace", "setns"])
def test_a53_a_system_call_that_no_node_makes_is_refused(found: dict[str, object], call: str) -> None:
    if not seccomp.denied(os.uname().machine):
        pytest.skip("no list of system calls for this machine")
    status = found["status"]
    assert isinstance(status, dict)
    assert status["Seccomp"] == "2"
    assert found[call] == 1  # EPERM


@pytest.mark.parametrize(("act", "version"), [("write", 1), ("read", 1), ("execute", 1), ("connect", 4), ("signal", 6)])
def test_a53_landlock_refuses_what_was_not_named(found: dict[str, object], act: str, version: int) -> None:
    needs_landlock(version)
    assert found[act] in (1, 13)  # EPERM, EACCES


def test_a53_one_line_says_what_is_left(found: dict[str, object]) -> None:
    line = str(found["rights"])
    assert "capabilities=none" in line
    assert "no_new_privs=True" in line
    assert f"landlock={landlock.abi() or 'none'}" in line
    assert line.endswith("threads=1")


def test_a53_the_capabilities_have_the_kernels_numbers() -> None:
    header = Path("/usr/include/linux/capability.h")
    if not header.is_file():
        pytest.skip("the kernel's headers are not here")
    text = header.read_text()
    for each in Capability:
        assert f"CAP_{each.name} " in text.replace("\t", " ")
        assert any(line.split() == ["#define", f"CAP_{each.name}", str(each.value)] for line in text.splitlines())


def test_a53_every_refused_call_has_its_number_on_both_machines() -> None:
    ours, theirs = seccomp.denied("x86_64"), seccomp.denied("aarch64")
    assert ours.keys() - theirs.keys() == {"ioperm", "iopl"}
    assert seccomp.denied("x86_64", ["bpf"]).keys() == ours.keys() - {"bpf"}
    assert seccomp.denied("riscv64") == {}


HEADERS = {
    "x86_64": (Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"), "__NR_"),
    "aarch64": (Path("/usr/include/asm-generic/unistd.h"), "__NR(?:3264)?_"),
}


@pytest.mark.parametrize("machine", HEADERS)
def test_b13_the_system_calls_have_the_kernels_numbers(machine: str) -> None:
    header, prefix = HEADERS[machine]
    if not header.is_file():
        pytest.skip("the kernel's headers are not here")
    numbers = {each[1]: int(each[2]) for each in re.finditer(rf"#define {prefix}(\w+) (\d+)", header.read_text())}
    numbers.setdefault("newfstatat", numbers.get("fstatat", 0))
    ours = {**seccomp.denied(machine), **seccomp.allowed(machine)}
    assert {name: numbers.get(name, number) for name, number in ours.items()} == ours
    assert len(seccomp.allowed(machine)) <= 90


def test_b13_no_call_is_allowed_and_refused() -> None:
    for machine in HEADERS:
        assert not seccomp.allowed(machine).keys() & seccomp.denied(machine).keys()
    assert seccomp.allowed("riscv64") == {}
