"""The keys of one life of a member for notes: what it shares with each life of another.

Sans-I/O; remembers what it computed, within bounds.
"""

from __future__ import annotations

from typing import Final

from gdp.crypto.exchange import ExchangeKey
from gdp.crypto.introduction import Introduction
from gdp.names import Name
from gdp.trust.lru import Lru

__all__ = ["ControlKeys"]

_REMEMBERED: Final = 4_096
_PURPOSE: Final = b"gdp-note-shared-1"


class ControlKeys:
    """An X25519 key that is drawn for this life, and what comes of it."""

    def __init__(self, exchange: ExchangeKey) -> None:
        self._exchange = exchange
        self._shared: Lru[bytes] = Lru(_REMEMBERED)  # by the other's public key
        self._introduced: Lru[Introduction] = Lru(_REMEMBERED)

    @property
    def public(self) -> bytes:
        """Return the public key, 32 bytes."""
        return self._exchange.public

    def shared(self, far_public: bytes) -> bytes:
        """Return the 32 bytes that this life and the holder of another key share; about 0.1 ms, the first time.

        Raises:
            StatementError: MALFORMED, it is no key, or one that makes a secret that everybody knows.
        """
        shared = self._shared.get(far_public)
        if shared is None:
            (shared,) = self._exchange.agree(far_public, _PURPOSE)
            self._shared.put(far_public, shared)
        return shared

    def introduced(self, wire: bytes, name: Name, incarnation: int) -> Introduction:
        """Return what a reader says of itself, verified.

        Raises:
            StatementError: it does not hold.
        """
        key = name + incarnation.to_bytes(8, "big") + wire
        introduction = self._introduced.get(key)
        if introduction is None:
            introduction = Introduction.from_wire(wire, name, incarnation)
            self._introduced.put(key, introduction)
        return introduction
