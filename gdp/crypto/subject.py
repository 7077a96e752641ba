"""Subject: a name together with its proof, which is the digest of its metadata and its owner's key.

Sans-I/O. A ``Subject`` exists only where the hash is right, so it needs no second check. Source:
docs/explanation/design.md, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from gdp.crypto.schema import NAME, Keyed, Spread, octets, or_empty
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata
from gdp.names import OWNER_KEY_BYTES, Name, name_of


@dataclass(frozen=True, slots=True)
class Subject:
    """Subject of an advertisement or a delegation.

    Args:
        digest: SHA-256 of the canonical metadata.
        owner_key: compressed P-256 point, or empty for an unowned name. Its first use shows whether it is a point.

    Raises:
        LocalError: a length is wrong.
    """

    digest: bytes
    owner_key: bytes
    name: Name = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", name_of(self.digest, self.owner_key))

    def __repr__(self) -> str:
        return f"Subject({self.name.short})"

    @classmethod
    def of(cls, metadata: Metadata, owner_key: bytes = b"") -> Subject:
        """Return the subject of this metadata and this owner."""
        return cls(metadata.digest(), owner_key)

    @classmethod
    def proving(cls, name: Name, digest: bytes, owner_key: bytes) -> Subject:
        """Return the subject if its hash is ``name``.

        Raises:
            StatementError: MALFORMED, or WRONG_NAME where the hash differs.
        """
        try:
            subject = cls(digest, owner_key)
        except LocalError as error:
            raise StatementError(DropReason.MALFORMED, str(error)) from error
        subject.expect(name)
        return subject

    def expect(self, name: Name) -> None:
        """Return if it has this name. Raises ``StatementError``: WRONG_NAME."""
        if self.name != name:
            raise StatementError(DropReason.WRONG_NAME, "the hash of metadata and key does not come out")


_KEYS: Final = (Keyed("digest", octets(32)), Keyed("owner", or_empty(octets(OWNER_KEY_BYTES), b"")))
SUBJECT: Final = Spread(_KEYS, Subject, lambda subject: (subject.digest, subject.owner_key))
NAMED_SUBJECT: Final = Spread(
    (Keyed("name", NAME), *_KEYS), Subject.proving, lambda subject: (subject.name, subject.digest, subject.owner_key)
)
