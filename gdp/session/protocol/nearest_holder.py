"""Reading at the nearest of several holders of the same capsules, and at the next one if that falls silent.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). The client of each holder's service knows the cost of the path
to it, and whether it is silent while it owes an answer (``gdp/service/nearest.py``). A reading stays at one holder.
Offsets are the same at all, so the next holder continues at the byte. A holder may lack what another has: lists and
marks are of all that answer, and a capsule ends where none of them has more, nor had.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, NamedTuple

from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.errors import GdpError, LocalError
from gdp.intervals import LOOK_S, NEVER_S, PROMPT_S
from gdp.limits import COST_UNREACHABLE
from gdp.names import Name
from gdp.service.replication import NEAREST
from gdp.session.protocol.client_core import CALL_TIMEOUT_S, Call, ClientCore
from gdp.session.protocol.errors import NoServerError

_OF_ALL: Final = (Ask.LIST, Ask.MARKS)


class Choice(NamedTuple):
    """At which holder a reading is from now on, and why.

    Attributes:
        costs: of the path to each; None: it is silent or not there.
        failure: of another one; empty: there was none.
    """

    holder: str
    costs: dict[str, int | None]
    failure: str

    def words(self) -> str:
        """Return the choice as a sentence."""
        stated = [
            f"{each} {'does not answer' if cost is None else f'costs {cost}'}" for each, cost in self.costs.items()
        ]
        return f"read at {self.holder}: {', '.join(stated)}{self.failure and f'; {self.failure}'}"


class NearestHolder:
    """Requests of one reading, one after the other.

    Args:
        clients: of the holders' services, by a word for each.

    Attributes:
        choices: at which holders it read, the present one last.
        is_idle: no request is under way, and ``poll_answer`` has nothing.
    """

    def __init__(self, clients: Mapping[str, ClientCore]) -> None:
        self._clients = clients
        self._request = HolderRequest(ask=Ask.LIST)
        self._calls: dict[str, Call] = {}  # of the request
        self._tried: set[str] = set()  # holders that answered it, or refused
        self._owing: set[str] = set()  # as of the latest event
        self._found: HolderAnswer | None = None  # of those that have no more
        self._ends: dict[Name, int] = {}  # of the capsules, as holders stated
        self._failure: GdpError | None = None  # a refusal, or that a holder has gone
        self._now_s, self._until_s = 0.0, NEVER_S
        self._begun_s = NEVER_S  # when the first holder was there
        self.choices: list[Choice] = []
        self.is_idle = True
        self._answer: HolderAnswer | None = None
        self._error: GdpError | None = None

    @property
    def is_done(self) -> bool:
        """Return whether ``poll_answer`` returns an answer, or raises."""
        return self._answer is not None or self._error is not None

    def begin(self, request: HolderRequest, now_s: float) -> None:
        """Begin a request."""
        self._request, self._until_s, self.is_idle = request, now_s + CALL_TIMEOUT_S, False
        self._calls, self._tried, self._found, self._failure = {}, set(), None, None
        self.handle_timer(now_s)

    def poll_answer(self) -> HolderAnswer | None:
        """Return, once, the answer; None: there is none yet. Raises ``GdpError``: no holder has one."""
        answer, error, self.is_idle = self._answer, self._error, self.is_idle or self.is_done
        self._answer = self._error = None
        if error is not None:
            raise error
        return answer

    def handle_timer(self, now_s: float) -> None:
        """Process what the holders answered, and ask the next one where none that owes an answer is heard."""
        if self.is_idle or self.is_done:
            return
        self._now_s = now_s
        for client in self._clients.values():
            client.handle_timer(now_s)
        for holder in [holder for holder, call in self._calls.items() if call.is_done]:
            if not self.is_done:
                self._take(holder, self._calls[holder])
            self._tried.add(holder)
            del self._calls[holder]
        self._owing = self._heard()
        if not self.is_done and not self._owing:
            self._go_on()

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self.is_idle or self.is_done:
            return None
        is_due = any(call.is_done for call in self._calls.values()) or self._heard() != self._owing
        return self._now_s if is_due else self._now_s + LOOK_S

    def _heard(self) -> set[str]:
        """Return the holders that owe an answer, and are not silent."""
        return {each for each in self._calls if (path := self._clients[each].path(self._now_s)) and not path.is_silent}

    def _take(self, holder: str, call: Call) -> None:
        try:
            if call.response is None:
                raise call.error or NoServerError("no answer")
            answer = HolderAnswer.from_cbor(call.response.payload)
        except GdpError as error:
            self._failure = error
            return
        if answer.data and self._request.ask not in _OF_ALL:
            self._answer = answer
            self._ends[self._request.capsule] = max(self._ends.get(self._request.capsule, 0), answer.head)
            if not self.choices or holder != self.choices[-1].holder:
                paths = {each: client.path(self._now_s) for each, client in self._clients.items()}
                costs = {each: None if path is None or path.is_silent else path.cost for each, path in paths.items()}
                self.choices.append(Choice(holder, costs, str(self._failure or "")))
            return
        found = self._found or HolderAnswer()
        descriptors = {each.name: each for each in (*found.descriptors, *answer.descriptors)}
        self._found = replace(
            answer,
            head=max(found.head, answer.head),
            offset=max(found.offset, answer.offset),
            data=found.data + answer.data,
            descriptors=tuple(descriptors.values()),
        )

    def _go_on(self) -> None:
        """Ask the holder of this reading, or the next nearest one; end where none is left."""
        paths = {each: path for each, client in self._clients.items() if (path := client.path(self._now_s))}
        if paths:
            self._begun_s = min(self._begun_s, self._now_s)
        known = [each for each in paths.values() if each.cost < COST_UNREACHABLE or len(self._clients) == 1]
        if len(known) < len(self._clients) and self._now_s < min(self._begun_s + PROMPT_S, self._until_s):
            return  # a nearer one may be found
        chosen = self.choices[-1].holder if self.choices else ""
        is_enough = self._found is not None or bool(self._calls)
        free = [
            (path.is_silent, each != chosen, path.cost, each)
            for each, path in paths.items()
            if each not in self._tried and each not in self._calls and not (is_enough and path.is_silent)
        ]
        if free:
            holder = min(free)[-1]
            call = Call(payload=self._request.to_cbor(), timeout_s=CALL_TIMEOUT_S, replication=NEAREST)
            self._clients[holder].begin(call, self._now_s)
            self._calls[holder] = call
            self._owing = self._heard()
        elif self._found is not None and self._found.offset >= self._ends.get(self._request.capsule, 0):
            self._answer = self._found
        elif not self._calls and (self._failure is not None or self._found is not None):
            self._error = self._failure or LocalError("no holder has the records that one had")
        elif not self._calls and self._now_s >= self._until_s:
            self._error = NoServerError(
                f"{', '.join(self._clients)}: no holder within {CALL_TIMEOUT_S:g} s; start one with 'gdp store serve'"
            )
