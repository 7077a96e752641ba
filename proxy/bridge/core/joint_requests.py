"""Joint requests: a server gets a request once several clients have sent the same bytes, and all get its response.

Sans-I/O. Source: the two-person rule (NIST SP 800-53, AC-3(2), dual authorization).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gdp.names import Name
from gdp.service.serving import Asked, Serving

_LOOK_AT_LEAST: Final = 64


class JointRequests:
    """Requests of one service that wait for equal ones of other clients.

    Args:
        signers: how many clients must send a request.
        serving: has each of them as a call, until its client's time is over.
    """

    def __init__(self, signers: int, serving: Serving[bytes]) -> None:
        self._signers = signers
        self._serving = serving
        self._groups: dict[bytes, dict[Name, tuple[Asked, int]]] = {}  # by request: each client's newest call
        self._look_at = _LOOK_AT_LEAST  # so many groups, those are forgotten whose calls are over
        self._partners: dict[int, Sequence[int]] = {}  # of a released call: calls that get the same response

    def add(self, now_s: float, patience_s: float | None, asked: Asked, raw: bytes) -> None:
        """Add a request; release it if no other one is missing. Raises ``LocalError`` as ``Serving`` does."""
        number = self._serving.begin(now_s, patience_s, asked, raw, is_held=True)
        if len(self._groups) >= self._look_at:  # each call costs constant time on average
            self._groups = {request: here for request, group in self._groups.items() if (here := self._live(group))}
            self._look_at = max(_LOOK_AT_LEAST, 2 * len(self._groups))
        group = self._groups[raw] = {**self._live(self._groups.get(raw, {})), asked.client: (asked, number)}
        if len(group) >= self._signers:
            del self._groups[raw]
            self._partners[number] = [other for _, other in group.values() if other != number]
            self._serving.release(number)

    def end_partners(self, number: int) -> list[Asked]:
        """End the partners of a call that has ended; return those whose clients wait."""
        ended = map(self._serving.end, self._partners.pop(number, ()))
        return [asked for asked in ended if asked is not None]

    def _live(self, group: dict[Name, tuple[Asked, int]]) -> dict[Name, tuple[Asked, int]]:
        return {client: call for client, call in group.items() if call[0] in self._serving}
