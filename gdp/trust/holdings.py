"""Holdings: which certificates what is held here rests on, and who issued them.

Sans-I/O. A revocation concerns a node that holds a certificate of its issuer, and changes only what carries the revoked
fingerprint; both are found without a look at anything else.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable
from typing import Final, Generic, TypeVar

from gdp.trust.claim import Claim

__all__ = ["EvidenceIndex", "Holdings"]

_H = TypeVar("_H", bound=Hashable)
_SWEEP_MIN: Final = 1_024


class EvidenceIndex(Generic[_H]):
    """Holders by fingerprint of their evidence, and how often each issuer's key stands behind it."""

    def __init__(self) -> None:
        self._holders: dict[bytes, list[_H] | dict[_H, None]] = {}  # a list of one where there is one
        self._issuers: dict[bytes, int] = {}

    def put(self, holder: _H, fingerprints: Collection[bytes], issuers: Collection[bytes]) -> None:
        """Note what a holder rests on; it must not be there."""
        for fingerprint in fingerprints:
            known = self._holders.get(fingerprint)
            if known is None:
                self._holders[fingerprint] = [holder]
            elif isinstance(known, list):
                self._holders[fingerprint] = {known[0]: None, holder: None}
            else:
                known[holder] = None
        for issuer in issuers:
            self._issuers[issuer] = self._issuers.get(issuer, 0) + 1

    def remove(self, holder: _H, fingerprints: Collection[bytes], issuers: Collection[bytes]) -> None:
        """Undo ``put`` of the same."""
        for fingerprint in fingerprints:
            known = self._holders[fingerprint]
            if isinstance(known, dict):
                del known[holder]
            if isinstance(known, list) or not known:
                del self._holders[fingerprint]
        for issuer in issuers:
            left = self._issuers[issuer] - 1
            if left:
                self._issuers[issuer] = left
            else:
                del self._issuers[issuer]

    def resting_on(self, fingerprint: bytes) -> list[_H]:
        """Return who rests on a certificate."""
        return list(self._holders.get(fingerprint, ()))

    def has_issuer(self, key: bytes) -> bool:
        """Return whether anything rests on a certificate that this key issued."""
        return key in self._issuers


class Holdings(Generic[_H]):
    """An index of claims that are held in several places; what was let go is swept out now and then.

    Args:
        is_held: whether a holder is still there.
    """

    def __init__(self, is_held: Callable[[_H], bool]) -> None:
        self._is_held = is_held
        self._index = EvidenceIndex[_H]()
        self._of: dict[_H, tuple[frozenset[bytes], frozenset[bytes]]] = {}
        self._sweep_at = _SWEEP_MIN

    def __len__(self) -> int:
        return len(self._of)

    def note(self, holder: _H, claim: Claim) -> None:
        """Note the claim that a holder has now."""
        evidence = claim.fingerprints, claim.issuers
        before = self._of.get(holder)
        if before == evidence:
            return
        if before is not None:
            self._index.remove(holder, *before)
        elif len(self._of) >= self._sweep_at:
            self._sweep()
        self._of[holder] = evidence
        self._index.put(holder, *evidence)

    def resting_on(self, fingerprint: bytes) -> list[_H]:
        """Return the holders, still there, whose claim rests on a certificate."""
        return [holder for holder in self._index.resting_on(fingerprint) if self._is_held(holder)]

    def has_issuer(self, key: bytes) -> bool:
        """Return whether a claim that is held, or was a while ago, rests on a certificate that this key issued."""
        return self._index.has_issuer(key)

    def _sweep(self) -> None:
        """Forget holders that are gone; each is looked at once in a while in which as many new ones came."""
        for holder in [each for each in self._of if not self._is_held(each)]:
            self._index.remove(holder, *self._of.pop(holder))
        self._sweep_at = max(2 * len(self._of), _SWEEP_MIN)
