"""Real processes in namespaces under faults of every kind; memory and tables stay bounded."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from faults.link_faults import FrameFaults
from faults.overlay import READY_S, Overlay
from faults.plan import Flow, Plan
from faults.records import Kind
from faults.store import NOT_WRITTEN, Disk, StoreCluster, has_server, snapshot_faults

from gdp.host.netns_files import processes_inside
from gdp.host.processes import Process
from gdp.host.run_registry import RunRegistry
from lab.machine import LabMachine
from lab.namespaces import Namespaces
from lab.process import calling, new_run, python_path, until
from lab.topology import make_topology
from tests.pages import ROOT

pytestmark = [pytest.mark.netns, pytest.mark.nightly]

_START_S = 200.0


def argv_of(name: str, options: Sequence[str]) -> list[str]:
    """Return the command line of a bench."""
    return [sys.executable, str(ROOT / "scripts" / "bench" / name), *options]


def test_a_killed_run_is_taken_down_by_the_next() -> None:
    def started() -> set[str]:
        return {record.run for record in RunRegistry().all()} - before

    before = {record.run for record in RunRegistry().all()}
    process = subprocess.Popen(argv_of("chaos.py", ["--seconds", "60"]), stderr=subprocess.DEVNULL)
    until(started, "a run that is recorded")
    (run,) = started()
    until(
        lambda: any(record.run == run and len(record.processes) > 20 for record in RunRegistry().all()), "its processes"
    )
    (record,) = (record for record in RunRegistry().all() if record.run == run)
    process.send_signal(signal.SIGKILL)
    process.wait()
    until(lambda: not any(each.alive for each in record.processes), "their end: they die with their parent")
    assert run in RunRegistry().sweep()
    assert not any(Path(path).exists() for path in [*record.namespaces, *record.files])


def keep_store() -> None:
    """Make a run with a full disk and a store of six servers, print its id, and wait; a process of its own."""
    topology, _ = make_topology({"a": ("s1",)}, {}, (), ("s1",), {"P": "s1"})
    run = RunRegistry().start()
    Disk(run).fill()
    StoreCluster(run, Namespaces(topology, run), ["s1"])
    print(run.id, flush=True)
    signal.pause()


@pytest.mark.skipif(not has_server(), reason="neither redis-server nor valkey-server is installed")
def test_the_disk_and_the_servers_of_a_killed_run_are_gone_after_the_next_sweep(tmp_path: Path) -> None:
    paths = {"PYTHONPATH": python_path(ROOT / "scripts" / "bench")}
    machine = LabMachine(tmp_path, environment=paths)
    child = machine.launch(calling(keep_store))
    run = child.read_line(_START_S).decode()
    machine.kill(child)
    (record,) = (record for record in RunRegistry().all() if record.run == run)
    spaces, folder = [Path(path) for path in record.namespaces], Path(record.files[0])
    servers = processes_inside(spaces)
    assert len(servers) == 6
    assert (folder / "disk").is_mount()
    record.processes.clear()  # as if killed before it recorded the servers
    (Path("/run/gdp") / f"{run}.json").write_text(record.to_text())
    assert run in RunRegistry().sweep()
    assert not any(server.alive for server in servers)
    assert not any(path.exists() for path in [*spaces, folder])


def has_written(disk: Disk, node: str) -> bool:
    """Return whether the RIB at a switch wrote a slice: the log of its database, which it keeps locked, has content."""
    log = Path(f"{disk.snapshot(node)}-wal")
    return log.exists() and log.stat().st_size > 0


def rib_log(overlay: Overlay) -> str:
    return list(overlay.logs("rib s1"))[-1][1]


def test_a_rib_comes_through_a_full_disk_and_starts_on_one() -> None:
    topology, members = make_topology({"a": ("s1", "s2")}, {}, ("s1-s2",), ("s1",), {"P": "s1", "R": "s2"})
    plan = Plan(topology, members, flows=(Flow("/t", "P", ("R",), hz=100.0),))
    with new_run() as run, Overlay(run, plan, has_disk=True, more={"rib": {"lease_s": 2.0}}) as overlay:
        disk = overlay.disk
        assert disk is not None
        overlay.start_all()
        until(lambda: numbers(overlay, "R"), "a message")
        until(lambda: has_written(disk, "s1"), "a slice in the snapshot")
        disk.fill()
        until(lambda: NOT_WRITTEN in rib_log(overlay), "a word about the full disk")
        overlay.kill("rib s1")
        overlay.start("rib s1")
        overlay.processes["rib s1"].read(READY_S)
        assert "snapshot read live=0" not in rib_log(overlay)
        assert "snapshot read live=" in rib_log(overlay)
        until(lambda: NOT_WRITTEN in rib_log(overlay), "a word about the full disk, after the restart")
        disk.free()
        until(lambda: "snapshot written again" in rib_log(overlay), "a word that it is written again")
        faults = [
            fault
            for incarnation_id, log in overlay.logs("rib s1")
            for fault in snapshot_faults(f"life {incarnation_id}", log, is_alive=incarnation_id == 2)
        ]
        assert (faults, disk.broken()) == ([], [])
    assert not run.directory.exists()


@pytest.fixture
def overlay() -> Iterator[Overlay]:
    """Two running switches with a publisher and a reader."""
    topology, members = make_topology({"a": ("s1", "s2")}, {}, ("s1-s2",), ("s1",), {"P": "s1", "R": "s2"})
    plan = Plan(topology, members, flows=(Flow("/t", "P", ("R",), hz=100.0),))
    with new_run() as run, Overlay(run, plan, has_clocks=True) as made:
        made.start_all()
        yield made


def numbers(overlay: Overlay, member: str) -> list[int]:
    """Return the numbers that a participant has published, or received since the last request."""
    kinds = (Kind.PUBLISHED, Kind.DELIVERED)
    return [each.number for _, records in overlay.read(member) for each in records if each.kind in kinds]


def test_frames_of_a_link_are_lost_doubled_and_delayed_as_configured(overlay: Overlay) -> None:
    until(lambda: numbers(overlay, "R"), "a message")
    overlay.links.set("s1", "s2", FrameFaults(lost=1.0))
    begun = max(numbers(overlay, "P"))
    until(lambda: max(numbers(overlay, "P"), default=0) > begun + 50, "half a second of messages")
    assert max(numbers(overlay, "R"), default=0) < begun + 20
    for faults in (FrameFaults(doubled=1.0), FrameFaults(delayed=0.5)):
        overlay.links.set("s1", "s2", faults)
        until(lambda: numbers(overlay, "R"), "a message")
    overlay.links.clear("s1", "s2")
    until(lambda: numbers(overlay, "R"), "a message")


def test_a_killed_process_is_started_again_and_a_frozen_one_goes_on(overlay: Overlay) -> None:
    assert Process.from_pid(overlay.processes["member P"].pid).alive
    overlay.kill("member P")
    assert "member P" not in overlay.processes
    overlay.start("member P")
    overlay.processes["member P"].read(READY_S)
    assert len(overlay.lives["member P"]) == 2
    until(lambda: numbers(overlay, "R"), "a message of its new life")
    overlay.freeze("member R")
    overlay.thaw("member R")
    until(lambda: numbers(overlay, "R"), "a message after the freeze")
