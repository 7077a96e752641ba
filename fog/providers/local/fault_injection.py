"""Fault injection on local machines: preemption notice, kill, freeze, slow processor, delayed link, and no capacity.

I/O; for tests, demonstrations and experiments. Functions about a machine take the site's records and its id or unique
name, and raise ``LocalError`` if there is no such machine.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from fog.host.preemption_notice import write_notice
from fog.host.status import Status
from fog.providers.local.machine_handle import LocalMachine, find
from fog.providers.local.netlinks import delete, exists, join_within, plug
from fog.providers.local.spawn import spawn_detached
from gdp.errors import LocalError
from gdp.host.processes import end_all
from gdp.host.run_registry import RunRegistry

_SOLD_OUT: Final = "spot-sold-out"


def notice(runs: RunRegistry, machine: str, seconds: float) -> None:
    """Give notice of a preemption; the machine is killed after ``seconds`` in any case."""
    found = _alive(runs, machine)
    write_notice(found.home, time.time() + seconds)
    _signal(found, signal.SIGUSR2)


def kill(runs: RunRegistry, machine: str) -> None:
    """Kill all processes of the machine at once and disconnect it, like a power failure."""
    found = find(runs, machine)
    groups = list(_groups(found))
    if found.is_alive and found.file.gone_unix_s is None:
        # a later reader can compute the detection time
        replace(found.file, gone_unix_s=time.time()).write(found.directory)
    found.cgroup.kill()
    for group in groups:
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)
    for device in (found.gateway_device, found.uplink_plug):
        delete(found.gateway, device)


def freeze(runs: RunRegistry, machine: str) -> None:
    """Stop all processes of the machine; its link remains up."""
    hold(_alive(runs, machine), held=True)


def thaw(runs: RunRegistry, machine: str) -> None:
    """Continue a frozen machine."""
    hold(_alive(runs, machine), held=False)


def slow(runs: RunRegistry, machine: str, share: float | None) -> None:
    """Limit the machine to this share of one processor, such as 0.1; None: the limit of its hardware.

    Raises:
        LocalError: cgroups are not available, or the share is not positive.
    """
    found = _alive(runs, machine)
    if share is not None and share <= 0:
        raise LocalError(f"share {share:g}: expected more than 0")
    found.cgroup.limit_cpu(share if share is not None else found.file.spec.offer.hardware.cpus or None)


def delay(runs: RunRegistry, machine: str, ms: float) -> None:
    """Delay every frame on the machine's link by ``ms`` in each direction; 0: no delay.

    Raises:
        LocalError: the time is negative, or the kernel refuses.
    """
    if ms < 0:
        raise LocalError(f"delay {ms:g} ms: expected none or more")
    found = _alive(runs, machine)
    run = runs.resume(found.id)
    before = found.record.processes[1:]
    if ms:
        if not exists(found.gateway, found.relay_out):
            join_within(found.gateway, found.relay_out, found.relay_in)
        argv = ["fog.providers.local.delay", found.gateway_device, found.relay_out, f"{ms:g}"]
        spawn_detached(run, found.gateway, argv, found.directory / "delay.log", is_heard=True)
        plug(found.gateway, found.gateway_device, into=False)
        plug(found.gateway, found.relay_in)
    else:
        delete(found.gateway, found.relay_out)
        plug(found.gateway, found.gateway_device)
    end_all(before)


def sell_out(directory: Path) -> None:
    """Let the provider of this folder of records have no further spot machine."""
    directory.mkdir(parents=True, mode=0o700, exist_ok=True)
    (directory / _SOLD_OUT).touch()


def restock(directory: Path) -> None:
    """Let the provider of this folder of records have spot machines again."""
    (directory / _SOLD_OUT).unlink(missing_ok=True)


def is_sold_out(directory: Path) -> bool:
    """Return whether the provider of this folder of records has no spot machine now."""
    return (directory / _SOLD_OUT).exists()


def hold(machine: LocalMachine, *, held: bool) -> None:
    """Stop all processes of a machine, or continue them; no effect if it has none."""
    if machine.cgroup.set_frozen(held=held):
        return
    for group in _groups(machine):  # without cgroups; child processes in their own session continue
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGSTOP if held else signal.SIGCONT)


def _alive(runs: RunRegistry, machine: str) -> LocalMachine:
    found = find(runs, machine)
    if found.host is None or not found.host.alive:
        raise LocalError(f"machine {machine} does not run")
    return found


def _groups(machine: LocalMachine) -> Iterator[int]:
    """Yield the process groups: the machine's own and each program's."""
    if machine.host is None or not machine.host.alive:
        return
    status = Status.read(machine.home)
    yield machine.host.pid
    for program in status.programs.values() if status is not None else ():
        if program.pid is not None:
            yield program.pid


def _signal(machine: LocalMachine, number: signal.Signals) -> None:
    if machine.host is not None and machine.host.alive:
        with suppress(ProcessLookupError):
            os.kill(machine.host.pid, number)
