"""Revocation store of a node: whose revocations it accepts, how many, and digests of them.

Sans-I/O. Two kinds have quotas of their own. Revocations by *roots*, the trusted domains of the node's policy, are
never displaced by others, and neighbours compare them by digests. Revocations by *owners* (of names, or nodes that
issued a certificate) are accepted only while a certificate of that key is stored here. Each origin, over which they
came, and each issuer has a rate and a share. Where a share or the whole is full, the largest share gives way to a
smaller one. So one sender's junk displaces only its own junk.

A revocation is kept until the certificate would have expired by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import reduce
from hashlib import blake2b, sha256
from operator import xor
from typing import Final, NamedTuple

from gdp.crypto.statements import Statement, assemble
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_set import SyncSet
from gdp.intervals import Rate
from gdp.limits import (
    CERTIFICATE_LIFE_MAX_S,
    CLOCK_SKEW_S,
    REVOCATIONS_OF_OWNERS,
    REVOCATIONS_PER_ISSUER,
    REVOCATIONS_PER_ORIGIN,
    REVOCATIONS_PER_ROOT,
)
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.revocation import Revocation

ID_BYTES: Final = 8
OPERATOR: Final = b""  # the origin of this node's own operator: without a rate, never displaced
_ROOTS_RATE: Final = Rate(1_500.0, burst=4_096.0)  # of one origin; a verification costs about 80 us
_OWNERS_RATE: Final = Rate(16.0, burst=512.0)  # of one origin
_ISSUER_RATE: Final = Rate(4.0, burst=256.0)  # of one owner
_FORGED_COST: Final = 64.0  # tokens for an invalid signature
_UNTIL_BYTES: Final = 8
_SIGNATURE_BYTES: Final = 64

KeptKey = tuple[bytes, bytes]  # the issuer's key, the fingerprint


class Kept(NamedTuple):
    """One stored revocation, for a file."""

    is_root: bool
    origin: bytes
    until_unix_s: int
    wire: bytes


@dataclass(slots=True)
class _Root:
    """The revocations of one root, by fingerprint.

    A value: until when (8 bytes), and the signature, or the whole statement.
    """

    items: SyncSet[bytes] = field(default_factory=lambda: SyncSet(_end_of))
    subject: Subject | None = None


@dataclass(slots=True)
class _Owned:
    """A revocation of an owner."""

    name: Name
    until_unix_s: int
    wire: bytes
    origin: bytes


class Revocations:
    """The revocations that this node has received and that concern it.

    Args:
        root_keys: the trusted domains' compressed keys, those of former roots too.
        per_root, of_owners, per_issuer, per_origin: bounds, see ``limits``.

    Attributes:
        sets: the revocations of each root, by the hash of its key, for neighbours to compare.
        changes: keys that were added or dropped since they were last written down; None: there is no writer.
    """

    def __init__(
        self,
        root_keys: Iterable[bytes],
        *,
        per_root: int = REVOCATIONS_PER_ROOT,
        of_owners: int = REVOCATIONS_OF_OWNERS,
        per_issuer: int = REVOCATIONS_PER_ISSUER,
        per_origin: int = REVOCATIONS_PER_ORIGIN,
    ) -> None:
        self._roots: dict[bytes, _Root] = {}
        self._key_of: dict[bytes, bytes] = {}  # by the hash by which neighbours identify it
        self.sets: dict[bytes, SyncSet[bytes]] = {}
        self.trust(root_keys)
        self._owners: dict[bytes, dict[bytes, _Owned]] = {}  # by the issuer's key and the fingerprint
        self._about: dict[Name, dict[KeptKey, None]] = {}  # of owners, by the name that signed
        self._shares: dict[bytes, dict[bytes, int]] = {}  # number of owners' revocations by origin and issuer's key
        self._owned = 0
        self._per_root = per_root
        self._of_owners = of_owners
        self._per_issuer = per_issuer
        self._per_origin = per_origin
        self._root_rates = TokenBuckets(*_ROOTS_RATE)
        self._owner_rates = TokenBuckets(*_OWNERS_RATE)
        self._issuer_rates = TokenBuckets(*_ISSUER_RATE)
        self._next_end_s = float("inf")  # no revocation ends before, unix seconds
        self.changes: set[KeptKey] | None = None

    def __len__(self) -> int:
        return self._owned + sum(map(len, self.sets.values()))

    def trust(self, root_keys: Iterable[bytes]) -> None:
        """Add trusted domains' keys; known revocations stay."""
        for key in root_keys:
            if key not in self._roots:
                root = self._roots[key] = _Root()
                self._key_of[hash_of(key)] = key
                self.sets[hash_of(key)] = root.items

    def is_root(self, issuer_key: bytes) -> bool:
        """Return whether this is the key of a trusted domain."""
        return issuer_key in self._roots

    def has(self, fingerprint: bytes, issuer_key: bytes) -> bool:
        """Return whether the holder of ``issuer_key`` revoked this certificate."""
        root = self._roots.get(issuer_key)
        if root is not None:
            return root.items.get(fingerprint) is not None
        of_owner = self._owners.get(issuer_key)
        return of_owner is not None and fingerprint in of_owner

    def receive_revocation(
        self, statement: Statement, origin: bytes, now: Timestamps, holds: Callable[[bytes], bool]
    ) -> Revocation | None:
        """Handle a parsed revocation; return it if it is news.

        Args:
            origin: over which it came, and whose share it uses: a node's name, or ``OPERATOR``.
            holds: whether a certificate that a key (33 bytes) issued is stored here.

        Raises:
            StatementError: MALFORMED, WRONG_NAME, EXPIRED, BAD_SIGNATURE, UNCONCERNED (nothing of the issuer is stored
                here; the signature was not checked) or QUOTA.
        """
        revocation = Revocation.read(statement)
        self._check_end(revocation, now.unix_s)
        key, is_root = revocation.issuer.owner_key, self.is_root(revocation.issuer.owner_key)
        if self._until(key, revocation.fingerprint) >= revocation.until_unix_s:
            if origin == OPERATOR and not is_root:
                self._pin(key, revocation.fingerprint)
            return None
        rates = self._root_rates if is_root else self._owner_rates
        if origin != OPERATOR:
            if not rates.spend(origin, now.mono_s):
                raise StatementError(DropReason.QUOTA, "revocations over one neighbour")
            if not is_root and not holds(key):
                raise StatementError(DropReason.UNCONCERNED, "a revocation of whom nothing is held here")
        try:
            revocation.verify(statement)
        except StatementError:
            rates.charge(origin, now.mono_s, _FORGED_COST)
            raise
        if origin != OPERATOR and not is_root and not self._issuer_rates.spend(key, now.mono_s):
            raise StatementError(DropReason.QUOTA, "revocations of one owner")
        self._add(revocation, statement, origin, now.unix_s)
        return revocation

    def restore(self, statement: Statement, origin: bytes, now: Timestamps, *, of_root: bool) -> None:
        """Restore what this node stored in an earlier incarnation: verified, but without a rate.

        Args:
            of_root: it was stored as a trusted domain's, which the domain must still be.

        Raises:
            StatementError: as ``receive_revocation``.
        """
        revocation = Revocation.read(statement)
        if of_root and not self.is_root(revocation.issuer.owner_key):
            raise StatementError(DropReason.UNCONCERNED, "a domain that is trusted no more")
        self._check_end(revocation, now.unix_s)
        revocation.verify(statement)
        if self._until(revocation.issuer.owner_key, revocation.fingerprint) < revocation.until_unix_s:
            self._add(revocation, statement, origin, now.unix_s)

    def expire(self, unix_s: float) -> None:
        """Remove expired revocations."""
        if unix_s < self._next_end_s:
            return
        ended = [key for key in self.keys() if self._until(*key) + CLOCK_SKEW_S < unix_s]
        for key in ended:
            self._remove(*key)
        ends = (self._until(*key) for key in self.keys())
        self._next_end_s = min(ends, default=float("inf")) + CLOCK_SKEW_S

    def keys(self) -> Iterable[KeptKey]:
        """Yield the key of every stored revocation, those of roots first."""
        for key, root in self._roots.items():
            yield from ((key, fingerprint) for fingerprint in root.items)
        for key, of_owner in self._owners.items():
            yield from ((key, fingerprint) for fingerprint in of_owner)

    def kept(self, key: KeptKey) -> Kept | None:
        """Return the revocation stored under a key, or None."""
        issuer_key, fingerprint = key
        wire = self.wire(issuer_key, fingerprint)
        if wire is None:
            return None
        until_unix_s = self._until(issuer_key, fingerprint)
        if self.is_root(issuer_key):
            return Kept(True, OPERATOR, until_unix_s, wire)
        return Kept(False, self._owners[issuer_key][fingerprint].origin, until_unix_s, wire)

    def wire(self, issuer_key: bytes, fingerprint: bytes) -> bytes | None:
        """Return the signed statement that revoked a certificate, or None."""
        root = self._roots.get(issuer_key)
        if root is None:
            owned = self._owners.get(issuer_key, {}).get(fingerprint)
            return None if owned is None else owned.wire
        value = root.items.get(fingerprint)
        return None if value is None else _unpacked(root, fingerprint, value)

    # -- revocations by owners, by name

    def about(self, name: Name) -> list[bytes]:
        """Return the signed revocations by the owner of a name, or by the node of that name, in that name."""
        return [self._owners[key][fingerprint].wire for key, fingerprint in self._about.get(name, ())]

    def digest_about(self, name: Name) -> bytes:
        """Return a digest of ``about``; zeros for nothing."""
        entries = self._about.get(name, ())
        ids = (_id(fingerprint, self._owners[key][fingerprint].until_unix_s) for key, fingerprint in entries)
        return reduce(xor, ids, 0).to_bytes(ID_BYTES, "big")

    def item_of(self, of: bytes, fingerprint: bytes, _now_s: float) -> bytes | None:
        """Return the signed statement of a root's revocation, for a neighbour that lacks it, or None."""
        return self.wire(self._key_of[of], fingerprint)

    # -- quotas

    @staticmethod
    def _check_end(revocation: Revocation, unix_s: float) -> None:
        if revocation.until_unix_s + CLOCK_SKEW_S < unix_s:
            raise StatementError(DropReason.EXPIRED, "a revocation of what has run out")
        if revocation.until_unix_s > unix_s + CERTIFICATE_LIFE_MAX_S:
            raise StatementError(DropReason.MALFORMED, "a revocation for longer than any certificate holds")

    def _until(self, issuer_key: bytes, fingerprint: bytes) -> int:
        """Return until when a revocation counts, or -1."""
        root = self._roots.get(issuer_key)
        if root is not None:
            value = root.items.get(fingerprint)
            return -1 if value is None else _end_of(value)
        owned = self._owners.get(issuer_key, {}).get(fingerprint)
        return -1 if owned is None else owned.until_unix_s

    def _add(self, revocation: Revocation, statement: Statement, origin: bytes, unix_s: float) -> None:
        self.expire(unix_s)
        issuer_key, fingerprint = revocation.issuer.owner_key, revocation.fingerprint
        root = self._roots.get(issuer_key)
        if root is not None:
            self._add_of_root(root, revocation, statement)
        else:
            self._add_of_owner(revocation, statement, origin)
        self._next_end_s = min(self._next_end_s, revocation.until_unix_s + CLOCK_SKEW_S)
        if self.changes is not None:
            self.changes.add((issuer_key, fingerprint))

    def _add_of_root(self, root: _Root, revocation: Revocation, statement: Statement) -> None:
        fingerprint = revocation.fingerprint
        if root.items.get(fingerprint) is None and len(root.items) >= self._per_root:
            raise StatementError(DropReason.QUOTA, "revocations of one domain")
        root.subject = root.subject or revocation.issuer
        root.items.put(fingerprint, _packed(root, revocation, statement))

    def _add_of_owner(self, revocation: Revocation, statement: Statement, origin: bytes) -> None:
        issuer_key, fingerprint = revocation.issuer.owner_key, revocation.fingerprint
        known = self._owners.get(issuer_key, {}).get(fingerprint)
        if known is not None:
            origin = OPERATOR if OPERATOR in (origin, known.origin) else known.origin
            self._remove(issuer_key, fingerprint)
        elif origin != OPERATOR:
            self._free_space(issuer_key, origin)
        owned = _Owned(revocation.issuer.name, revocation.until_unix_s, statement.wire, origin)
        self._put_owned(issuer_key, fingerprint, owned)

    def _pin(self, issuer_key: bytes, fingerprint: bytes) -> None:
        """Make the operator the origin of a stored revocation: it is never displaced."""
        owned = self._owners[issuer_key][fingerprint]
        if owned.origin != OPERATOR:
            self._remove(issuer_key, fingerprint)
            self._put_owned(issuer_key, fingerprint, replace(owned, origin=OPERATOR))

    def _put_owned(self, issuer_key: bytes, fingerprint: bytes, owned: _Owned) -> None:
        self._owners.setdefault(issuer_key, {})[fingerprint] = owned
        self._about.setdefault(owned.name, {})[issuer_key, fingerprint] = None
        share = self._shares.setdefault(owned.origin, {})
        share[issuer_key] = share.get(issuer_key, 0) + 1
        self._owned += 1

    def _free_space(self, issuer_key: bytes, origin: bytes) -> None:
        """Make space for one more revocation of an owner.

        Raises:
            StatementError: QUOTA: the share to displace is no larger than this origin's, or this owner's.
        """
        if len(self._owners.get(issuer_key, ())) >= self._per_issuer:
            raise StatementError(DropReason.QUOTA, "revocations of one owner")
        own = self._shares.get(origin, {})
        if sum(own.values()) >= self._per_origin and not self._give_way(origin, upstream=own.get(issuer_key, 0) + 1):
            raise StatementError(DropReason.QUOTA, "revocations over one neighbour")
        if self._owned < self._of_owners:
            return
        held = sum(own.values()) + 1
        others = {each: sum(share.values()) for each, share in self._shares.items() if each != OPERATOR}
        most = max(others, key=lambda each: others[each], default=origin)
        upstream = own.get(issuer_key, 0) + 1 if most == origin else 0
        if (most != origin and others[most] <= held) or not self._give_way(most, upstream=upstream):
            raise StatementError(DropReason.QUOTA, "revocations of owners")

    def _give_way(self, origin: bytes, upstream: int) -> bool:
        """Drop the oldest revocation of the owner with most of an origin's share, if that is more than ``upstream``."""
        share = self._shares.get(origin, {})
        issuer_key = max(share, key=lambda key: share[key], default=None)
        if issuer_key is None or share[issuer_key] <= upstream:
            return False
        entries = self._owners[issuer_key].items()
        self._remove(issuer_key, next(fingerprint for fingerprint, owned in entries if owned.origin == origin))
        return True

    def _remove(self, issuer_key: bytes, fingerprint: bytes) -> None:
        if self.changes is not None:
            self.changes.add((issuer_key, fingerprint))
        root = self._roots.get(issuer_key)
        if root is not None:
            root.items.remove(fingerprint)
            return
        owned = self._owners[issuer_key].pop(fingerprint)
        if not self._owners[issuer_key]:
            del self._owners[issuer_key]
        del self._about[owned.name][issuer_key, fingerprint]
        if not self._about[owned.name]:
            del self._about[owned.name]
        share = self._shares[owned.origin]
        share[issuer_key] -= 1
        if not share[issuer_key]:
            del share[issuer_key]
        if not share:
            del self._shares[owned.origin]
        self._owned -= 1


