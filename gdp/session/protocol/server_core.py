"""Server of one name in a session: requests in order, and responses to the clients that sent them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``gdp/service/serving.py`` keeps the order, and repeats the
response of a duplicate request.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from gdp.client.participant import Message, Participant, ServiceOptions, Topic
from gdp.due_queue import earliest
from gdp.errors import LocalError
from gdp.intervals import HOUR_S, TICK_S
from gdp.limits import CALL_GRACE_S, CALLER_AWAY_S
from gdp.names import Name
from gdp.service.frames import Answer, Outcome, Request
from gdp.service.serving import Asked, Serving, Turn
from gdp.session.protocol.wire import LEAVING, PAYLOAD_MAX_BYTES, RESPONSE, SERVING, read_request

if TYPE_CHECKING:
    from typing_extensions import Unpack

_PART: Final = 0


class ServerCore:
    """Server of one name.

    Args:
        start: number of the first call here, random in 64 bits.
        at_once: most requests that handlers process at the same time.

    Attributes:
        turns: requests for handlers, in order; a driver removes them.
        unsent: number of responses that could not be sent, because their client had gone.

    Raises:
        LocalError: no delegation, or the name is in use in this session.
    """

    def __init__(
        self, member: Participant, topic: Topic, *, start: int, at_once: int | None, **options: Unpack[ServiceOptions]
    ) -> None:
        self._member = member
        self._name = topic.name
        self._serving: Serving[bytes] = Serving(start, at_once)
        self._publisher = member.serve(topic, SERVING, **options)
        self._seen_s: dict[Name, float] = {}  # when the clients of active calls were last alive
        self._check_at_s: float | None = None  # when clients are checked next; None: no call is active
        self._is_leaving = False
        self.turns: deque[Turn[bytes]] = deque()
        self.unsent = 0

    @property
    def clients(self) -> int:
        """Return the number of clients."""
        return len(self._member.services.peers(self._name))

    @property
    def is_idle(self) -> bool:
        """Return whether no request is active, and the clients have confirmed their responses."""
        return not self._serving and self._member.publications.is_acknowledged(self._name)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a client's request, or its notice that calls have ended.

        Raises:
            RemoteError: MALFORMED or BAD_VERSION.
        """
        client = Name(message.delivered.publisher)
        frame = read_request(message.delivered.message)
        if isinstance(frame, Request):
            self._begin(client, frame, now_s)
        else:
            for call in frame:
                self._serving.stop(Asked(client, _PART, call))
        self._give(now_s)

    def finish(self, number: int, outcome: bytes | str, now_s: float) -> None:
        """Respond to a request.

        Args:
            number: of the turn.
            outcome: the payload, or as text the reason for the failure.
        """
        asked = self._serving.end(number)
        if asked is not None:
            if len(outcome) > PAYLOAD_MAX_BYTES:
                outcome = f"the response has {len(outcome)} bytes; at most {PAYLOAD_MAX_BYTES} can be sent"
            if isinstance(outcome, str):
                self._respond(asked, Answer.failed(RESPONSE, asked.call, outcome))
            else:
                self._respond(asked, Answer(RESPONSE, asked.call, Outcome.ANSWERED, outcome))
        self._give(now_s)

    def leave(self) -> None:
        """Accept no new requests: clients learn to use other servers, and active requests finish."""
        self._is_leaving = True
        self._publisher.describe(LEAVING)

    def close(self, now_s: float) -> None:
        """Stop serving the name; active calls fail."""
        for asked in self._serving.fail_all():
            self._respond(asked, Answer.failed(RESPONSE, asked.call, "the server was closed"))
        self.turns.clear()
        self._member.flush(now_s)  # the responses must leave before their stream ends
        self._member.withdraw(self._name)

    def handle_timer(self, now_s: float) -> None:
        """Drop requests that no client waits for."""
        for each in self._serving.expired(now_s):
            if each.asked is not None:
                self._respond(
                    each.asked, Answer.failed(RESPONSE, each.asked.call, "the server did not respond in time")
                )
        if self._check_at_s is not None and now_s >= self._check_at_s:
            self._check_clients(now_s)
            self._check_at_s = now_s + TICK_S if self._serving else None
        self._give(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return earliest(self._serving.get_timer(), self._check_at_s)

    def _begin(self, client: Name, frame: Request, now_s: float) -> None:
        asked = Asked(client, _PART, frame.call)
        before = self._serving.answer_of(asked)
        if before is not None or asked in self._serving:
            if before:
                self._send(client, before)
            return
        if self._is_leaving:
            self._respond(asked, Answer.failed(RESPONSE, frame.call, "the server is leaving"))
            return
        patience_s = min(frame.patience_ms / 1e3 + CALL_GRACE_S, HOUR_S) if frame.patience_ms else HOUR_S
        try:
            self._serving.begin(now_s, patience_s, asked, frame.body)
        except LocalError as error:
            self._respond(asked, Answer.failed(RESPONSE, frame.call, str(error)))
            return
        if self._check_at_s is None:
            self._check_at_s = now_s + TICK_S

    def _give(self, now_s: float) -> None:
        self.turns.extend(self._serving.poll_turns(now_s))

    def _respond(self, asked: Asked, frame: Answer) -> None:
        wire = frame.to_wire()
        self._serving.remember(asked, wire)
        self._send(asked.client, wire)

    def _send(self, client: Name, wire: bytes) -> None:
        try:
            self._member.services.respond(self._name, client, wire)
        except LocalError:
            self.unsent += 1  # the client has gone; if it repeats the request, it gets the stored response

    def _check_clients(self, now_s: float) -> None:
        """Drop the calls of clients that have gone."""
        here = set(self._member.services.connected_peers(self._name))
        known = {writer_proxy.publisher for writer_proxy in self._member.subscriptions.writer_proxies_of(self._name)}
        clients = self._serving.clients
        self._seen_s = {each: now_s if each in here else self._seen_s.get(each, now_s) for each in clients}
        for client, seen_s in self._seen_s.items():
            if client not in here and (client not in known or now_s - seen_s >= CALLER_AWAY_S):
                self._serving.remove_client(client)
