"""Faults of a run, as data: links cut, proxies that roam, processes killed; and the check that a path remains.

Sans-I/O. All seconds count from the time at which the first message may be sent. An unknown switch, RIB or proxy raises
``LocalError``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, cast, get_args

from gdp.errors import LocalError
from lab.topology import Attachment, Topology

KillRole = Literal["rib", "switch"]

_SECONDS: Final = r"\d+(?:\.\d+)?"
_WHEN: Final = rf"@({_SECONDS})(?:-({_SECONDS}))?\Z"
_CUT: Final = re.compile(rf"([^@]+?)-([^@-]+){_WHEN}")
_KILL: Final = re.compile(rf"({'|'.join(get_args(KillRole))}):([^@:]+){_WHEN}")
_ROAM: Final = re.compile(rf"([^@:]+):([^@:]+)@({_SECONDS})\Z")


@dataclass(frozen=True, slots=True)
class Cut:
    """A link that goes down after ``after_s`` and, unless ``until_s`` is None, comes up again."""

    a: str
    b: str
    after_s: float
    until_s: float | None = None

    @classmethod
    def from_text(cls, text: str) -> Cut:
        """Parse ``nuc2-nuc3@5`` or ``nuc2-nuc3@5-20``.

        Raises ``LocalError``: anything else, or a link that comes up before it goes down.
        """
        found = _CUT.match(text)
        if found is None:
            raise LocalError(
                f"a cut is written like nuc2-nuc3@5, or nuc2-nuc3@5-20 (link, seconds after the start), not {text!r}"
            )
        return cls(found[1], found[2], *_when(text, found[3], found[4]))

    @property
    def target(self) -> frozenset[str]:
        """Return the affected components, for comparison with other faults."""
        return frozenset((self.a, self.b))

    def __str__(self) -> str:
        return f"{self.a}-{self.b}@{_span(self.after_s, self.until_s)}"


@dataclass(frozen=True, slots=True)
class Kill:
    """A process killed with SIGKILL after ``after_s`` and, unless ``until_s`` is None, restarted.

    ``of``: a switch; for a RIB its domain, or the switch to which it is attached.
    """

    role: KillRole
    of: str
    after_s: float
    until_s: float | None = None

    @classmethod
    def from_text(cls, text: str) -> Kill:
        """Parse ``rib:school@8``, ``switch:nuc3@10`` or ``switch:nuc3@10-20``.

        Raises ``LocalError``: anything else, or a process that restarts before it is killed.
        """
        found = _KILL.match(text)
        if found is None:
            raise LocalError(
                "a kill is written like rib:school@8, switch:nuc3@10 or switch:nuc3@10-20 (domain of the RIB or name"
                f" of the switch, seconds after the start), not {text!r}"
            )
        return cls(cast("KillRole", found[1]), found[2], *_when(text, found[3], found[4]))

    @property
    def target(self) -> frozenset[str]:
        """Return the affected components, for comparison with other faults."""
        return frozenset((f"{self.role}:{self.of}",))

    def victims(self, topology: Topology) -> tuple[str, ...]:
        """Return the switches at which a process of this role is killed."""
        if self.role == "switch":
            topology.domain_of(self.of)
            return (self.of,)
        ribs = topology.attached("rib")
        found = tuple(at.switch for at in ribs if self.of in (at.switch, topology.domain_of(at.switch).label))
        if not found:
            known = ", ".join(dict.fromkeys(topology.domain_of(at.switch).label for at in ribs))
            raise LocalError(f"no RIB {self.of}; there are those of {known}")
        return found

    def __str__(self) -> str:
        return f"{self.role}:{self.of}@{_span(self.after_s, self.until_s)}"


@dataclass(frozen=True, slots=True)
class Roam:
    """A proxy whose cable moves to another switch after ``after_s``; ``who``: the proxy's device, such as ``robot``."""

    who: str
    to: str
    after_s: float

    @classmethod
    def from_text(cls, text: str) -> Roam:
        """Parse ``robot:nuc3@10``. Raises ``LocalError``: anything else."""
        found = _ROAM.match(text)
        if found is None:
            raise LocalError(f"roaming is written like robot:nuc3@10 (proxy, new switch, seconds), not {text!r}")
        return cls(found[1], found[2], float(found[3]))

    def proxy(self, topology: Topology) -> Attachment:
        """Return the proxy that roams."""
        proxies = topology.attached("proxy")
        for at in proxies:
            if at.ifname == self.who:
                return at
        raise LocalError(f"no proxy {self.who}; there are {', '.join(at.ifname for at in proxies)}")

    def __str__(self) -> str:
        return f"{self.who}:{self.to}@{self.after_s:g}"


