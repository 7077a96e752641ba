"""Liveness of neighbours: who is silent, whether only one link to it fails, and when it counts as lost.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A neighbour is lost when it is silent for the negotiated
detection time, or earlier if another link shows that only this one fails (``link_probe.py``). Links over one uplink
fail together. Time in which this node itself was not scheduled does not count as a neighbour's silence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Final

from gdp.control.hello import NodeSettings, Timing
from gdp.control.hello_port import HelloPort
from gdp.control.keepalive import KeepaliveSession, Slowness
from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_table import NeighbourTable
from gdp.intervals import HELLO_IDLE, NEVER_S, SCHEDULED_S
from gdp.names import Name

_HELLOS_MISSED: Final = 5  # idle hello intervals after which keepalives alone keep no neighbour up
_OTHERS_MAX: Final = 4  # links that are polled because a neighbour is silent
_UPLINK_FAILS_S: Final = 0.2  # the links over an uplink that fails become silent within this time


class LivenessMonitor:
    """Liveness of the neighbours at all ports of one node.

    Args:
        neighbours: those of the hello protocol.
        is_only_way: as of ``HelloProtocol``.

    Attributes:
        is_probing: some neighbour may be lost before its detection time.
        longest_s: interval between keepalives to a neighbour, the longest one.
        lost_at_s: no neighbour is lost before; as of ``find_next``.
    """

    def __init__(
        self, neighbours: NeighbourTable, settings: NodeSettings, is_only_way: Callable[[Name], bool] | None
    ) -> None:
        self._neighbours = neighbours
        self._ports = neighbours.ports
        self._hello_s = settings.hello_s
        self._dead_s = settings.dead_s
        self._is_only_way = is_only_way
        self.uplinks: dict[int, int] = {}  # of ports whose links share one
        self._failed_s: dict[int, float] = {}  # by uplink: when a link over it failed alone
        self._polled: set[int] = set()  # ports at which a neighbour has polled us
        self._lateness_s = 0.0  # how long, in all, this node was called later than it had requested
        self._slowness = Slowness()
        self._frames_from: Callable[[int], int] = lambda _: 0
        self.is_probing = False
        self.longest_s = self.lost_at_s = 0.0

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        """Learn how to count the frames that have come from a port; frames without keepalives show a full queue."""
        self._frames_from = frames_from

    def set_uplink(self, index: int, uplink: int) -> None:
        """State which uplink carries the links of a port: ports of one uplink have an address in common."""
        self.uplinks[index] = uplink

    def probe_uplink(self, uplink: int, now_s: float, *, is_restarted: bool) -> None:
        """Poll all neighbours over an uplink; those that others outlive are lost soon.

        Args:
            is_restarted: polls that were sent before came from the former address.
        """
        for index, port in self._ports.items():
            if self.uplinks.get(index) == uplink:
                for neighbour in port.neighbours.values():
                    if neighbour.keepalives is not None and neighbour.keepalives.is_alive:
                        neighbour.keepalives.begin_probe(now_s, is_restarted=is_restarted)
                        self.is_probing = True

    def poll_polled(self) -> frozenset[int]:
        """Return, once, the ports at which a neighbour has polled us: it may have another address now."""
        polled, self._polled = frozenset(self._polled), set()
        return polled

    def note_polled(self, index: int) -> None:
        """Note that a neighbour at a port has polled us."""
        self._polled.add(index)

    def note_call(self, due_s: float, now_s: float) -> None:
        """Note when this node is called, and when it had requested that."""
        if float("-inf") < due_s < now_s - SCHEDULED_S:  # a neighbour to remove is due at once: that is no lateness
            self._lateness_s += now_s - due_s
            self._slowness.late(now_s - due_s, now_s)

    def note_late(self, late_s: float, now_s: float) -> None:
        """Note that a data plane was called so much later than it had requested."""
        if late_s:
            self._lateness_s += late_s
            self._slowness.late(late_s, now_s)

    def note_alive(self, neighbour: Neighbour, heard_s: float) -> None:
        """Note when a valid frame of a neighbour came."""
        neighbour.heard_s, neighbour.lateness_s = heard_s, self._lateness_s

    def multiplier(self, timing: Timing, now_s: float) -> int:
        """Return how many keepalives of ours may be missing, as slow as this node is at present."""
        return self._slowness.multiplier(timing, self._dead_s, now_s)

    def silent(self, port: HelloPort, now_s: float) -> list[Neighbour]:
        """Return the neighbours on a port that are lost."""
        return [each for each in port.neighbours.values() if now_s >= self.gone_at_s(each)]

    def gone_at_s(self, neighbour: Neighbour) -> float:
        """Return when a neighbour is lost if it stays silent; the node's own lateness does not count as silence."""
        if neighbour.is_let_go:  # whatever it has sent meanwhile
            return -NEVER_S
        late_s = self._lateness_s - neighbour.lateness_s
        session = neighbour.keepalives
        if session is None or not session.is_alive:
            return neighbour.heard_s + self._dead_s + late_s
        flooded_until_s = self._ports[neighbour.port].admission.flooded_until_s  # its hellos may be among those refused
        hellos_end_s = max(neighbour.greeted_s, flooded_until_s) + _HELLOS_MISSED * HELLO_IDLE * self._hello_s
        return min(session.silent_at_s(neighbour.heard_s), hellos_end_s, self._failed_at_s(neighbour, session)) + late_s

    def note_failed(self, port: HelloPort, lost: list[Neighbour], now_s: float) -> None:
        """Note that an uplink has failed, if it no longer reaches a node that another link reaches."""
        for neighbour in lost:
            session = neighbour.keepalives
            if session is None or session.probe is None or session.probe.is_moved or port.index not in self.uplinks:
                continue
            if now_s >= self._failed_at_s(neighbour, session):
                self._failed_s[self.uplinks[port.index]] = now_s

    def note_silence(self, neighbour: Neighbour, session: KeepaliveSession, now_s: float) -> None:
        """Note at a silent neighbour whether other frames come from its port, if no other way leads to it."""
        if session.is_silent(neighbour.heard_s, now_s) and self._is_needed(neighbour):
            session.note_arrivals(self._frames_from(neighbour.port), now_s)

    def request_polls(self, now_s: float) -> None:
        """Poll the links that can show that only the link of a silent neighbour fails."""
        for port in self._ports.values():
            for neighbour in port.neighbours.values() if port.is_up else ():
                session = neighbour.keepalives
                if session is None or session.suspect_at_s(neighbour.heard_s) > now_s:
                    continue
                self.is_probing = True
                since_s = now_s if session.probe is None else session.probe.since_s
                for other in islice(self._others(neighbour, of_uplink=True), _OTHERS_MAX):
                    if other.quality.confirmed_s < since_s:
                        other.is_poll_due, other.send_at_s = True, now_s

    def find_next(self) -> float:
        """Return the monotonic second of the next keepalive or loss of a neighbour; infinity: never."""
        due_s, self.is_probing, self.longest_s = NEVER_S, False, 0.0
        self.lost_at_s = NEVER_S
        for port in self._ports.values():
            for neighbour in port.neighbours.values():
                session, at_s = neighbour.keepalives, self.gone_at_s(neighbour)
                self.lost_at_s = min(self.lost_at_s, at_s)
                self.is_probing = self.is_probing or (session is not None and session.probe is not None)
                if session is not None and port.is_up and not session.is_offloaded:
                    self.longest_s = max(self.longest_s, session.out_interval_s)
                    at_s = min(at_s, session.send_at_s, session.suspect_at_s(neighbour.heard_s))
                due_s = min(due_s, at_s)
        return due_s

    def _is_needed(self, neighbour: Neighbour) -> bool:
        """Return whether a neighbour is the only one on its port, and no other way leads to it."""
        if len(self._ports[neighbour.port].neighbours) > 1:  # whose frames come is not known
            return False
        others = [each for each in self._neighbours.all_up() if each.port != neighbour.port]
        if self._is_only_way is None:
            return not others
        return all(each.name != neighbour.name for each in others) and self._is_only_way(neighbour.name)

    def _others(self, neighbour: Neighbour, *, of_uplink: bool) -> Iterator[KeepaliveSession]:
        """Return the sessions on other ports with the same neighbour, then, if asked, with others over its uplink."""
        uplink = self.uplinks.get(neighbour.port)
        ports = [each for index, each in self._ports.items() if index != neighbour.port]
        found = [port.neighbours[neighbour.name] for port in ports if neighbour.name in port.neighbours]
        if of_uplink and uplink is not None:
            on_uplink = (port for port in ports if self.uplinks.get(port.index) == uplink)
            found += (each for port in on_uplink for each in port.neighbours.values() if each.name != neighbour.name)
        return (each.keepalives for each in found if each.keepalives is not None and each.keepalives.is_alive)

    def _failed_at_s(self, neighbour: Neighbour, session: KeepaliveSession) -> float:
        """Return when a probe ends the neighbour: never unless another link has answered since it began."""
        probe = session.probe
        if probe is None:
            return NEVER_S
        for other in self._others(neighbour, of_uplink=probe.is_moved):
            probe.note_other(other.quality.confirmed_s)
        uplink = self.uplinks.get(neighbour.port)
        if not probe.is_moved and uplink is not None:
            failed_s = self._failed_s.get(uplink, float("-inf"))
            if failed_s >= probe.since_s - _UPLINK_FAILS_S:
                probe.note_other(probe.since_s)
        return probe.fails_at_s(session.quality)
