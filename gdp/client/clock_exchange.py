"""Exchange of stamps with the publishers and servers that a member hears, so that it knows the offsets of their clocks.

Sans-I/O. One small request and its reply suffice for each of them, however many names it has; the reply is that of
``gdp ping``. The first ones follow each other fast, because each may have waited in a queue.
"""

from __future__ import annotations

from typing import Final

from gdp.client.participant import Participant
from gdp.intervals import POLL_S
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.sansio import Timestamps

_PAUSES: Final = Backoff(POLL_S, 2 * POLL_S)
_REQUESTS_MAX: Final = 16  # of one turn


class ClockExchange:
    """Requests for stamps, by member."""

    def __init__(self, member: Participant) -> None:
        self._member = member
        self._requests = Requests[Name]()

    def work(self, now: Timestamps) -> None:
        """Send the requests that are due."""
        requests, known = self._requests, {each.publisher for each in self._member.subscriptions.writer_proxies()}
        for name in requests.keys() - known:
            requests.cancel(name)
        for name in known - requests.keys():
            requests.start(name, now.mono_s)
        for name in requests.poll_due(now.mono_s, _REQUESTS_MAX):
            self._member.diagnostics.ask(name, "ping", now=now, on_reply=lambda *_: None, timeout_s=POLL_S)
            requests.sent(name, now.mono_s, _PAUSES)