Fault: TypeAlias = "Cut | Kill | Roam"


def roamers(faults: Iterable[Fault], topology: Topology) -> tuple[Attachment, ...]:
    """Return the proxies that roam, each once."""
    return tuple(dict.fromkeys(fault.proxy(topology) for fault in faults if isinstance(fault, Roam)))


def check_faults(topology: Topology, faults: Sequence[Fault], duration_s: float | None) -> None:
    """Refuse impossible faults, and faults that separate both proxies permanently.

    Args:
        duration_s: of the traffic; None: unknown in advance.

    Raises:
        LocalError: an unknown link, process or proxy; two simultaneous faults of one component; one that comes after
            the traffic; no path between the proxies after the last fault.
    """
    for fault in faults:
        if isinstance(fault, Cut):
            topology.link(fault.a, fault.b)
        elif isinstance(fault, Kill):
            fault.victims(topology)
        else:
            fault.proxy(topology)
            topology.domain_of(fault.to)
        last_s = fault.after_s if isinstance(fault, Roam) or fault.until_s is None else fault.until_s
        if duration_s is not None and last_s >= duration_s:
            raise LocalError(f"{fault} comes too late: the traffic lasts {duration_s:g} s (--seconds)")
    _refuse_overlaps([fault for fault in faults if not isinstance(fault, Roam)])
    _refuse_parting(topology, faults)


def _refuse_overlaps(faults: Sequence[Cut | Kill]) -> None:
    for index, one in enumerate(faults):
        for other in faults[index + 1 :]:
            first, second = sorted((one, other), key=lambda each: each.after_s)
            if one.target == other.target and (first.until_s is None or second.after_s <= first.until_s):
                raise LocalError(f"{second} comes before {first} is over")


def _refuse_parting(topology: Topology, faults: Sequence[Fault]) -> None:
    places = {at.ifname: at.switch for at in topology.attached("proxy")}
    down: set[frozenset[str]] = set()
    dead: set[str] = set()
    newest: Fault | None = None
    for _, fault, begins in moments(faults):
        if isinstance(fault, Roam):
            if places[fault.who] == fault.to:
                raise LocalError(f"{fault}: {fault.who} is at {fault.to} already")
            places[fault.who] = fault.to
        elif isinstance(fault, Cut):
            (down.add if begins else down.discard)(fault.target)
        elif fault.role == "switch":
            (dead.add if begins else dead.discard)(fault.of)
        newest = fault
    if newest is None:
        return
    for who, at in places.items():
        if at in dead:
            raise LocalError(
                f"with switch {at} dead, {who} has no switch: let it roam before, or let the switch come back"
                f" (switch:{at}@10-20)"
            )
    (one, here), (other, there) = places.items()
    if there not in topology.reached(here, down=down, dead=dead):
        raise LocalError(
            f"after {newest} no way is left from {one} at {here} to {other} at {there}: let something come back"
            " (nuc2-nuc3@5-20)"
        )


def moments(faults: Iterable[Fault]) -> list[tuple[float, Fault, bool]]:
    """Return the fault events in order of time, as (seconds, fault, whether it begins)."""
    found = [(fault.after_s, fault, True) for fault in faults]
    found += [
        (fault.until_s, fault, False) for fault in faults if not isinstance(fault, Roam) and fault.until_s is not None
    ]
    return sorted(found, key=lambda each: each[0])


def _when(text: str, after: str, until: str | None) -> tuple[float, float | None]:
    after_s, until_s = float(after), None if until is None else float(until)
    if until_s is not None and until_s <= after_s:
        raise LocalError(f"{text}: it comes back before it goes")
    return after_s, until_s


def _span(after_s: float, until_s: float | None) -> str:
    return f"{after_s:g}" if until_s is None else f"{after_s:g}-{until_s:g}"