def hash_of(root_key: bytes) -> Name:
    """Return the hash by which neighbours identify a root: a domain may have had several."""
    return Name(sha256(root_key).digest())


def _id(fingerprint: bytes, until_unix_s: int) -> int:
    hashed = blake2b(fingerprint + until_unix_s.to_bytes(_UNTIL_BYTES, "big"), digest_size=ID_BYTES)
    return int.from_bytes(hashed.digest(), "big")


def _end_of(value: bytes) -> int:
    return int.from_bytes(value[:_UNTIL_BYTES], "big")


def _packed(root: _Root, revocation: Revocation, statement: Statement) -> bytes:
    """Return the stored form: a statement of the usual form can be rebuilt from few bytes."""
    until = revocation.until_unix_s.to_bytes(_UNTIL_BYTES, "big")
    short = until + statement.signature
    is_usual = _unpacked(root, revocation.fingerprint, short) == statement.wire
    return short if is_usual else until + statement.wire


def _unpacked(root: _Root, fingerprint: bytes, value: bytes) -> bytes:
    if len(value) != _UNTIL_BYTES + _SIGNATURE_BYTES or root.subject is None:
        return value[_UNTIL_BYTES:]
    body = Revocation(fingerprint, root.subject, _end_of(value))
    return assemble(body.TYPE, body.to_fields(), root.subject.name, value[_UNTIL_BYTES:])
