"""Log of a node about its neighbours and about what it waits for, with device names.

I/O; it looks at the control plane once a second and logs what changed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Final

from gdp.control.waiting import Wait, WaitLog, WaitReason
from gdp.errors import DropReason
from gdp.names import Name
from gdp.ports.plane import MAC_BYTES
from gdp.sansio import Timestamps
from gdp.state.node_state import NodeState, SwitchState
from gdp.telemetry.health import Health
from gdp.trust.audit import Action

log = logging.getLogger(__name__)


_TEXTS: Final = {
    WaitReason.LINK_DOWN: "link down on {port}",
    WaitReason.NO_NEIGHBOUR: "no neighbour on {port}: no answer there",
    WaitReason.ONE_WAY: "neighbour {name} on {port} does not hear this node, or does not trust its domain",
    WaitReason.NO_SWITCH: "no switch on {port}: its neighbours are RIBs or proxies",
    WaitReason.NO_RIB: "no RIB answers the switch: start gdp-rib",
    WaitReason.NO_UPPER_RIB: "RIB {name} above does not answer: what it gave is kept, new names of other domains are"
    " not found",
    WaitReason.REFUSED: "advertisement of {label} refused: {reason}",
    WaitReason.THROUGH_LEAF: "switch {name}, maybe others, is joined by leaves only, which carry no transit",
    WaitReason.IN_USE: "another node with this identity is attached elsewhere; this one starts when that one is gone",
}

OnWait = Callable[[str, str], None]  # reason and text


class NodeLog:
    """Log of neighbours that come and go, the RIB in use, contained errors, and what a node waits for.

    Args:
        on_wait: called for each report as well, for JSON output.
    """

    def __init__(self, state: NodeState, on_wait: OnWait | None = None) -> None:
        self.state = state
        self._on_wait = on_wait
        self._known_rib: Name | None = None
        self._known_conflict: Name | None = None
        self._known_clash: Name | None = None
        self._neighbours: set[tuple[int, Name]] = set()
        self._wait_log = WaitLog()
        self._health = Health()

    def log_changes(self, now: Timestamps) -> None:
        """Log what changed since the last call."""
        state = self.state
        for text in state.core.boundary.poll_tracebacks():
            log.error("a statement drew an error of this program and was dropped; the node goes on\n%s", text)
        self._look_at_neighbours()
        if isinstance(state, SwitchState) and (rib := state.switch.rib) != self._known_rib:
            self._known_rib = rib
            log.info("RIB in use name=%s", "none" if rib is None else rib.short)
        if (conflict := state.conflict_at) is not None and conflict != self._known_conflict:
            self._known_conflict = conflict
            log.error(
                "another node with this identity asked for its place at switch %s and was refused", conflict.short
            )
        reporter = state.hello_protocol.conflicts.clash_reporter
        if reporter is not None and reporter != self._known_clash:
            self._known_clash = reporter
            log.error("another node with this identity is alive, says switch %s; the older one stays", reporter.short)
        waits = state.waits(now.mono_s)
        self._health = Health(now.mono_s, tuple(map(self._text, waits)))
        for wait in self._wait_log.update(waits, now.mono_s):
            text = self._text(wait)
            log.log(logging.ERROR if wait.reason is WaitReason.IN_USE else logging.WARNING, "waiting: %s", text)
            if self._on_wait is not None:
                self._on_wait(wait.reason.value, text)

    def waiting_for(self, now_s: float) -> list[str]:
        """Return what the node waits for now, each as a sentence; empty if it waits for nothing."""
        return [self._text(wait) for wait in self.state.waits(now_s)]

    def health(self) -> Health:
        """Return the state as of the last look; any thread may ask."""
        return self._health

    def metrics(self) -> Mapping[str, int]:
        """Return for each reason whether the node waits for it, 1 or 0."""
        lasting = {wait.reason for wait in self._wait_log.lasting}
        return {reason.value: int(reason in lasting) for reason in WaitReason}

    def _look_at_neighbours(self) -> None:
        now = {(each.port, each.name): each for each in self.state.hello_protocol.neighbours.all_up()}
        audit = self.state.policy.audit
        for (port, name), each in now.items():
            if (port, name) not in self._neighbours:
                ifname, domain = self.state.ifname(port), self.state.domain_label(each.domain)
                log.info("neighbour up port=%s role=%s name=%s domain=%s", ifname, each.role.value, name.short, domain)
                audit.record(Action.ACCEPTED, f"neighbour {each.role.value}", who=name.to_text())
        for port, name in self._neighbours - now.keys():
            audit.record(Action.ENDED, "neighbour", who=name.to_text())
            log.info("neighbour lost port=%s name=%s", self.state.ifname(port), name.short)
        self._neighbours = set(now)

    def _text(self, wait: Wait) -> str:
        port = "?" if wait.port is None else self.state.ifname(wait.port)
        if wait.reason is WaitReason.STRANGER:
            return _refusal(port, wait)
        reason = "" if wait.refused is None else wait.refused.label
        label = "" if wait.name is None else self.state.local_name(wait.name)
        name = "?" if wait.name is None else wait.name.short
        text = _TEXTS[wait.reason]
        if wait.reason is WaitReason.LINK_DOWN and self._is_absent(wait.port):
            text = "there is no device {port}"
        elif wait.reason is WaitReason.NO_RIB and isinstance(self.state, SwitchState):
            text = "no RIB of this domain can be reached"
        return text.format(port=port, name=name, label=label or "?", reason=reason)

    def _is_absent(self, port: int | None) -> bool:
        known = None if port is None else self.state.plane.ports.get(port)
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
