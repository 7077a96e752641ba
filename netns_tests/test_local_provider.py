"""Provider ``local``: machines boot, are found again, suffer injected faults, and leave nothing behind."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from fog.hardware import Hardware
from fog.host.status import Status
from fog.machine import MachineState
from fog.providers.local import fault_injection
from fog.providers.local.machine_file import MachineFile
from fog.providers.local.machine_handle import find
from fog.providers.local.netlinks import exists
from fog.providers.local.provider import LocalProvider
from fog.topology import Gateway
from gdp.errors import LocalError, StoreError
from gdp.host import netns_files
from gdp.host.netns_files import reach
from gdp.host.processes import end_all
from lab.namespaces import Space
from lab.process import until
from netns_tests.local_site import (
    PATIENCE_S,
    Domain,
    is_running,
    leftovers,
    machine_of,
    plain_gateway,
    spec,
    ticking,
)
from tests.pages import ROOT

pytestmark = pytest.mark.netns
_ETHERTYPE = 0x88B6  # IEEE 802 local experimental 2


@pytest.fixture
def folder(tmp_path: Path, space: Space) -> Path:
    return tmp_path / "local"


@pytest.fixture
def provider(folder: Path) -> Iterator[LocalProvider]:
    made = LocalProvider(folder, plain_gateway)
    made.open_network()
    yield made
    made.terminate([each.id for each in made.describe("test")])
    made.close_network()
    assert [path.name for path in folder.iterdir()] == [".lock"]


def booted(provider: LocalProvider, name: str = "m1") -> str:
    machine = provider.create(spec(name), ticking())
    until(lambda: machine_of(provider, machine).state is MachineState.RUNNING, "running")
    return machine


def ticks(provider: LocalProvider, machine: str) -> int:
    return len((find(provider.runs, machine).home / "logs" / "ticker.log").read_bytes())


def test_a_machine_boots_and_is_reached_through_the_trees_gateways(folder: Path, tmp_path: Path) -> None:
    domain = Domain(tmp_path)
    west = Gateway(gateway="west", regions=("us-west-1",))
    provider = LocalProvider(folder, domain.gateway, Gateway(gateway="edge", children=(west,)))
    provider.open_network()
    try:
        domain.start_robot("fog0")
        ids = [
            provider.create(spec("m1", "us-west-1"), domain.machine("m1")),
            provider.create(spec("m2", "us-west-1"), domain.machine("m2")),
        ]
        for machine in ids:  # its proxy is attached when the robot's RIB has acknowledged it
            until(partial(is_running, provider, machine), "running")
        assert {find(provider.runs, machine).gateway.name[-5:] for machine in ids} == {"-west"}
        provider.drain(ids[0])
        until(lambda: machine_of(provider, ids[0]).state is MachineState.GONE, "drained")
        assert machine_of(provider, ids[0]).reason == "drained"
        assert "is attached" in provider.log(ids[0], "proxy", 10)
    finally:
        runs = [record.run for record in provider.runs.all()]
        provider.terminate([each.id for each in provider.describe("test")])
        provider.close_network()
        domain.close()
    assert not exists(None, "fog0")
    assert leftovers(folder, runs) == []


def test_a_machine_is_an_address_and_a_shell_of_its_own(provider: LocalProvider) -> None:
    machine = booted(provider)
    address = machine_of(provider, machine).address
    argv = [*provider.shell(machine), "-c", "ip -o addr; pwd"]
    said = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    assert f"{address}/32" in said
    assert str(find(provider.runs, machine).home) in said


def test_who_asks_twice_has_one_machine(provider: LocalProvider) -> None:
    assert provider.create(spec("m1"), ticking()) == provider.create(spec("m1"), ticking())


def test_a_machine_is_taken_at_the_moment_of_its_notice(provider: LocalProvider) -> None:
    machine = booted(provider)
    fault_injection.notice(provider.runs, machine, 0.5)
    leaving = machine_of(provider, machine)
    assert leaving.state is MachineState.LEAVING
    assert leaving.leaves_at_unix_s is not None
    host = find(provider.runs, machine).host
    assert host is not None
    until(lambda: not host.alive, "taken without anybody asking")
    gone = machine_of(provider, machine)
    assert (gone.state, gone.reason) == (MachineState.GONE, "preempted")


@pytest.mark.nightly
@pytest.mark.usefixtures("either")
def test_a_frozen_machine_is_taken_at_the_moment_of_its_notice_too(provider: LocalProvider) -> None:
    machine = booted(provider)
    fault_injection.freeze(provider.runs, machine)
    fault_injection.notice(provider.runs, machine, 0.0)
    until(lambda: machine_of(provider, machine).state is MachineState.GONE, "taken")


@pytest.fixture(params=["with cgroups", pytest.param("without", marks=pytest.mark.nightly)])
def either(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also let a test run as it does where cgroups may not be written."""
    if request.param == "without":
        monkeypatch.setattr("gdp.host.cgroups._roots", lambda: (None, {}))


