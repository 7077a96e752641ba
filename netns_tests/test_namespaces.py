"""Topologies in real namespaces: created, cut, repaired, and removed without remains."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.processes import Process
from gdp.host.run_registry import Run, RunRegistry, in_first_user_namespace
from lab.namespaces import Namespaces
from lab.process import until
from lab.topology import chain, ring5

pytestmark = pytest.mark.netns


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunRegistry:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return RunRegistry(tmp_path / "runs")


@pytest.fixture
def run(runs: RunRegistry) -> Iterator[Run]:
    started = runs.start()
    yield started
    started.end()


def links(namespaces: Namespaces, node: str) -> dict[str, list[str]]:
    """Return the fields of ``ip -br link`` for each device: state, MAC, flags."""
    argv = namespaces[node].command(["ip", "-br", "link"])
    lines = subprocess.run(argv, check=True, capture_output=True, text=True).stdout.splitlines()
    return {line.split("@")[0].split()[0]: line.split()[1:] for line in lines}


def read(namespaces: Namespaces, node: str, file: str) -> str:
    return namespaces[node].inside(Path(file).read_text).strip()


def test_every_device_is_called_like_the_neighbour_it_leads_to(run: Run) -> None:
    namespaces = Namespaces(ring5(), run)
    devices = {node: set(links(namespaces, node)) for node in namespaces.topology.nodes}
    assert devices["nuc1"] >= {"lo", "nuc2", "nuc5"}
    assert devices["nuc3"] >= {"lo", "nuc2", "nuc4"}
    assert not devices["nuc3"] & {"nuc1", "nuc5"}


def test_every_mac_tells_both_ends(run: Run) -> None:
    namespaces = Namespaces(chain(2), run)
    assert links(namespaces, "s1")["s2"][1] == "02:67:64:70:01:02"
    assert links(namespaces, "s2")["s1"][1] == "02:67:64:70:02:01"


@pytest.mark.parametrize("mtu", [576, 9_000, 65_521])
def test_links_have_the_wanted_mtu_at_both_ends(run: Run, mtu: int) -> None:
    namespaces = Namespaces(chain(2, mtu), run)
    show = ["ip", "link", "show"]
    for node, device in (("s1", "s2"), ("s2", "s1")):
        argv = namespaces[node].command([*show, device])
        assert f" mtu {mtu} " in subprocess.run(argv, check=True, capture_output=True, text=True).stdout


def test_nothing_of_ours_speaks_ipv6(run: Run) -> None:
    namespaces = Namespaces(chain(2), run)
    if not Path("/proc/sys/net/ipv6").exists():
        pytest.skip("this kernel has no IPv6")
    assert read(namespaces, "s1", "/proc/sys/net/ipv6/conf/s2/disable_ipv6") == "1"
    assert read(namespaces, "s1", "/proc/thread-self/net/if_inet6") == ""


def test_a_cut_link_loses_its_carrier_at_both_ends_and_gets_it_back(run: Run) -> None:
    namespaces = Namespaces(ring5(), run)
    namespaces["nuc3"].wait_for_carrier("nuc2", "nuc4")
    namespaces.cut("nuc3", "nuc2")
    assert "UP" not in links(namespaces, "nuc2")["nuc3"][2].strip("<>").split(",")
    assert "NO-CARRIER" in links(namespaces, "nuc3")["nuc2"][2]
    assert "NO-CARRIER" not in links(namespaces, "nuc3")["nuc4"][2]
    namespaces.restore_link("nuc2", "nuc3")
    until(lambda: "NO-CARRIER" not in links(namespaces, "nuc3")["nuc2"][2], "the kernel announces the carrier")


def test_a_bridge_joins_devices_and_goes_without_them(run: Run) -> None:
    middle = Namespaces(chain(3), run)["s2"]
    middle.bridge("joined", ("s1", "s3"))
    assert all("master joined" in middle.ip("link", "show", "dev", device) for device in ("s1", "s3"))
    middle.configure(["link del dev joined"])
    assert not any("master" in middle.ip("link", "show", "dev", device) for device in ("s1", "s3"))


def test_a_link_that_is_not_there_cannot_be_cut(run: Run) -> None:
    with pytest.raises(LocalError, match="no link nuc1-nuc3"):
        Namespaces(ring5(), run).cut("nuc1", "nuc3")


def test_a_process_inside_keeps_the_id_it_was_started_under(run: Run) -> None:
    namespaces = Namespaces(chain(1), run)
    argv = namespaces["s1"].command([sys.executable, "-c", "import os; print(os.getpid())"])
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) == process.pid


def test_the_namespace_that_the_test_runs_in_is_left_alone(run: Run) -> None:
    before = os.readlink("/proc/thread-self/ns/net")
    Namespaces(ring5(), run)
    assert os.readlink("/proc/thread-self/ns/net") == before


def test_the_end_of_a_run_removes_what_it_made_and_nothing_else(runs: RunRegistry, tmp_path: Path) -> None:
    mine, other = runs.start(), runs.start()
    left = Namespaces(chain(2), other)
    gone = Namespaces(chain(2), mine)
    mine.end()
    assert not any(gone[node].path.exists() for node in ("s1", "s2"))
    assert set(links(left, "s1")) >= {"lo", "s2"}
    other.end()
    assert list(tmp_path.rglob("*")) == []


def test_where_root_is_real_ip_netns_finds_the_namespaces(run: Run) -> None:
    if not in_first_user_namespace():
        pytest.skip("inside a user namespace they lie in the run's own directory")
    Namespaces(chain(1), run)
    listed = subprocess.run(["ip", "netns", "list"], check=True, capture_output=True, text=True).stdout
    assert f"gdp-{run.id}-s1" in listed


ORPHAN = """
import subprocess, sys, tempfile, signal
from pathlib import Path
from lab.namespaces import Namespaces
from gdp.host.processes import Process
from gdp.host.run_registry import RunRegistry
from lab.topology import chain
tempfile.tempdir = sys.argv[1]
run = RunRegistry(Path(sys.argv[1]) / "runs").start()
namespaces = Namespaces(chain(2), run)
pids = []
for leash in (True, False):
    argv = namespaces["s1"].command(["sh", "-c", "echo; exec sleep 600"], dies_with_us=leash)
    child = subprocess.Popen(argv, stdout=subprocess.PIPE, start_new_session=True)
    child.stdout.readline()
    run.note_process(child.pid)
    pids.append(child.pid)
print(*pids, namespaces["s1"].path, flush=True)
signal.pause()
"""


def test_what_a_killed_process_left_behind_is_swept_by_the_next(runs: RunRegistry, tmp_path: Path) -> None:
    argv = [sys.executable, "-c", ORPHAN, str(tmp_path)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        leashed, free, path = process.stdout.readline().split()
        leash, loose = os.pidfd_open(int(leashed)), Process.from_pid(int(free))
        process.send_signal(signal.SIGKILL)
    poller = select.poll()
    poller.register(leash, select.POLLIN)
    assert poller.poll(5_000), "a process on the leash outlived the one that held it"
    os.close(leash)
    assert Path(path).exists()
    assert loose.alive
    assert len(runs.sweep()) == 1
    assert not Path(path).exists()
    assert not loose.alive
    assert list(tmp_path.rglob("*")) == []
