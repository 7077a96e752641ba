"""Faults of a run, as a person writes them: links cut, proxies that roam, processes killed; and what is refused.

Sans-I/O. All seconds count from the time at which the first message may be sent. An unknown switch, RIB or proxy raises
``LocalError``. A killed process is ``rib school``, by its domain or its switch, or ``switch nuc3``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Final

from gdp.errors import LocalError
from lab.faults import Fault, FaultKind, broken_by, moments
from lab.topology import Attachment, Topology

CUT, ROAM = FaultKind.CUT, FaultKind.ROAM
_KILLS: Final = {"rib": FaultKind.KILL_RIB, "switch": FaultKind.KILL_SWITCH}
_SECONDS: Final = r"(\d+(?:\.\d+)?)"
_SPAN: Final = rf"@{_SECONDS}(?:-{_SECONDS})?\Z"
_WRITTEN: Final = {  # by option
    "cut": (rf"([^@]+?)-([^@-]+){_SPAN}", "a cut is written like nuc2-nuc3@5, or nuc2-nuc3@5-20 (link, seconds)"),
    "roam": (rf"([^@:]+):([^@:]+)@{_SECONDS}\Z", "roaming is written like robot:nuc3@10 (proxy, new switch, seconds)"),
    "kill": (
        rf"({'|'.join(_KILLS)}):([^@:]+){_SPAN}",
        "a kill is written like rib:school@8, switch:nuc3@10 or switch:nuc3@10-20 (domain of the RIB or name of the"
        " switch, seconds)",
    ),
}


def fault_from_text(option: str, text: str) -> Fault:
    """Parse the value of an option: ``cut``, ``roam`` or ``kill``.

    Raises ``LocalError``: it is written otherwise, or what is hit comes back before it goes.
    """
    pattern, written = _WRITTEN[option]
    found = re.match(pattern, text)
    if found is None:
        raise LocalError(f"{written}, not {text!r}")
    one, other, start_s = found[1], found[2], float(found[3])
    if option == "roam":
        return Fault(ROAM, (one, other), start_s, start_s)
    end_s = float(found[4] or math.inf)
    if end_s <= start_s:
        raise LocalError(f"{text}: it comes back before it goes")
    return (
        Fault(CUT, (one, other), start_s, end_s)
        if option == "cut"
        else Fault(_KILLS[one], (f"{one} {other}",), start_s, end_s)
    )


def text_of(fault: Fault) -> str:
    """Return a fault as it is written."""
    what = "-".join(fault.targets) if fault.kind is CUT else ":".join(fault.targets).replace(" ", ":")
    return f"{what}@{fault.start_s:g}" + (f"-{fault.end_s:g}" if fault.start_s < fault.end_s < math.inf else "")


def victims(kill: Fault, topology: Topology) -> tuple[str, ...]:
    """Return the switches at which a process is killed."""
    _, _, of = kill.targets[0].partition(" ")
    if kill.kind is FaultKind.KILL_SWITCH:
        topology.domain_of(of)
        return (of,)
    domains = {at.switch: topology.domain_of(at.switch).label for at in topology.attached("rib")}
    found = tuple(switch for switch, label in domains.items() if of in (switch, label))
    if not found:
        raise LocalError(f"no RIB {of}; there are those of {', '.join(dict.fromkeys(domains.values()))}")
    return found


def roamers(faults: Iterable[Fault], topology: Topology) -> dict[str, Attachment]:
    """Return the proxies that roam, by their devices."""
    known = {at.ifname: at for at in topology.attached("proxy")}
    names = dict.fromkeys(fault.targets[0] for fault in faults if fault.kind is ROAM)
    for name in names - known.keys():
        raise LocalError(f"no proxy {name}; there are {', '.join(known)}")
    return {name: known[name] for name in names}


def check_faults(topology: Topology, faults: Sequence[Fault], duration_s: float | None) -> None:
    """Refuse impossible faults, and faults that separate both proxies permanently.

    Args:
        duration_s: of the traffic; None: unknown in advance.

    Raises:
        LocalError: an unknown link, process or proxy; two simultaneous faults of one component; one that comes after
            the traffic; no path between the proxies after the last fault.
    """
    roamers(faults, topology)
    for fault in faults:
        if fault.kind is CUT:
            topology.link(*fault.targets)
        elif fault.kind is ROAM:
            topology.domain_of(fault.targets[1])
        else:
            victims(fault, topology)
        last_s = fault.start_s if fault.end_s == math.inf else fault.end_s
        if duration_s is not None and last_s >= duration_s:
            raise LocalError(f"{text_of(fault)} comes too late: the traffic lasts {duration_s:g} s (--seconds)")
    _refuse_overlaps([fault for fault in faults if fault.kind is not ROAM])
    if faults:
        _refuse_parting(topology, faults)


def _refuse_overlaps(faults: Sequence[Fault]) -> None:
    for index, one in enumerate(faults):
        for other in faults[index + 1 :]:
            first, second = sorted((one, other), key=lambda each: each.start_s)
            if set(one.targets) == set(other.targets) and second.start_s <= first.end_s:
                raise LocalError(f"{text_of(second)} comes before {text_of(first)} is over")


def _refuse_parting(topology: Topology, faults: Sequence[Fault]) -> None:
    at = {each.ifname: each.switch for each in topology.attached("proxy")}
    events = moments(faults)
    for _, fault, begins in events:
        if fault.kind is ROAM and begins:
            who, to = fault.targets
            if at[who] == to:
                raise LocalError(f"{text_of(fault)}: {who} is at {to} already")
            at[who] = to
    broken = broken_by([fault for fault in faults if fault.end_s == math.inf], at)
    for who, switch in at.items():
        if switch in broken.switches:
            raise LocalError(
                f"with switch {switch} dead, {who} has no switch: let it roam before, or let the switch come back"
                f" (switch:{switch}@10-20)"
            )
    (one, here), (other, there) = at.items()
    if there not in topology.reached(here, down=broken.links, dead=broken.switches):
        raise LocalError(
            f"after {text_of(events[-1][1])} no way is left from {one} at {here} to {other} at {there}: let something"
            " come back (nuc2-nuc3@5-20)"
        )
