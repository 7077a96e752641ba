"""Revocations at a RIB: which it stores, which routes they close, and which nodes receive them.

Sans-I/O. A RIB stores revocations by trusted domains, and an owner's revocations for a name that is stored or watched
here. It sends them to the nodes that advertised, hold or watch that name, in the tiers above and below. Later askers
about the name receive them, too. A revocation that concerns nothing here is only forwarded to the tier above, at a
bounded rate, and is not stored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gdp.crypto.statements import Statement
from gdp.errors import StatementError
from gdp.names import Name
from gdp.rib.route import Route
from gdp.rib.store import Store
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.revocation import Revocation
from gdp.trust.verifier import AdvertisementVerifier

__all__ = ["RibRevocations"]

_PASSED_PER_S, _PASSED_BURST = 8.0, 128.0  # forwarded to the tier above, of one sender
_SENT_PER_S, _SENT_BURST = 64.0, 2_048.0  # to one asker, of what it lacks
_SENT_ABOUT_MAX: Final = 1_024  # in one response


class RibRevocations:
    """Handles revocations for one RIB.

    Args:
        is_watched: whether any node watches a name.
    """

    def __init__(self, verifier: AdvertisementVerifier, store: Store, is_watched: Callable[[Name], bool]) -> None:
        self._verifier = verifier
        self._revoked = verifier.revoked
        self._store = store
        self._is_watched = is_watched
        self._passed = TokenBuckets(_PASSED_PER_S, _PASSED_BURST)
        self._reported = TokenBuckets(_SENT_PER_S, _SENT_BURST)

    def receive_revocation(self, statement: Statement, origin: Name, now: Timestamps) -> Revocation | None:
        """Handle a revocation; return it if it is news.

        Raises:
            StatementError: it is not valid, concerns nothing here (UNCONCERNED), or exceeds a quota.
            StoreError: a shared store did not respond.
        """
        issued_for = Revocation.read(statement).issuer.name
        return self._revoked.receive_revocation(
            statement, origin, now, lambda key: self._store.has_issuer(key) or self._concerns(issued_for)
        )

    def closed(self, revocation: Revocation, now: Timestamps) -> list[Route]:
        """Return the routes that depend on what was revoked, and are no longer valid."""
        closed = []
        for route in self._store.resting_on(revocation.fingerprint):
            try:
                self._verifier.verify(route.advertisement, now.unix_s)
            except StatementError:
                closed.append(route)
        return closed

    def may_pass_up(self, statement: Statement, sender: Name, now: Timestamps) -> bool:
        """Return whether a revocation that is not stored here goes on to the tier above.

        Raises:
            StatementError: its signature is not valid.
        """
        if not self._passed.spend(sender, now.mono_s):
            return False
        Revocation.from_statement(statement)
        return True

    def lacked_by(self, asker: Name, name: Name, digest: bytes, now_s: float) -> list[bytes]:
        """Return the revocations about a name that an asker lacks, given the digest of what it has."""
        if digest == self._revoked.digest_about(name):
            return []
        wires = self._revoked.about(name)[:_SENT_ABOUT_MAX]
        return [wire for wire in wires if self._reported.spend(asker, now_s)]

    def behind(self, fingerprints: list[tuple[bytes, bytes]]) -> list[bytes]:
        """Return the statements that revoked these certificates, each a fingerprint and a key that may revoke it."""
        found = (self._revoked.wire(key, fingerprint) for fingerprint, key in fingerprints)
        return [wire for wire in found if wire is not None]

    def _concerns(self, name: Name) -> bool:
        return self._is_watched(name) or bool(self._store.routes(name))
