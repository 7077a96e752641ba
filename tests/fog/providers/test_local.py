"""Parts of the provider ``local`` that need no namespace."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from fog.hardware import Hardware, Offer
from fog.host.preemption_notice import write_notice
from fog.host.status import Status
from fog.machine import MachineBundle, MachineSpec, MachineState
from fog.providers.local import fault_injection
from fog.providers.local.delay import DelayLine
from fog.providers.local.machine_file import MachineFile
from fog.providers.local.machine_handle import find, list_machines
from fog.providers.local.provider import LocalProvider
from fog.topology import Gateway
from gdp.errors import LocalError
from gdp.host.processes import Process
from gdp.host.run_registry import Run

SPEC = MachineSpec(
    "c", "m1", Offer("local", "local-a", "local.small", Hardware(2, 4.0), is_spot=True, usd_per_hour=0.01)
)
_MS = 1_000_000


@pytest.fixture
def provider(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LocalProvider:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return LocalProvider(
        tmp_path / "local", lambda _, __: MachineBundle({}, ()), Gateway(gateway="a", regions=("moon-1",))
    )


def machine(provider: LocalProvider, process: Process | None = None) -> Run:
    """Record a machine whose process is this one (or a dead one), without creating any."""
    run = provider.runs.start()
    MachineFile(SPEC, 1.0, "/run/netns/none").write(run.directory)
    (run.directory / "home").mkdir()
    run.record.processes.append(process or Process(os.getpid(), 1))
    run.retain()
    return run


def state(provider: LocalProvider) -> tuple[MachineState, str]:
    (found,) = provider.describe("c")
    return found.state, found.reason


def us() -> Process:
    return Process.from_pid(os.getpid())


def test_what_is_known_of_a_machine_is_read_back(tmp_path: Path) -> None:
    file = MachineFile(SPEC, 12.5, "/run/netns/gate", is_bounded=True, gone_unix_s=3.0)
    file.write(tmp_path)
    assert MachineFile.read(tmp_path) == file


@pytest.mark.parametrize("content", ["", "[]", '{"spec": 1}', '{"spec": {"offer": {"hardware": {"x": 1}}}}'])
def test_another_file_is_no_machine(tmp_path: Path, content: str) -> None:
    (tmp_path / "machine.json").write_text(content)
    assert MachineFile.read(tmp_path) is None


def test_a_machine_is_booting_until_it_says_otherwise(provider: LocalProvider) -> None:
    run = machine(provider, us())
    assert state(provider) == (MachineState.BOOTING, "")
    Status(MachineState.RUNNING, 1.0).write(run.directory / "home")
    assert state(provider) == (MachineState.RUNNING, "")


def test_a_machine_with_a_notice_is_leaving(provider: LocalProvider) -> None:
    run = machine(provider, us())
    write_notice(run.directory / "home", time.time() + 1_000)
    assert state(provider) == (MachineState.LEAVING, "preempted")


@pytest.mark.parametrize(("said", "reason"), [("drained", "drained"), ("", "killed")])
def test_a_machine_that_ended_is_reported_with_its_reason(provider: LocalProvider, said: str, reason: str) -> None:
    run = machine(provider)
    if said:
        Status(MachineState.GONE, 1.0, reason=said).write(run.directory / "home")
    assert state(provider) == (MachineState.GONE, reason)


def test_a_preempted_machine_is_reported_as_such(provider: LocalProvider) -> None:
    run = machine(provider)
    write_notice(run.directory / "home", 1.0)
    assert state(provider) == (MachineState.GONE, "preempted")


def test_a_machine_long_gone_is_forgotten(provider: LocalProvider, tmp_path: Path) -> None:
    run = machine(provider)
    assert len(provider.describe("c")) == 1
    MachineFile(SPEC, 1.0, "/run/netns/none", gone_unix_s=1.0).write(run.directory)
    assert provider.describe("c") == []
    assert [path.name for path in tmp_path.rglob("*")] == ["local", ".lock"]


def test_another_clusters_machines_are_not_reported(provider: LocalProvider) -> None:
    machine(provider)
    assert provider.describe("d") == []


def test_a_machine_is_found_by_its_name_where_only_one_has_it(provider: LocalProvider) -> None:
    first = machine(provider)
    assert find(provider.runs, "m1").id == first.id
    second = machine(provider)
    assert find(provider.runs, second.id).id == second.id
    with pytest.raises(LocalError, match=r"no local machine m1; there are: .*c/m1"):
        find(provider.runs, "m1")


def test_nothing_befalls_a_machine_that_does_not_run(provider: LocalProvider) -> None:
    run = machine(provider)
    with pytest.raises(LocalError, match="does not run"):
        fault_injection.notice(provider.runs, run.id, 1.0)


def test_what_is_gone_already_may_be_given_back(provider: LocalProvider) -> None:
    provider.terminate(["123456"])
    run = machine(provider)
    provider.terminate([run.id, run.id])
    assert list_machines(provider.runs) == []


def test_every_region_is_pretended_the_cheapest_first(provider: LocalProvider) -> None:
    offers = provider.offers(Hardware(8, gpu="T4", gpus=1), spot=True)
    assert {offer.region for offer in offers} == {"local-a", "local-b", "local-c", "local-d", "moon-1"}
    assert all(offer.is_spot and offer.hardware.gpu == "T4" for offer in offers)
    assert offers == sorted(offers, key=lambda offer: offer.usd_per_hour)


@pytest.mark.parametrize("name", ["", "a/b", "../a", "-a"])
def test_a_machine_needs_a_name_that_a_file_can_have(provider: LocalProvider, name: str) -> None:
    with pytest.raises(LocalError, match="a name has letters"):
        provider.create(MachineSpec("c", name, SPEC.offer), MachineBundle({}, ()))


def test_only_the_logs_of_programs_are_shown(provider: LocalProvider) -> None:
    run = machine(provider)
    with pytest.raises(LocalError, match="no program"):
        provider.log(run.id, "../../machine.json", 10)
    assert provider.log(run.id, "proxy", 10) == ""


def test_a_frame_is_due_after_the_delay_at_the_other_side() -> None:
    line = DelayLine(5 * _MS)
    line.put(10 * _MS, 0, b"a")
    line.put(12 * _MS, 1, b"b")
    assert line.pause_s(11 * _MS) == pytest.approx(0.004)
    assert line.poll_frames(15 * _MS - 1) == []
    assert line.poll_frames(15 * _MS) == [(1, b"a")]
    assert line.poll_frames(99 * _MS) == [(0, b"b")]
    assert line.pause_s(99 * _MS) is None


def test_frames_beyond_the_capacity_of_a_delay_are_dropped_and_counted() -> None:
    line = DelayLine(_MS, most_bytes=3)
    line.put(0, 0, b"aa")
    line.put(0, 0, b"bb")
    assert line.dropped == 1
    line.poll_frames(_MS)
    line.put(0, 0, b"bbb")
    assert line.dropped == 1
