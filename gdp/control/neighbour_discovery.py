"""Hello protocol: discovery of neighbours, proof of their identity, and detection of their loss.

Sans-I/O. Every node that has a port sends hellos: switches, RIBs, proxies. Source: OSPF (RFC 2328, sections 9.5 and
10.5) for hellos and two-way state.

A hello is signed by a member of a trusted domain and carries its certificate. It counts as two-way when it echoes the
nonce of our port's present session and its sequence number exceeds all received in its own session. So a recorded hello
brings no neighbour up: the last sequence number is remembered for ended sessions, too.

``hello_reception.py`` verifies hellos. A node that has not echoed our nonce is a candidate. Candidates have entries of
their own, apart from those of neighbours; where none is free, the oldest candidate is evicted. Candidates are answered
with no more bytes than they have sent.

Hellos also state the MTU of each end: a link is as wide as its narrowest end. When an end changes, both know at once.

Between neighbours that are up, keepalives (``keepalive.py``) replace most hellos. ``liveness.py`` decides when a
silent neighbour is lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

from gdp.control.admission import Admission, read_cookie, seal_cookie
from gdp.control.endpoints import Endpoint
from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import DIGEST_BYTES, NONCE_BYTES, RTCERTS_MAX, Hello, NodeSettings, Timing
from gdp.control.hello_port import UNREACHABLE, HelloPort
from gdp.control.hello_reception import HelloReception
from gdp.control.identity_conflicts import IdentityConflicts
from gdp.control.keepalive import TOGETHER, KeepaliveSession
from gdp.control.keepalive_offload import SessionOffload
from gdp.control.liveness import LivenessMonitor
from gdp.control.neighbour import Neighbour, NeighbourEvent, NeighbourState
from gdp.control.neighbour_table import Change, NeighbourTable
from gdp.control.preshared_key import PresharedKeys
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES, ExchangeKey
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement
from gdp.errors import DropReason, FrameError, StatementError
from gdp.frame.codec import HEADER_BYTES, Header, Kind, decode
from gdp.intervals import HELLO_IDLE, NEVER_S, UPKEEP_S
from gdp.limits import COST_AUTO, MTU_MIN_BYTES
from gdp.names import Name
from gdp.sansio import BROADCAST, OutgoingFrames, ReceivedFrame, Timestamps
from gdp.trust.domain import Policy

PADDED_BYTES: Final = 1_400  # of a hello with its header; the answer of a node that does not know us is not longer


class HelloProtocol:
    """Hello protocol of one node on all its ports.

    Args:
        digest_for: returns the digest of our link state for the far end of a port.
        incarnation_elsewhere: returns the mark of a named node that is alive, but at none of our ports; or None.
        is_only_way: returns whether only our link leads to a named neighbour; None: if no other link is up.
        rtcert_for: of a RIB, its RtCert for a switch; None of any other node.

    Attributes:
        conflicts: nodes that share an identity with another one, at our ports; and notices that another has our own.
        liveness: which neighbours are silent.
        neighbours: those of all ports.
        offload: of keepalive sessions to a data plane.
        preshared_keys: of tunnels to neighbours.
        reception: of hellos, whose frames it joins.
        together_s: keepalives leave so long before they are due, if this node is called for something else.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        fragmenter: ControlFragmenter,
        settings: NodeSettings,
        *,
        digest_for: Callable[[HelloPort], bytes] = lambda _: bytes(DIGEST_BYTES),
        incarnation_elsewhere: Callable[[Name], bytes | None] = lambda _: None,
        is_only_way: Callable[[Name], bool] | None = None,
        rtcert_for: Callable[[Name], bytes] | None = None,
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._fragmenter = fragmenter
        self._random_bytes = settings.random_bytes
        self._hello_s = settings.hello_s
        self._timing = settings.timing  # where ``set_timing`` sets no other for a port
        self._timings: dict[int, Timing] = {}
        self._incarnation = settings.incarnation
        self._due_s = NEVER_S  # when the next call was requested
        self._next_s: float | None = None  # no timer is due before; None: to be computed
        self.together_s = 0.0
        self._digest_for = digest_for
        self._incarnation_id = settings.incarnation_id
        self._incarnation_elsewhere = incarnation_elsewhere
        self._rtcert_for = rtcert_for
        self.conflicts = IdentityConflicts()
        self.neighbours = NeighbourTable()
        self.ports = self.neighbours.ports
        self.reception = HelloReception(identity, policy, fragmenter, settings, self.ports)
        self.liveness = LivenessMonitor(self.neighbours, settings, is_only_way)
        self.preshared_keys = PresharedKeys(identity.name, settings.random_bytes)

        def head_for(port: HelloPort) -> tuple[Timing, bytes]:
            """Return the timing at a port, and the digest for its far end."""
            return self._timings.get(port.index, self._timing), digest_for(port)

        self.offload = SessionOffload(
            (identity.name, settings.incarnation), self.neighbours, self.liveness, policy, head_for
        )

    def set_timing(self, index: int, timing: Timing) -> None:
        """Request another keepalive timing on one port, from its next session on."""
        self._timings[index] = timing
        self._next_s = None

    def probe_uplink(self, uplink: int, now_s: float, *, is_restarted: bool = True) -> None:
        """Poll all neighbours over an uplink whose address has changed, as ``LivenessMonitor.probe_uplink``."""
        self.liveness.probe_uplink(uplink, now_s, is_restarted=is_restarted)
        self._next_s = None

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now_s: float) -> list[Change]:
        """Begin to send hellos on a port, or update the MTU or cost (``COST_AUTO``: measured) of one that is up.

        Returns the neighbours to which the link has changed, and those that another address of ours removes.
        """
        self._next_s = None
        port, own_mtu = self.ports.get(index), max(mtu, MTU_MIN_BYTES)
        if port is None or not port.is_up or port.mac != mac:
            lost = [] if port is None else self._lose(port, list(port.neighbours.values()), NeighbourEvent.LINK_LOST)
            nonce, key = _new_session(self._random_bytes)
            self.ports[index] = HelloPort(
                owner=self._identity.name,
                index=index,
                mac=mac,
                own_mtu=own_mtu,
                cost=cost,
                nonce=nonce,
                exchange_key=key,
                admission=Admission(),
                hello_at_s=now_s,
                addresses={} if port is None else port.addresses,
                qualities={} if port is None else port.qualities,
            )
            return lost
        if (port.own_mtu, port.cost) == (own_mtu, cost):
            return []
        port.own_mtu, port.cost = own_mtu, cost
        port.hurry(now_s)  # the other ends must know
        for neighbour in port.neighbours.values():
            neighbour.cost = port.cost_to(neighbour.name)
            neighbour.mtu = min(port.said_mtus[neighbour.name], own_mtu)
        return [(each, each.state) for each in port.neighbours.values() if each.state is NeighbourState.UP]

    def set_observed(self, index: int, name: Name, endpoint: Endpoint | None) -> None:
        """Report to a neighbour on a tunnel's port the endpoint at which this end sees it; None: it is unknown.

        A change is sent at once. A node that is no neighbour there is ignored.
        """
        port = self.ports.get(index)
        if port is None or self.neighbours.get(index, name) is None or port.observed.get(name) == endpoint:
            return
        port.observed.pop(name, None)
        if endpoint is not None:
            port.observed[name] = endpoint
        self._next_s = None
        port.hurry(port.next_hello_s(port.said_s[1]))

    @property
    def drops(self) -> Counter[DropReason]:
        """Return the unfinished hellos and the messages about preshared keys that were given up, by reason."""
        return self.reception.drops + self.preshared_keys.refused + self.offload.refused

    def receive_cookie(self, arrival: ReceivedFrame, header: Header) -> None:
        """Process a cookie of a neighbour that was heard, at its address, in answer to a hello of this session.

        Raises:
            FrameError: UNKNOWN_SENDER or TRUNCATED.
        """
        port = self.ports.get(arrival.port)
        known = port.neighbours.get(Name(header.source)) if port is not None else None
        session, nonce, cookie = read_cookie(arrival.frame[HEADER_BYTES : HEADER_BYTES + header.length])
        if port is None or known is None or (known.mac, known.nonce, port.nonce) != (arrival.mac, session, nonce):
            raise FrameError(DropReason.UNKNOWN_SENDER, "a cookie")
        self._next_s = None
        known.cookie = cookie
        port.hello_at_s = min(port.hello_at_s, port.said_s[1] + self._hello_s)

    def receive(self, arrival: ReceivedFrame, statement: Statement, now: Timestamps) -> Change | None:
        """Process a hello; return what it changed.

        Raises:
            StatementError: the hello is invalid, or no more are verified now; nothing has changed.
        """
        port = self.ports.get(arrival.port)
        if port is None or not port.is_up:
            return None
        hello, member, proof = self.reception.verified(port, arrival, statement, now)
        self._next_s = None
        received_bytes = _received_bytes(arrival, statement)
        self._refuse_conflict(port, hello, member.name, (arrival.mac, received_bytes), now.mono_s)
        self.conflicts.accept(member.name, hello.incarnation_id)
        is_two_way = port.echo in hello.heard
        known = port.neighbours.get(member.name)
        self.neighbours.free_space(port, known, is_two_way=is_two_way)
        if known is None:
            known = port.neighbours[member.name] = Neighbour(
                name=member.name,
                role=member.role,
                domain=member.domain,
                key=member.key,
                port=port.index,
                mac=arrival.mac,
                mtu=0,
                nonce=b"",
                sequence=0,
                digest=b"",
                heard_s=0.0,
            )
        is_new_session = known.nonce != hello.nonce
        if is_two_way:
            has_news = is_new_session or (port.owes_answer and not known.is_proven)
        else:
            has_news = known.is_proven and not is_new_session  # it does not receive our hellos any more
            if not has_news:
                port.schedule_hello(received_bytes, now.mono_s)
        if has_news:
            port.hurry(port.next_hello_s(now.mono_s))
        if is_new_session and not is_two_way and known.is_proven:
            known.candidate, known.candidate_sequence = hello.nonce, hello.sequence
            # a restart, or a replayed hello: only an echo of our nonce decides
            return None
        if is_new_session or not is_two_way:
            port.end(known)
            known.keepalives = None
        said_mtu = port.said_mtus[known.name] = max(hello.mtu, MTU_MIN_BYTES)
        mtu = min(said_mtu, port.own_mtu)
        is_resized = known.mtu != mtu
        known.mac, known.mtu, known.nonce, known.candidate = arrival.mac, mtu, hello.nonce, b""
        known.is_proven = is_two_way or (known.is_proven and not is_new_session)
        if known.is_proven:
            self.neighbours.note_address(port, arrival.mac)
        known.cookie = b"" if is_new_session else known.cookie
        known.sequence, known.digest, known.greeted_s = hello.sequence, hello.digest, now.mono_s
        known.member, known.checked_s, known.incarnation_id = member, now.mono_s, hello.incarnation_id
        known.cost = port.cost_to(known.name)
        known.role = member.role  # a root may have changed a switch into a leaf
        self._note_observed(port, known, hello, now.mono_s)
        had_proof, known.proof = known.proof is not None, proof
        self._note_clash(port, known, hello, now.mono_s)
        self.liveness.note_alive(known, now.mono_s)
        if is_two_way and known.keepalives is None:
            self._begin_keepalives(port, known, hello, now.mono_s)
        change = self.neighbours.step(known, NeighbourEvent.TWO_WAY if is_two_way else NeighbourEvent.ONE_WAY)
        self._agree(port, known, hello, now.mono_s)
        if change is None and is_new_session and is_two_way:
            return known, NeighbourState.GONE  # it restarted, and has lost the state that we sent it
        is_placed = (known.proof is not None) is not had_proof
        if change is None and (is_resized or is_placed) and known.state is NeighbourState.UP:
            return known, known.state
        return change

    def _refuse_conflict(
        self, port: HelloPort, hello: Hello, name: Name, arrived: tuple[bytes, int], now_s: float
    ) -> None:
        """Refuse a hello if an older node with its identity is alive; a younger one is removed.

        Args:
            arrived: from which address, and how many bytes.

        Raises:
            StatementError: IN_USE.
        """
        others = [
            other
            for each in self.ports.values()
            if (other := each.neighbours.get(name)) is not None
            and other.is_proven
            and other.incarnation_id != hello.incarnation_id
            and now_s < self.liveness.gone_at_s(other)
        ]
        mac, received_bytes = arrived
        if any((other.port, other.mac) == (port.index, mac) for other in others):
            return  # it was restarted there
        elsewhere = self._incarnation_elsewhere(name)
        is_outlived_here = any(other.incarnation_id < hello.incarnation_id for other in others)
        is_proven = port.echo in hello.heard  # else it may be a replayed one
        tell = self._tell_conflict if is_proven else self.conflicts.schedule_notice
        for other in others:
            if is_outlived_here:
                tell(other.port, other.nonce, name, now_s)
            elif is_proven:
                self.schedule_removal(other, now_s)
        if not is_outlived_here and (elsewhere is None or hello.incarnation_id <= elsewhere):
            return
        self.conflicts.record_refusal(name, hello.incarnation_id, now_s)
        tell(port.index, hello.nonce, name, now_s)
        if not is_proven:
            port.schedule_hello(received_bytes, now_s)
        raise StatementError(DropReason.IN_USE, "an older node with this identity is alive")

    def recheck(self, fingerprint: bytes, now: Timestamps) -> None:
        """Have ``drop_silent`` remove the neighbours whose membership, of this fingerprint, was revoked."""
        for port in self.ports.values():
            for neighbour in port.neighbours.values():
                member = neighbour.member
                if member is None or member.fingerprint != fingerprint:
                    continue
                try:
                    self._policy.check_member(member, now.unix_s)
                except StatementError:
                    self._next_s, neighbour.is_let_go = None, True

    def schedule_removal(self, neighbour: Neighbour, now_s: float) -> None:
        """Have ``drop_silent`` remove a neighbour, because an older node with its identity is alive."""
        self.conflicts.record_refusal(neighbour.name, neighbour.incarnation_id, now_s)
        self._tell_conflict(neighbour.port, neighbour.nonce, neighbour.name, now_s)
        self._next_s, neighbour.is_let_go = None, True

    def tell_conflicts(self, name: Name, now_s: float) -> None:
        """Notify a neighbour, if it is one, that another node has its identity."""
        for port in self.ports.values():
            held = port.neighbours.get(name)
            if held is not None:
                self._tell_conflict(port.index, held.nonce, name, now_s)

    def _tell_conflict(self, port: int, nonce: bytes, name: Name, now_s: float) -> None:
        """Have hellos notify a session of its conflict, soon if that is new to it."""
        if self.conflicts.schedule_notice(port, nonce, name, now_s):
            self._next_s = None
            self.ports[port].hurry(now_s)

    def _note_clash(self, port: HelloPort, neighbour: Neighbour, hello: Hello, now_s: float) -> None:
        """Note what a neighbour's hello states about our identity."""
        neighbour.refuses_us = port.echo in hello.conflicts and port.echo not in hello.heard
        if port.echo in hello.conflicts:
            self.conflicts.record_clash(neighbour.name, now_s)

    def _note_observed(self, port: HelloPort, neighbour: Neighbour, hello: Hello, now_s: float) -> None:
        """Note where a neighbour sees this end; another endpoint than before means that a NAT on the way has moved."""
        before = neighbour.observed
        neighbour.observed = next((endpoint for nonce, endpoint in hello.observed if nonce == port.nonce), None)
        uplink = self.liveness.uplinks.get(port.index)
        if uplink is not None and None not in (before, neighbour.observed) and before != neighbour.observed:
            self.probe_uplink(uplink, now_s, is_restarted=False)

    def _agree(self, port: HelloPort, neighbour: Neighbour, hello: Hello, now_s: float) -> None:
        """Let the agreement on a tunnel's preshared key go on; it begins again when its peer is not up."""
        if neighbour.state is not NeighbourState.UP:
            self.preshared_keys.reset(port.index, neighbour.name)
            return
        own, far = port.nonce + self._identity.name, neighbour.nonce + neighbour.name
        if self.preshared_keys.receive(port.index, neighbour.name, hello.preshared, own, far):
            port.hurry(port.next_hello_s(now_s))

    def receive_keepalive(self, arrival: ReceivedFrame, header: Header, now: Timestamps) -> Neighbour:
        """Process a keepalive; return the neighbour that sent it.

        Raises:
            FrameError: UNKNOWN_SENDER, REPLAYED, BAD_TAG or TRUNCATED; nothing has changed.
            StatementError: the neighbour's membership is no longer valid.
        """
        port = self.ports.get(arrival.port)
        known = port.neighbours.get(Name(header.source)) if port is not None else None
        if known is None or known.keepalives is None:
            raise FrameError(DropReason.UNKNOWN_SENDER, "a keepalive")
        if known.member is not None and now.mono_s >= known.checked_s + UPKEEP_S:
            self._policy.check_member(known.member, now.unix_s)
            known.checked_s = now.mono_s
        known.digest = known.keepalives.open(header, arrival.frame, now.mono_s, arrival.waited_s)
        if known.keepalives.has_new_cost and port is not None and port.cost == COST_AUTO:
            self.neighbours.note_cost(known)
        if known.keepalives.is_final_due:
            self.liveness.note_polled(arrival.port)
        if known.keepalives.is_final_due or self.liveness.is_probing:
            self._next_s = None  # any other change only delays timers
        self.liveness.note_alive(known, now.mono_s - arrival.waited_s)
        self.offload.has_heard = True
        return known

    def port_changed(self, index: int, up: bool, now_s: float) -> list[Change]:
        """Update the state of a link; return the neighbours that this removed."""
        self._next_s = None
        port = self.ports.get(index)
        if port is None or port.is_up == up:
            return []
        port.is_up = up
        if up:
            port.nonce, port.exchange_key = _new_session(self._random_bytes)
            port.ended.clear()
            port.joins.clear()
            port.answer_at_s, port.credit_bytes = NEVER_S, 0
            port.hurry(now_s)
            return []
        return self._lose(port, list(port.neighbours.values()), NeighbourEvent.LINK_LOST)

    def remove_port(self, index: int) -> None:
        """Forget a port that is down; does nothing if no port has this index."""
        self._next_s = None
        self.neighbours.remove_port(index)
        self._timings.pop(index, None)
        self.liveness.uplinks.pop(index, None)
        self.preshared_keys.remove(index)

    def drop_silent(self, now_s: float) -> list[Change]:
        """Remove silent neighbours; return them. What waits at the sockets must have been received before."""
        self.liveness.note_call(self._due_s, now_s)
        is_settled = self._next_s is not None and not self.offload.has_changed and now_s < self.liveness.lost_at_s
        self._due_s, self._next_s = NEVER_S, None
        self.reception.drop_expired(now_s)
        changes: list[Change] = []
        for port in () if is_settled else self.ports.values():
            silent = self.liveness.silent(port, now_s)
            if silent:
                self.liveness.note_failed(port, silent, now_s)
                if any(each.is_proven for each in silent):
                    port.hurry(now_s)  # a neighbour that still receives us learns at once that we do not receive it
                changes += self._lose(port, silent, NeighbourEvent.SILENCE)
        return changes

    def hellos_to_send(self, now_s: float) -> list[OutgoingFrames]:
        """Return the hellos, keepalives and cookies that are due."""
        self._next_s = None
        out = self.reception.replies_to_send()
        self.liveness.request_polls(now_s)
        for port in self.ports.values():
            if not port.is_up:
                continue
            if port.hello_at_s <= now_s:
                out.append(OutgoingFrames(port.index, BROADCAST, self._scheduled_hello(port, now_s)))
            elif port.answer_at_s <= now_s:
                answer = self._answer(port, now_s)
                if answer:
                    out.append(OutgoingFrames(port.index, BROADCAST, answer))
            for neighbour in port.neighbours.values():
                session = neighbour.keepalives
                if session is None or session.is_offloaded:
                    continue
                is_suspect = session.suspect_at_s(neighbour.heard_s) <= now_s
                if is_suspect or session.send_at_s <= now_s + session.out_interval_s * TOGETHER:
                    if is_suspect:
                        session.note_poll(now_s)
                    self.liveness.note_silence(neighbour, session, now_s)
                    port.keepalive_sequence += 1
                    timing = self._timings.get(port.index, self._timing)
                    frame = session.seal(
                        (self._identity.name, self._incarnation),
                        port.keepalive_sequence,
                        self.liveness.multiplier(timing, now_s),
                        self._digest_for(port),
                        now_s,
                        poll=is_suspect or session.is_poll_due,
                    )
                    out.append(OutgoingFrames(port.index, neighbour.mac, [frame]))
        return out

    def get_timer(self) -> float | None:
        """Return a monotonic second that is no later than the next hello, keepalive or silence of a neighbour."""
        if self._next_s is None or self.offload.has_changed:
            self.offload.has_changed = False
            self._next_s = self._find_next()
        reply_at_s = self.reception.reply_at_s
        self._due_s = reply_at_s if reply_at_s < self._next_s else self._next_s
        return None if self._due_s == NEVER_S else self._due_s

    def _find_next(self) -> float:
        due_s = self.liveness.find_next()
        self.together_s = self.liveness.longest_s * TOGETHER
        for port in self.ports.values():
            if port.is_up:
                due_s = min(due_s, port.hello_at_s, port.answer_at_s)
        return due_s

    def _begin_keepalives(self, port: HelloPort, neighbour: Neighbour, hello: Hello, now_s: float) -> None:
        timing = self._timings.get(port.index, self._timing)
        ends = port.nonce + self._identity.name, neighbour.nonce + neighbour.name
        _, received = port.ended.get((neighbour.name, neighbour.nonce), UNREACHABLE)
        neighbour.keepalives = KeepaliveSession.begin(
            port.exchange_key,
            hello.exchange_key,
            ends,
            (timing, hello.timing),
            received,
            port.quality_of(neighbour.name),
            now_s,
        )

    def _scheduled_hello(self, port: HelloPort, now_s: float) -> list[bytes]:
        """Return a hello, padded, so that a node that does not know us yet may answer with as many bytes."""
        port.eager = max(port.eager - 1, 0)
        is_rare = port.is_idle and not port.eager and not port.admission.is_loaded(now_s)
        port.hello_at_s = now_s + self._hello_s * (HELLO_IDLE if is_rare else 1)
        frames = self._hello(port, now_s)
        port.owes_answer = False
        frames[-1] = frames[-1].ljust(min(PADDED_BYTES, port.hello_mtu), b"\0")
        return frames

    def _answer(self, port: HelloPort, now_s: float) -> list[bytes]:
        """Return a hello for the candidates, or nothing if they have sent fewer bytes."""
        port.answer_at_s = NEVER_S
        frames = self._hello(port, now_s)
        size = sum(map(len, frames))
        port.owes_answer = size > port.credit_bytes
        if port.owes_answer:
            return []
        port.credit_bytes -= size
        return frames

    def _hello(self, port: HelloPort, now_s: float) -> list[bytes]:
        port.sequence += 1
        port.said_s, port.answer_at_s = (port.said_s[1], now_s), NEVER_S
        heard = port.echoes()
        identity, timing = self._identity, self._timings.get(port.index, self._timing)
        hello = Hello(
            nonce=port.nonce,
            sequence=port.sequence,
            heard=heard,
            mtu=port.own_mtu,
            digest=self._digest_for(port),
            membership=identity.membership,
            timing=timing,
            exchange_key=port.exchange_key.public,
            incarnation_id=self._incarnation_id,
            conflicts=self.conflicts.on(port.index, now_s),
            rtcerts=self._rtcerts_on(port),
            cookies=tuple(
                (each.nonce, seal_cookie(each.cookie, port.nonce, port.sequence))
                for each in port.neighbours.values()
                if each.cookie
            ),
            observed=tuple(
                (each.nonce, port.observed[each.name])
                for each in port.neighbours.values()
                if each.name in port.observed and each.is_proven
            ),
            preshared=self.preshared_keys.message(port.index),
        )
        return self._fragmenter.split(Kind.HELLO, hello.to_wire(identity.name, identity.key), port.hello_mtu)

    def _rtcerts_on(self, port: HelloPort) -> tuple[bytes, ...]:
        """Return a RIB's RtCerts for the switches whose hellos it receives on a port."""
        if self._rtcert_for is None:
            return ()
        heard = [each for each in port.neighbours.values() if each.role.is_switch]
        switches = sorted((not each.is_proven, each.name) for each in heard)
        return tuple(self._rtcert_for(name) for _, name in switches[:RTCERTS_MAX])

    def _lose(self, port: HelloPort, lost: list[Neighbour], event: NeighbourEvent) -> list[Change]:
        for neighbour in lost:
            self.preshared_keys.reset(port.index, neighbour.name)
        return self.neighbours.remove(port, lost, event)


def _new_session(random_bytes: Callable[[int], bytes]) -> tuple[bytes, ExchangeKey]:
    """Return nonce and key of a new session of a port."""
    return random_bytes(NONCE_BYTES), ExchangeKey.from_random(random_bytes(EXCHANGE_KEY_BYTES))


def _received_bytes(arrival: ReceivedFrame, statement: Statement) -> int:
    """Return the bytes of all frames of a statement, padding included; ``arrival`` is the last of them."""
    header = decode(arrival.frame)
    padding = len(arrival.frame) - HEADER_BYTES - header.length
    return header.parts * HEADER_BYTES + len(statement.wire) + max(padding, 0)
