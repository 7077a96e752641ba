"""Refused neighbours of a port, kept for a message to the operator.

Sans-I/O. Nothing here is proven: a refused certificate may contain anything. So labels serve for reading only, and
their number is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.crypto.certificates import issuer_label
from gdp.errors import DropReason

STRANGERS_MAX: Final = 8  # on one port; the one silent for longest is evicted


@dataclass(slots=True)
class Stranger:
    """A node whose membership is not accepted here.

    Args:
        domain: label of the domain that its certificate names; empty where it cannot be read.
        heard_s: monotonic seconds of its last hello.
    """

    domain: str
    reason: DropReason
    heard_s: float


class Strangers:
    """The refused neighbours of one port."""

    def __init__(self) -> None:
        self._by_membership: dict[bytes, Stranger] = {}

    def record(self, membership: bytes, reason: DropReason, now_s: float) -> None:
        """Remember that a hello with this certificate, DER, was refused."""
        known = self._by_membership.get(membership)
        if known is not None:
            known.reason, known.heard_s = reason, now_s
            return
        if len(self._by_membership) >= STRANGERS_MAX:
            del self._by_membership[min(self._by_membership, key=lambda each: self._by_membership[each].heard_s)]
        self._by_membership[membership] = Stranger(issuer_label(membership), reason, now_s)

    def since(self, begin_s: float) -> list[Stranger]:
        """Return those heard at ``begin_s`` or later."""
        return [each for each in self._by_membership.values() if each.heard_s >= begin_s]
