"""Log of a node about its neighbours and about what it waits for, with device names.

I/O; it polls the control plane twice a second and logs what changed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Final

from gdp.control.boundary import ErrorBoundary
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.waiting import Wait, WaitLog, WaitReason, wait_fact
from gdp.diagnosis.facts import WaitFact
from gdp.errors import DropReason
from gdp.names import Name
from gdp.ports.plane import MAC_BYTES, Plane
from gdp.sansio import Timestamps
from gdp.telemetry.health import Health
from gdp.trust.audit import Action
from gdp.trust.domain import Policy

__all__ = ["RECONCILE_PERIOD_S", "NodeLog", "OnWait", "no_name"]

log = logging.getLogger(__name__)

RECONCILE_PERIOD_S: Final = 0.5

OnWait = Callable[[str, str], None]  # reason and text


def no_name(name: Name) -> str:
    """Return the short form of a name that has no local name."""
    return name.short


class NodeLog:
    """Log of neighbours that come and go, the RIB in use, contained errors, and what a node waits for.

    Args:
        waits: returns what the node waits for at a monotonic second.
        rib: the RIB that a switch uses; None for a node that uses none itself.
        conflict: the switch that refused another node with this identity, once it is known.
        local_name: the user's word for an advertised name.
        on_wait: called for each report as well, for JSON output.
    """

    def __init__(
        self,
        hello_protocol: HelloProtocol,
        policy: Policy,
        plane: Plane,
        boundary: ErrorBoundary,
        waits: Callable[[float], list[Wait]],
        *,
        rib: Callable[[], Name | None] | None = None,
        conflict: Callable[[], Name | None] = lambda: None,
        local_name: Callable[[Name], str] = no_name,
        on_wait: OnWait | None = None,
    ) -> None:
        self._hello_protocol = hello_protocol
        self._policy = policy
        self._plane = plane
        self._boundary = boundary
        self._waits = waits
        self._rib = rib
        self._known_rib: Name | None = None
        self._conflict = conflict
        self._known_conflict: Name | None = None
        self._known_clash: Name | None = None
        self._local_name = local_name
        self._on_wait = on_wait
        self._neighbours: set[tuple[int, Name]] = set()
        self._wait_log = WaitLog()
        self._health = Health()

    def log_changes(self, now: Timestamps) -> None:
        """Log what changed since the last call."""
        for text in self._boundary.poll_tracebacks():
            log.error("a statement drew an error of this program and was dropped; the node goes on\n%s", text)
        self._look_at_neighbours()
        if self._rib is not None and (rib := self._rib()) != self._known_rib:
            self._known_rib = rib
            log.info("RIB in use name=%s", "none" if rib is None else rib.short)
        if (conflict := self._conflict()) is not None and conflict != self._known_conflict:
            self._known_conflict = conflict
            log.error(
                "another node with this identity asked for its place at switch %s and was refused", conflict.short
            )
        reporter = self._hello_protocol.conflicts.clash_reporter
        if reporter is not None and reporter != self._known_clash:
            self._known_clash = reporter
            log.error("another node with this identity is alive, says switch %s; the older one stays", reporter.short)
        waits = self._waits(now.mono_s)
        self._health = Health(now.mono_s, tuple(map(self._text, waits)))
        for wait in self._wait_log.update(waits, now.mono_s):
            text = self._text(wait)
            log.log(logging.ERROR if wait.reason is WaitReason.IN_USE else logging.WARNING, "waiting: %s", text)
            if self._on_wait is not None:
                self._on_wait(wait.reason.value, text)

    def waiting_for(self, now_s: float) -> list[str]:
        """Return what the node waits for now, each as a sentence; empty if it waits for nothing."""
        return [self._text(wait) for wait in self._waits(now_s)]

    def wait_facts(self, now_s: float) -> tuple[WaitFact, ...]:
        """Return what the node waits for now, as facts of a diagnosis."""
        waits = self._waits(now_s)
        return tuple(wait_fact(wait, "" if wait.port is None else self._ifname(wait.port)) for wait in waits)

    def health(self) -> Health:
        """Return the state as of the last look; any thread may ask."""
        return self._health

    def metrics(self) -> Mapping[str, int]:
        """Return for each reason whether the node waits for it, 1 or 0."""
        lasting = {wait.reason for wait in self._wait_log.lasting}
        return {reason.value: int(reason in lasting) for reason in WaitReason}

    def _look_at_neighbours(self) -> None:
        now = {(each.port, each.name): each for each in self._hello_protocol.neighbours.all_up()}
        for (port, name), each in now.items():
            if (port, name) not in self._neighbours:
                ifname, domain = self._ifname(port), self._domain(each.domain)
                log.info("neighbour up port=%s role=%s name=%s domain=%s", ifname, each.role.value, name.short, domain)
                self._policy.audit.record(Action.ACCEPTED, f"neighbour {each.role.value}", who=name.to_text())
        for port, name in self._neighbours - now.keys():
            self._policy.audit.record(Action.ENDED, "neighbour", who=name.to_text())
            log.info("neighbour lost port=%s name=%s", self._ifname(port), name.short)
        self._neighbours = set(now)

    def _domain(self, domain: Name) -> str:
        root = self._policy.roots.get(domain)
        return domain.short if root is None else root.label

    def _ifname(self, port: int | None) -> str:
        known = None if port is None else self._plane.ports.get(port)
        return "?" if known is None else known.ifname

    def _text(self, wait: Wait) -> str:
        ifname = self._ifname(wait.port)
        name = "?" if wait.name is None else wait.name.short
        match wait.reason:
            case WaitReason.LINK_DOWN:
                return f"there is no device {ifname}" if self._is_absent(wait.port) else f"link down on {ifname}"
            case WaitReason.NO_NEIGHBOUR:
                return f"no neighbour on {ifname}: no answer there"
            case WaitReason.STRANGER:
                return _refusal(ifname, wait)
            case WaitReason.ONE_WAY:
                return f"neighbour {name} on {ifname} does not hear this node, or does not trust its domain"
            case WaitReason.NO_SWITCH:
                return f"no switch on {ifname}: its neighbours are RIBs or proxies"
            case WaitReason.NO_RIB:
                return (
                    "no RIB of this domain can be reached"
                    if self._rib is not None
                    else "no RIB answers the switch: start gdp-rib"
                )
            case WaitReason.NO_UPPER_RIB:
                return (
                    f"RIB {name} above does not answer: what it gave is kept, new names of other domains are not found"
                )
            case WaitReason.REFUSED:
                reason = "" if wait.refused is None else wait.refused.label
                return f"advertisement of {'?' if wait.name is None else self._local_name(wait.name)} refused: {reason}"
            case WaitReason.THROUGH_LEAF:
                return f"switch {name}, maybe others, is joined by leaves only, which carry no transit"
            case WaitReason.IN_USE:
                return "another node with this identity is attached elsewhere; this one starts when that one is gone"

    def _is_absent(self, port: int | None) -> bool:
        known = None if port is None else self._plane.ports.get(port)
        return known is not None and known.mac == bytes(MAC_BYTES)


def _refusal(ifname: str, wait: Wait) -> str:
    of = f"neighbour on {ifname} of domain {wait.domain or '?'}"
    if wait.refused is DropReason.WRONG_DOMAIN:
        return f"{of}, which is not trusted here (domain.trusts)"
    if wait.refused is DropReason.THROUGH_LEAF:
        return f"{of}: a leaf joins switches of its own domain only"
    if wait.refused is DropReason.EXPIRED:
        return f"{of}: its certificate is not valid now; has it expired, or is a clock wrong?"
    return f"{of} refused: {'' if wait.refused is None else wait.refused.label}"
