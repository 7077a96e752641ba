"""Offload of keepalive sessions: which of a node's sessions a data plane may run, and what it did in them.

Sans-I/O; time comes in as ``Timestamps``. A session is offered while its keepalives bring no news. A data plane that
runs it sends and receives alone, as a device does for BFD (RFC 5880). It hands the session back with the first
keepalive that brings news, or when the neighbour is silent; polls and loss are for the node to decide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from gdp.control.hello import Timing
from gdp.control.hello_port import HelloPort
from gdp.control.keepalive import EARLY, SUSPECT_AFTER, KeepaliveSession, keepalive_header
from gdp.control.liveness import LivenessMonitor
from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.neighbour_table import NeighbourTable
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import KeepaliveFlag, encode
from gdp.intervals import NEVER_S, SCHEDULED_S, UPKEEP_S
from gdp.limits import COST_AUTO
from gdp.names import Name
from gdp.sansio import KeepaliveOffer, KeepaliveRun, Timestamps
from gdp.trust.domain import Policy


class SessionOffload:
    """Keepalive sessions of one node, as far as a data plane may run them.

    Args:
        source: name and incarnation of the node.
        head_for: returns the keepalive timing at a port, and the digest for its far end.

    Attributes:
        refused: keepalives that data planes refused, by reason.
        has_changed: timers have changed since the node's protocol set this to False.
        has_heard: a keepalive has come since ``frames_came``.
        urgent_s: monotonic second of the node's first timer that waits for no frames.
        on_runs: called with the neighbours that were heard after each report.
    """

    def __init__(
        self,
        source: tuple[bytes, int],
        neighbours: NeighbourTable,
        liveness: LivenessMonitor,
        policy: Policy,
        head_for: Callable[[HelloPort], tuple[Timing, bytes]],
    ) -> None:
        self._source = source
        self._neighbours = neighbours
        self._liveness = liveness
        self._policy = policy
        self._head_for = head_for
        self.refused: Counter[DropReason] = Counter()
        self.has_changed = self.has_heard = False
        self.urgent_s = NEVER_S
        self.on_runs: Callable[[list[Neighbour], Timestamps], object] = lambda _heard, _now: None

    def offers(self, now_s: float) -> list[KeepaliveOffer]:
        """Return the steady sessions; those that are not among them are the node's."""
        return [
            self._offer(port, neighbour, neighbour.keepalives, now_s)
            for port in self._neighbours.ports.values()
            if port.is_up
            for neighbour in port.neighbours.values()
            if neighbour.state is NeighbourState.UP
            and neighbour.keepalives is not None
            and neighbour.keepalives.is_steady
        ]

    def _offer(self, port: HelloPort, neighbour: Neighbour, session: KeepaliveSession, now_s: float) -> KeepaliveOffer:
        timing, digest = self._head_for(port)
        return KeepaliveOffer(
            port=port.index,
            name=neighbour.name,
            nonce=neighbour.nonce,
            mac=neighbour.mac,
            in_key=session.in_key,
            out_key=session.out_key,
            header=encode(keepalive_header(*self._source, port.keepalive_sequence)),
            head=bytes((KeepaliveFlag.HEARD, self._liveness.multiplier(timing, now_s))) + digest,
            expected=session.head,
            loss=session.quality.loss_to_report,
            sequence=port.keepalive_sequence,
            sent=session.quality.sent,
            received=session.received,
            echo=session.quality.received,
            heard_s=neighbour.heard_s,
            send_at_s=session.send_at_s,
            out_interval_s=session.out_interval_s,
            suspect_s=SUSPECT_AFTER * session.in_interval_s,
        )

    def frames_came(self, now_s: float) -> bool:
        """Return whether a keepalive came, and one of ours may leave now; timers are read again then."""
        has_heard, self.has_heard = self.has_heard, False
        if not has_heard:
            return False
        is_due = False
        for each in self._own_sessions():
            if each.send_at_s <= now_s + each.out_interval_s * EARLY:
                each.send_at_s, is_due = min(each.send_at_s, now_s), True
        self.has_changed = self.has_changed or not is_due
        return is_due

    def latest_s(self, due_s: float) -> float:
        """Return until when a timer that is due then may wait for frames: one is that of a keepalive of ours."""
        latest = (each.latest_s for each in self._own_sessions() if each.send_at_s == due_s)
        return min(max(latest, default=due_s), due_s + SCHEDULED_S / 2, max(self.urgent_s, due_s))

    def _own_sessions(self) -> Iterator[KeepaliveSession]:
        """Yield the steady sessions that the node runs itself."""
        for port in self._neighbours.ports.values():
            for neighbour in port.neighbours.values():
                session = neighbour.keepalives
                if session is not None and session.is_steady and not session.is_offloaded:
                    yield session

    def take_runs(self, runs: list[KeepaliveRun], late_s: float, now: Timestamps) -> None:
        """Note what a data plane did in sessions.

        Args:
            late_s: how much later than it had requested the data plane was called.
        """
        self.has_changed, heard = True, []
        for run in runs:
            port = self._neighbours.ports.get(run.port)
            known = port.neighbours.get(Name(run.name)) if port is not None else None
            session = None if known is None or known.nonce != run.nonce else known.keepalives
            if port is None or known is None or session is None:
                if port is not None:
                    port.note_ended(Name(run.name), run.nonce, run.received)
                continue
            port.keepalive_sequence = max(port.keepalive_sequence, run.sequence)
            self.refused[DropReason.REPLAYED] += run.replays
            session.take_run(run)
            if session.has_new_cost and port.cost == COST_AUTO:
                self._neighbours.note_cost(known)
            if run.taken:
                self._liveness.note_alive(known, run.heard_s)
                heard.append(known)
            self._check_again(known, session, now)
        self._liveness.note_late(late_s, now.mono_s)
        self.on_runs(heard, now)

    def _check_again(self, known: Neighbour, session: KeepaliveSession, now: Timestamps) -> None:
        """Check the membership of a neighbour; if it is not valid any more, its keepalives are refused from now on."""
        if known.member is None or now.mono_s < known.checked_s + UPKEEP_S:
            return
        try:
            self._policy.check_member(known.member, now.unix_s)
        except StatementError:
            session.same = 0
        else:
            known.checked_s = now.mono_s
