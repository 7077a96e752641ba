"""Control keys of one incarnation of a participant: the secret that it shares with each incarnation of a peer.

Sans-I/O. Computed secrets are cached, within bounds.
"""

from __future__ import annotations

from typing import Final

from gdp.crypto.exchange import ExchangeKey
from gdp.crypto.introduction import Introduction
from gdp.names import Name
from gdp.trust.lru import Lru

_REMEMBERED: Final = 4_096
_PURPOSE: Final = b"gdp-note-shared-1"


class ControlKeys:
    """X25519 key that is created for this incarnation, and the secrets derived from it; ``public``: 32 bytes."""

    def __init__(self, exchange: ExchangeKey) -> None:
        self._exchange, self.public = exchange, exchange.public
        self._shared: Lru[bytes] = Lru(_REMEMBERED)  # by the other's public key
        self._introduced: Lru[Introduction] = Lru(_REMEMBERED)

    def shared(self, far_public: bytes) -> bytes:
        """Return the 32 bytes shared with the holder of another key; the first call for a key takes about 0.1 ms.

        Raises:
            StatementError: MALFORMED, it is no key, or one that makes a publicly known secret.
        """
        shared = self._shared.get(far_public)
        if shared is None:
            (shared,) = self._exchange.agree(far_public, _PURPOSE)
            self._shared.put(far_public, shared)
        return shared

    def introduced(self, wire: bytes, name: Name, incarnation: int) -> Introduction:
        """Return a verified introduction of a reader. Raises ``StatementError``: it is invalid."""
        key = name + incarnation.to_bytes(8, "big") + wire
        introduction = self._introduced.get(key)
        if introduction is None:
            introduction = Introduction.from_wire(wire, name, incarnation)
            self._introduced.put(key, introduction)
        return introduction
