"""Fault of a network, as data: its kind, what it hits and when; and what does not work while some are active.

Sans-I/O. Seconds count from the start of the run, or of its traffic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from lab.topology import ends_of

STORE: Final = "the store"  # what RIBs share, as a target


class FaultKind(Enum):
    """Kind of a fault."""

    CUT = "link cut"
    SILENT = "link silent"
    LOSS = "5 % loss"
    DOUBLED = "frames doubled"
    REORDERED = "frames reordered"
    KILL_SWITCH = "switch killed"
    KILL_RIB = "RIB killed"
    KILL_MEMBER = "member killed"
    FREEZE = "process frozen"
    CLOCK = "clock stepped"
    REVOKE = "membership revoked"
    PARTITION = "partition"
    ROAM = "member moved"
    DISK_FULL = "disk full"
    KILL_PRIMARY = "primary killed"
    KILL_REPLICA = "replica killed"
    FREEZE_PRIMARY = "primary frozen"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: ``targets`` are a process (``switch s1``), the two ends of a link, or a mover and its new switch.

    ``end_s``: infinite where it lasts; a fault without an end of its own ends at its start. ``amount``: seconds of a
    clock step; the index of the server of the store, among those of the role.
    """

    kind: FaultKind
    targets: tuple[str, ...]
    start_s: float
    end_s: float = math.inf
    amount: float = 0.0

    def __str__(self) -> str:
        amount = f" {self.amount:+g} s" if self.kind is FaultKind.CLOCK else ""
        return f"{self.start_s:7.2f}-{self.end_s:7.2f} s  {self.kind.value}{amount}: {', '.join(self.targets)}"


def links_of(fault: Fault) -> list[tuple[str, str]]:
    """Return the links that lose their carrier, by their ends."""
    if fault.kind is FaultKind.CUT:
        return [(fault.targets[0], fault.targets[1])]
    return [ends_of(each) for each in fault.targets[1:]] if fault.kind is FaultKind.PARTITION else []


def moments(faults: Iterable[Fault]) -> list[tuple[float, Fault, bool]]:
    """Return the fault events in order of time, as (seconds, fault, whether it begins)."""
    begins = [(fault.start_s, fault, True) for fault in faults]
    ends = [(fault.end_s, fault, False) for _, fault, _ in begins if fault.end_s < math.inf]
    return sorted([*begins, *ends], key=lambda each: (each[0], not each[2]))


@dataclass(slots=True)
class Broken:
    """State of the faults: switches, links (both ends) and members that do not work; locations of moved members."""

    switches: set[str] = field(default_factory=set)
    links: set[frozenset[str]] = field(default_factory=set)
    members: set[str] = field(default_factory=set)
    at: dict[str, str] = field(default_factory=dict)


def broken_by(faults: Iterable[Fault], at: dict[str, str]) -> Broken:
    """Return what does not work while these faults are active."""
    broken = Broken(at=dict(at))
    for fault in faults:
        broken.links |= {frozenset(ends) for ends in links_of(fault)}
        if fault.kind is FaultKind.SILENT:
            broken.links.add(frozenset(fault.targets))
        elif fault.kind in (FaultKind.KILL_SWITCH, FaultKind.KILL_MEMBER, FaultKind.FREEZE):
            role, _, node = fault.targets[0].partition(" ")
            if role == "member":
                broken.members.add(node)
            elif role == "switch":
                broken.switches.add(node)
        elif fault.kind is FaultKind.REVOKE:
            broken.members.add(fault.targets[0])
    return broken
