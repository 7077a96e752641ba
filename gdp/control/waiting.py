"""Wait reasons: what a node that makes no progress waits for.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``port_waits`` and a node's own rules (such as
``attachment_waits`` in ``gdp/client/attachment.py``) return the present waits; ``WaitLog`` decides when to report them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from gdp.control.hello_port import HelloPort
from gdp.control.neighbour import NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.certificates import Role
from gdp.errors import DropReason
from gdp.intervals import REPORT_S
from gdp.names import Name

if TYPE_CHECKING:
    from gdp.diagnosis.facts import WaitFact

_SETTLE_S: Final = 1.0  # a change of the reason is reported after it has lasted this long
_STRANGER_S: Final = 2.0  # a refused neighbour that was silent for longer is gone


class WaitReason(Enum):
    """Reason why a node makes no progress; the value is the label of the metric ``gdp_waiting``."""

    LINK_DOWN = "link-down"
    NO_NEIGHBOUR = "no-neighbour"
    STRANGER = "neighbour-refused"  # its certificate is not accepted here
    ONE_WAY = "not-heard"  # a neighbour whose hellos we receive does not receive ours, or refuses us
    NO_SWITCH = "no-switch"  # neighbours, but none is a switch
    NO_RIB = "no-rib"
    NO_UPPER_RIB = "no-upper-rib"  # no RIB of the tier above responds to this one
    REFUSED = "advertisement-refused"
    IN_USE = "identity-in-use"
    THROUGH_LEAF = "through-leaf"  # switches of the domain that only a leaf connects to this one


@dataclass(frozen=True, slots=True)
class Wait:
    """One thing that a node waits for.

    Args:
        port: index of the port concerned, if any.
        domain: label of a stranger's domain; unproven, maybe empty.
        name: of the neighbour or the last one there, of the refused advertisement, of one switch that is cut off, or of
            the RIB above.
        refused: why a hello or an advertisement was refused.
    """

    reason: WaitReason
    port: int | None = None
    domain: str = ""
    name: Name | None = None
    refused: DropReason | None = None

    @property
    def subject(self) -> tuple[object, ...]:
        """Return what has one reason at a time: a port, a stranger's domain, an advertisement, or the node."""
        if self.reason is WaitReason.STRANGER:
            return "stranger", self.port, self.domain
        if self.reason is WaitReason.REFUSED:
            return "advertisement", self.name
        if self.reason is WaitReason.NO_UPPER_RIB:
            return "tier above", None
        if self.reason is WaitReason.THROUGH_LEAF:
            return "leaf", None
        return "port", self.port


def port_waits(port: HelloPort, wanted: Collection[Role]) -> Iterator[Wait]:
    """Yield the reasons why a port has no neighbour of a wanted role; nothing if it has one."""
    if not port.is_up:
        yield Wait(WaitReason.LINK_DOWN, port.index)
        return
    neighbours = list(port.neighbours.values())
    if any(each.state is NeighbourState.UP and each.role in wanted for each in neighbours):
        return
    deaf = next((each for each in neighbours if each.state is not NeighbourState.UP and each.role in wanted), None)
    if any(each.refuses_us for each in neighbours):
        yield Wait(WaitReason.IN_USE, port.index)
    elif deaf is not None:
        yield Wait(WaitReason.ONE_WAY, port.index, name=deaf.name)
    elif neighbours:
        yield Wait(WaitReason.NO_SWITCH, port.index)
    else:
        yield Wait(WaitReason.NO_NEIGHBOUR, port.index, name=next(reversed(port.qualities), None))


def stranger_waits(hello_protocol: HelloProtocol, now_s: float) -> Iterator[Wait]:
    """Yield the neighbours that are refused at present, one for each port, domain and reason."""
    for port in hello_protocol.ports.values():
        for each in port.strangers.since(now_s - _STRANGER_S):
            yield Wait(WaitReason.STRANGER, port.index, each.domain, refused=each.reason)


def wait_fact(wait: Wait, device: str) -> WaitFact:
    """Return a wait as a fact of a diagnosis; ``device``: of its port, empty without one."""
    from gdp.diagnosis.facts import WaitFact  # a node gathers facts for who asks

    refused = "" if wait.refused is None else wait.refused.label
    neighbour = "" if wait.port is None or wait.name is None else wait.name.to_text()
    return WaitFact(reason=wait.reason.value, device=device, domain=wait.domain, neighbour=neighbour, refused=refused)


@dataclass(slots=True)
class _Subject:
    wait: Wait
    since_s: float  # no progress since
    changed_s: float  # the present reason holds since
    reported: Wait | None = None


class WaitLog:
    """Choice of the waits to report: each lasting one, once, and again when it changes.

    Args:
        after_s: how long a node may make no progress before that is reported.
    """

    def __init__(self, after_s: float = REPORT_S) -> None:
        self._after_s = after_s
        self._subjects: dict[tuple[object, ...], _Subject] = {}

    @property
    def lasting(self) -> list[Wait]:
        """Return the waits that have been reported and still hold."""
        return [each.wait for each in self._subjects.values() if each.reported == each.wait]

    def update(self, waits: Sequence[Wait], now_s: float) -> list[Wait]:
        """Update the present waits; return those to report."""
        current = {wait.subject: wait for wait in waits}
        for subject in self._subjects.keys() - current.keys():
            del self._subjects[subject]
        due = []
        for subject, wait in current.items():
            known = self._subjects.get(subject)
            if known is None:
                known = self._subjects[subject] = _Subject(wait, now_s, now_s)
            elif known.wait != wait:
                known.wait, known.changed_s = wait, now_s
            has_lasted = now_s >= known.since_s + self._after_s
            is_settled = known.reported is None or now_s >= known.changed_s + _SETTLE_S
            if known.reported != wait and has_lasted and is_settled:
                known.reported = wait
                due.append(wait)
        return due