@pytest.mark.usefixtures("either")
def test_a_killed_machine_is_gone_with_its_link(provider: LocalProvider) -> None:
    machine = booted(provider)
    found = find(provider.runs, machine)
    fault_injection.kill(provider.runs, machine)
    until(lambda: machine_of(provider, machine).state is MachineState.GONE, "gone")
    assert machine_of(provider, machine).reason == "killed"
    assert not exists(found.gateway, found.gateway_device)


def test_a_machine_that_is_found_gone_is_written_under_the_lock_of_removals(
    provider: LocalProvider, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, held, write = booted(provider), list[bool](), MachineFile.write

    def locked(file: MachineFile, directory: Path) -> None:
        with (folder / ".lock").open("w") as other:
            try:
                fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                held.append(True)
        write(file, directory)

    monkeypatch.setattr(MachineFile, "write", locked)
    host = find(provider.runs, machine).host
    assert host is not None
    os.kill(host.pid, signal.SIGKILL)
    until(lambda: machine_of(provider, machine).state is MachineState.GONE, "gone")
    assert held == [True]


@pytest.mark.usefixtures("either")
def test_a_frozen_machine_does_nothing_until_it_is_thawed(provider: LocalProvider) -> None:
    machine = booted(provider)
    fault_injection.freeze(provider.runs, machine)
    time.sleep(0.05)  # it takes a moment to take effect
    before = ticks(provider, machine)
    time.sleep(0.2)
    assert ticks(provider, machine) == before
    assert machine_of(provider, machine).state is MachineState.RUNNING
    fault_injection.thaw(provider.runs, machine)
    until(lambda: ticks(provider, machine) > before, "going on")


@pytest.mark.nightly
def test_a_slow_machine_has_to_wait_for_its_processor(provider: LocalProvider) -> None:
    machine = provider.create(spec("m1"), ticking("print('ready', flush=True)\nwhile True: pass"))
    if not find(provider.runs, machine).file.is_bounded:
        pytest.skip("cgroups are not writable here")
    fault_injection.slow(provider.runs, machine, 0.05)
    stats = list(Path("/sys/fs/cgroup").glob(f"**/gdp-{machine}/cpu.stat"))
    until(lambda: any(re.search(r"nr_throttled [1-9]", each.read_text()) for each in stats), "throttled")
    fault_injection.slow(provider.runs, machine, None)
    with pytest.raises(LocalError, match="more than 0"):
        fault_injection.slow(provider.runs, machine, 0.0)


def test_a_machine_without_bounds_cannot_be_slowed(provider: LocalProvider, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.host.cgroups._roots", lambda: (None, {}))
    machine = booted(provider)
    assert not find(provider.runs, machine).file.is_bounded
    with pytest.raises(LocalError, match="no bound on processor time"):
        fault_injection.slow(provider.runs, machine, 0.1)


def listen(device: str) -> socket.socket:
    heard = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETHERTYPE))
    heard.bind((device, _ETHERTYPE))
    heard.settimeout(PATIENCE_S)
    return heard


@pytest.mark.nightly
@pytest.mark.parametrize("away", [True, False])
def test_no_frame_of_a_delayed_link_is_early(provider: LocalProvider, away: bool) -> None:
    machine = booted(provider)
    found = find(provider.runs, machine)
    ends = [netns_files.inside(found.netns_path, partial(listen, "eth0"))]
    ends.append(netns_files.inside(found.gateway, partial(listen, "machines")))
    source, sink = ends if away else reversed(ends)
    with source, sink:

        def took_s(body: bytes) -> float:
            begun_s = time.monotonic()
            source.send(b"\xff" * 6 + b"\x02" + bytes(5) + _ETHERTYPE.to_bytes(2, "big") + body)
            assert body in sink.recv(2_000)
            return time.monotonic() - begun_s

        fault_injection.delay(provider.runs, machine, 60.0)
        assert took_s(b"first") >= 0.06
        fault_injection.delay(provider.runs, machine, 90.0)
        assert took_s(b"second") >= 0.09
        fault_injection.delay(provider.runs, machine, 0.0)
        assert not exists(found.gateway, found.relay_out)
        took_s(b"third")


def test_what_is_just_being_made_cannot_be_given_back(provider: LocalProvider, folder: Path) -> None:
    run = provider.runs.start()
    found = find(provider.runs, booted(provider))
    found.file.write(run.directory)
    with pytest.raises(StoreError, match="just being made"):
        provider.terminate([run.id])
    run.end()


_CREATOR = """
import os, signal, sys
from pathlib import Path
from fog.providers.local import provider, spawn
from netns_tests.local_site import plain_gateway, spec, ticking

site = provider.LocalProvider(Path(sys.argv[1]), plain_gateway)
site.open_network()
if sys.argv[2] == "during":
    spawn.os.write = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
site.create(spec("m1"), ticking())
os.kill(os.getpid(), signal.SIGKILL)
"""


