"""Client of one name in a session: it selects the servers of a request and the response that counts.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``gdp/service/dispatch.py`` decides; this file connects it
with the participant's streams. A call that begins without a server waits for one, within its time limit.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from gdp.client.participant import Message, Participant, ServiceOptions, Topic
from gdp.client.publisher import Publisher
from gdp.due_queue import earliest
from gdp.errors import LocalError
from gdp.intervals import LOOK_S
from gdp.names import Name
from gdp.service.dispatch import Ask, Dispatch, End, Failure, Probe, Stop
from gdp.service.frames import PATIENCE_MAX_MS, Outcome, Request
from gdp.service.replication import NEAREST, Replication
from gdp.session.protocol.errors import CallError, CallTimeoutError, NoServerError, SessionError
from gdp.session.protocol.messages import Response
from gdp.session.protocol.wire import LEAVING, REQUEST, SERVING, read_response, stop_to_wire

if TYPE_CHECKING:
    from typing_extensions import Unpack

CALL_TIMEOUT_S: Final = 10.0
_GONE: Final = "the server has gone"


@dataclass(slots=True, eq=False, kw_only=True)
class Call:
    """One call.

    Attributes:
        timeout_s: its time limit in seconds; None: no limit.
        response: the first response, once there is one.
        error: the reason of its failure, once it has failed.
    """

    payload: bytes
    timeout_s: float | None
    replication: Replication
    deadline_s: float | None = None
    response: Response | None = None
    error: SessionError | None = None

    @property
    def is_done(self) -> bool:
        """Return whether it has ended."""
        return self.response is not None or self.error is not None


class NearestPath(NamedTuple):
    """Path to the nearest server: whether that is silent, and the cost."""

    is_silent: bool
    cost: int


class ClientCore:
    """Client of one name.

    Args:
        label: word for the name in errors.
        start: number of the first call, random in 64 bits.

    Raises:
        LocalError: no delegation, or the name is in use in this session.
    """

    def __init__(
        self, member: Participant, topic: Topic, label: str, *, start: int, **options: Unpack[ServiceOptions]
    ) -> None:
        self._member = member
        self._name = topic.name
        self._label = label
        self._start = start
        self._is_session = options.get("is_session", False)
        self._publisher: Publisher = member.call(topic, SERVING, **options)
        self._dispatches: dict[Replication, Dispatch[Response]] = {}
        self._servers: dict[Name, int] = {}  # server to its incarnation
        self._leaving: set[Name] = set()
        self._unasked: list[Call] = []  # calls that wait for a server
        # effects that wait for the window of the common stream
        self._for_all: deque[tuple[Dispatch[Response], Ask | Stop]] = deque()
        self._follow_at_s = 0.0

    @property
    def servers(self) -> list[Name]:
        """Return the present servers."""
        return list(self._servers)

    @property
    def is_idle(self) -> bool:
        """Return whether no call is active."""
        return not self._unasked and not any(len(each) for each in self._dispatches.values())

    def path(self, now_s: float) -> NearestPath | None:
        """Return the path to the nearest server, whose cost the switch states from now on; None: there is no server."""
        ranking = self._dispatch_of(NEAREST, now_s).ranking(now_s)
        return NearestPath(ranking[0][2], ranking[0][1]) if ranking else None

    def begin(self, call: Call, now_s: float) -> None:
        """Begin a call; it ends later with ``response`` or ``error``."""
        call.deadline_s = None if call.timeout_s is None else now_s + call.timeout_s
        self._follow(now_s)
        if self._servers:
            self._dispatch(call, now_s)
        else:
            self._unasked.append(call)
        self._send_out(now_s)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a server's response. Raises ``RemoteError``: MALFORMED or BAD_VERSION."""
        if not message.private:
            return  # on the stream for all clients, servers send only their description
        server = Name(message.delivered.publisher)
        frame = read_response(message.delivered.message)
        if server not in self._servers:
            self._follow(now_s)
        dispatches = list(self._dispatches.values())
        found = next((each for each in dispatches if frame.call in each), dispatches[0] if dispatches else None)
        if found is None:
            return  # a response to an earlier incarnation of this session
        if frame.outcome is Outcome.FAILED:
            found.refused(frame.call, server, frame.reason, now_s)
        else:
            found.answered(frame.call, server, Response(frame.body, server), now_s)
        self._send_out(now_s)

    def handle_timer(self, now_s: float) -> None:
        """Handle the timers that are due."""
        if now_s >= self._follow_at_s:
            self._follow(now_s)
        for call in [each for each in self._unasked if each.deadline_s is not None and now_s >= each.deadline_s]:
            self._unasked.remove(call)
            call.error = NoServerError(
                f"{self._label}: no server within {call.timeout_s:g} s; start one that serves this name, or allow more"
                " time with timeout_s"
            )
        for dispatch in self._dispatches.values():
            dispatch.handle_timer(now_s)
        self._send_out(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [dispatch.get_timer() for dispatch in self._dispatches.values()]
        times += [call.deadline_s for call in self._unasked]
        if not self.is_idle or self._for_all:
            times.append(self._follow_at_s)
        return earliest(*times)

    def close(self) -> None:
        """Stop calling the name; active calls fail."""
        error = CallError(f"{self._label}: the session was closed during the call")
        for call in self._unasked:
            call.error = error
        self._unasked.clear()
        for dispatch in self._dispatches.values():
            dispatch.fail_all("the session was closed during the call")
        self._member.withdraw(self._name)

    def _follow(self, now_s: float) -> None:
        """Update the set of servers."""
        self._follow_at_s = now_s + LOOK_S
        name, services = self._name, self._member.services
        peers = set(services.peers(name) or services.connected_peers(name))  # a slow server is better than none
        if not peers:  # and a silent one may return: its calls go on
            peers = self._servers.keys() & set(services.silent_peers(name))
        heard = {
            writer_proxy.publisher: writer_proxy
            for writer_proxy in self._member.subscriptions.writer_proxies_of(name)
            if writer_proxy.publisher in peers
        }
        for name, incarnation in list(self._servers.items()):
            if name in heard and heard[name].incarnation != incarnation:  # it restarted
                self._remove(name, now_s)
        for name, writer_proxy in heard.items():
            is_new = name not in self._servers
            self._servers[name] = writer_proxy.incarnation
            if is_new:
                for dispatch in self._dispatches.values():
                    dispatch.replica_joined(name, now_s)
            if writer_proxy.description == LEAVING and name not in self._leaving:
                self._leaving.add(name)
                for dispatch in self._dispatches.values():
                    dispatch.replica_leaving(name)
        for name in [name for name in self._servers if name not in heard]:  # last: its calls find one that returned now
            self._remove(name, now_s)
        if self._servers and self._unasked:
            waiting, self._unasked = self._unasked, []
            for call in waiting:
                self._dispatch(call, now_s)

    def _remove(self, name: Name, now_s: float) -> None:
        del self._servers[name]
        self._leaving.discard(name)
        for dispatch in self._dispatches.values():
            dispatch.replica_lost(name, now_s, _GONE)

    def _dispatch(self, call: Call, now_s: float) -> None:
        dispatch = self._dispatch_of(call.replication, now_s)
        left_s = None if call.deadline_s is None else max(call.deadline_s - now_s, 0.0)
        patience_ms = 0 if left_s is None else min(max(int(left_s * 1e3), 1), PATIENCE_MAX_MS)

        def write(number: int) -> bytes:
            """Return the wire form of the request under a call's number."""
            return Request(REQUEST, number, patience_ms, call.payload).to_wire()

        def responded(response: Response) -> None:
            """Store the response in the call."""
            call.response = response

        def failed(failure: Failure, reason: str) -> None:
            """Store the error in the call."""
            call.error = self._error_of(call, failure, reason)

        try:
            dispatch.begin(now_s, write, left_s, responded, failed)
        except LocalError as error:
            call.error = CallError(f"{self._label}: {error}; wait for calls to end before you begin more")

    def _dispatch_of(self, replication: Replication, now_s: float) -> Dispatch[Response]:
        known = self._dispatches.get(replication)
        if known is not None:
            return known
        # so that no two dispatches use the same numbers
        start = (self._start + (len(self._dispatches) << 48)) % (1 << 64)
        paths = self._member.services.paths_for(self._name, replication)
        dispatch = self._dispatches[replication] = Dispatch(
            replication, start=start, unicasts=self._is_session, paths=paths
        )
        for name in self._servers:
            dispatch.replica_joined(name, now_s)
            if name in self._leaving:
                dispatch.replica_leaving(name)
        return dispatch

    def _send_out(self, now_s: float) -> None:
        """Send the effects; those for all servers wait for the window of their common stream."""
        for dispatch in self._dispatches.values():
            while effects := dispatch.poll_effects():
                for effect in effects:
                    if isinstance(effect, End):
                        self._member.services.end_call(self._name, effect.call)
                        continue
                    if isinstance(effect, Probe):
                        self._member.services.probe(self._name, effect.server)
                        continue
                    servers = effect.servers if isinstance(effect, Ask) else effect.server and (effect.server,)
                    if servers is None:
                        self._for_all.append((dispatch, effect))
                    for server in servers or ():
                        self._send_to(dispatch, server, effect, now_s)
        while self._for_all and self._publisher.has_space():
            dispatch, effect = self._for_all.popleft()
            if isinstance(effect, Ask) and effect.call not in dispatch:
                continue  # it ended in the meantime
            try:
                if isinstance(effect, Ask):
                    self._member.services.send_requests(self._name, effect.request, effect.call)
                else:
                    self._publisher.publish(_wire_of(effect))
            except LocalError as error:
                self._not_sent(dispatch, effect, dispatch.servers, str(error), now_s)

    def _send_to(self, dispatch: Dispatch[Response], server: Name, effect: Ask | Stop, now_s: float) -> None:
        try:
            call = effect.call if isinstance(effect, Ask) else None
            self._member.services.send_request(self._name, server, _wire_of(effect), call)
        except LocalError as error:
            self._not_sent(dispatch, effect, [server], str(error), now_s)

    def _not_sent(
        self, dispatch: Dispatch[Response], effect: Ask | Stop, servers: list[Name], reason: str, now_s: float
    ) -> None:
        if isinstance(effect, Ask):
            for server in servers:
                dispatch.refused(effect.call, server, reason, now_s)

    def _error_of(self, call: Call, failure: Failure, reason: str) -> SessionError:
        if failure is Failure.TIMED_OUT:
            return CallTimeoutError(
                f"{self._label}: no response within {call.timeout_s:g} s from {len(self._servers)} server(s); the"
                " request may have been executed"
            )
        if failure is Failure.NO_SERVER:
            return NoServerError(f"{self._label}: {reason or 'no server is left'}; call again when a server is back")
        return CallError(f"{self._label}: every server refused: {reason}")


def _wire_of(effect: Ask | Stop) -> bytes:
    return effect.request if isinstance(effect, Ask) else stop_to_wire(effect.calls)
