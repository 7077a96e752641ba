"""Evidence index: which certificates stored state depends on, and which keys issued them.

Sans-I/O. A revocation concerns a node that stores a certificate of its issuer, and changes only what carries the
revoked fingerprint. Both are found without visiting anything else.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Final, Generic, TypeVar

from gdp.trust.advertisement import Advertisement

_H = TypeVar("_H", bound=Hashable)
_SWEEP_MIN: Final = 1_024


class EvidenceIndex(Generic[_H]):
    """Holders by the fingerprints (32 bytes) of their evidence, and by the keys (33 bytes) that issued it."""

    def __init__(self) -> None:
        self._holders: dict[bytes, list[_H] | dict[_H, None]] = {}  # a list where there is only one

    def put(self, holder: _H, marks: Iterable[bytes]) -> None:
        """Record what a holder depends on, fingerprints and keys; the holder must not be there."""
        for mark in marks:
            known = self._holders.get(mark)
            if known is None:
                self._holders[mark] = [holder]
            elif isinstance(known, list):
                self._holders[mark] = {known[0]: None, holder: None}
            else:
                known[holder] = None

    def remove(self, holder: _H, marks: Iterable[bytes]) -> None:
        """Remove a holder and its marks, the same as in ``put``."""
        for mark in marks:
            known = self._holders[mark]
            if isinstance(known, dict):
                del known[holder]
            if isinstance(known, list) or not known:
                del self._holders[mark]

    def resting_on(self, mark: bytes) -> list[_H]:
        """Return the holders that depend on a certificate, or on any that a key issued."""
        return list(self._holders.get(mark, ()))

    def has(self, mark: bytes) -> bool:
        """Return whether any holder depends on a certificate, or on one that a key issued."""
        return mark in self._holders


class Holdings(Generic[_H]):
    """Index of advertisements that are stored in several tables; removed ones are swept out periodically.

    Args:
        is_held: whether a holder is still there.
    """

    def __init__(self, is_held: Callable[[_H], bool]) -> None:
        self._is_held = is_held
        self._index = EvidenceIndex[_H]()
        self._of: dict[_H, frozenset[bytes]] = {}
        self._sweep_at = _SWEEP_MIN

    def __len__(self) -> int:
        return len(self._of)

    def record(self, holder: _H, advertisement: Advertisement) -> None:
        """Record the present advertisement of a holder."""
        evidence = advertisement.fingerprints | advertisement.issuers
        before = self._of.get(holder)
        if before == evidence:
            return
        if before is not None:
            self._index.remove(holder, before)
        elif len(self._of) >= self._sweep_at:
            self._sweep()
        self._of[holder] = evidence
        self._index.put(holder, evidence)

    def resting_on(self, fingerprint: bytes) -> list[_H]:
        """Return the holders, still there, whose advertisement depends on a certificate."""
        return [holder for holder in self._index.resting_on(fingerprint) if self._is_held(holder)]

    def has_issuer(self, key: bytes) -> bool:
        """Return whether a present or recently removed advertisement depends on a certificate that this key issued."""
        return self._index.has(key)

    def _sweep(self) -> None:
        """Remove holders that are gone; each is checked once per as many new holders as there are."""
        for holder in [each for each in self._of if not self._is_held(each)]:
            self._index.remove(holder, self._of.pop(holder))
        self._sweep_at = max(2 * len(self._of), _SWEEP_MIN)