def killed_creator(folder: Path, when: str) -> None:
    argv = [sys.executable, "-c", _CREATOR, str(folder), when]
    ended = subprocess.run(argv, capture_output=True, text=True, check=False, cwd=ROOT)
    assert ended.returncode == -signal.SIGKILL, ended.stderr


def test_machines_outlive_their_creator_and_are_found_again(folder: Path) -> None:
    killed_creator(folder, "after")
    provider = LocalProvider(folder, plain_gateway)
    (machine,) = provider.describe("test")
    until(lambda: machine_of(provider, machine.id).state is MachineState.RUNNING, "running")
    runs = [record.run for record in provider.runs.all()]
    provider.open_network()
    assert [record.run for record in provider.runs.all()] == runs
    provider.terminate([machine.id])
    provider.close_network()
    assert leftovers(folder, runs) == []


def test_what_was_begun_by_a_killed_creator_is_swept(folder: Path) -> None:
    killed_creator(folder, "during")
    provider = LocalProvider(folder, plain_gateway)
    (machine,) = [each.id for each in provider.describe("test")]
    until(lambda: machine_of(provider, machine).state is MachineState.GONE, "its process ended by itself")
    assert Status.read(find(provider.runs, machine).home) is None
    assert provider.sweep() == [machine]
    assert leftovers(folder, [machine]) == []
    provider.close_network()


_FROM_ANOTHER_MOUNT_NAMESPACE = """
import sys
from pathlib import Path
from fog.providers.local.provider import LocalProvider
from netns_tests.local_site import plain_gateway, spec, ticking

provider = LocalProvider(Path(sys.argv[1]), plain_gateway)
provider.open_network()
provider.create(spec("m1"), ticking())
"""


def test_machines_of_another_mount_namespace_are_reached_and_given_back(folder: Path) -> None:
    # as with ip netns exec, of which each makes a mount namespace of its own
    argv = ["unshare", "--mount", "--propagation", "private", sys.executable, "-c", _FROM_ANOTHER_MOUNT_NAMESPACE]
    subprocess.run([*argv, str(folder)], cwd=ROOT, timeout=PATIENCE_S, check=True)
    provider = LocalProvider(folder, plain_gateway)
    provider.open_network()
    first = provider.describe("test")[0].id
    until(partial(is_running, provider, first), "running")
    subprocess.run([*provider.shell(first), "-c", "true"], check=True)
    second = booted(provider, "m2")
    stray = subprocess.Popen(["nsenter", f"--net={reach(find(provider.runs, first).netns_path)}", "sleep", "1000"])
    runs = [record.run for record in provider.runs.all()]
    provider.terminate([first, second])
    assert stray.wait(PATIENCE_S) != 0
    provider.close_network()
    assert leftovers(folder, runs) == []
    assert not exists(None, "fog0")


@pytest.mark.nightly
def test_a_network_whose_mount_namespace_has_ended_is_removed(folder: Path) -> None:
    argv = ["unshare", "--mount", "--propagation", "private", sys.executable, "-c", _FROM_ANOTHER_MOUNT_NAMESPACE]
    subprocess.run([*argv, str(folder)], cwd=ROOT, timeout=PATIENCE_S, check=True)
    provider = LocalProvider(folder, plain_gateway)
    for record in provider.runs.all():
        end_all(record.processes)
    runs = [record.run for record in provider.runs.all()]
    provider.terminate([each.id for each in provider.describe("test")])
    provider.close_network()
    assert leftovers(folder, runs) == []


@pytest.mark.nightly
def test_a_gateway_that_was_killed_runs_again_when_the_network_is_opened(provider: LocalProvider) -> None:
    (network,) = provider.runs.all()
    os.killpg(network.processes[0].pid, signal.SIGKILL)
    until(lambda: not network.processes[0].alive, "killed")
    provider.open_network()
    (again,) = provider.runs.all()
    assert again.processes[-1].alive


def test_a_device_of_somebody_else_is_no_uplink(folder: Path, space: Space) -> None:
    space.ip("link", "add", "fog0", "type", "veth", "peer", "name", "other")
    provider = LocalProvider(folder, plain_gateway)
    with pytest.raises(LocalError, match="not ours"):
        provider.open_network()
    assert exists(None, "fog0")


def test_without_a_network_there_is_no_machine(folder: Path) -> None:
    with pytest.raises(LocalError, match="not open"):
        LocalProvider(folder, plain_gateway).create(spec("m1"), ticking())


def test_hardware_that_is_pretended_bounds_nothing(provider: LocalProvider) -> None:
    machine = provider.create(spec("m1", "mars-1", Hardware(96, 768.0, "A100", 8)), ticking())
    until(lambda: machine_of(provider, machine).state is MachineState.RUNNING, "running")
