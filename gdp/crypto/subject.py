"""A name together with what proves it: the digest of its metadata and its owner's key.

Place: pure. Holding one means that the hash came out, so nobody need check it again.
Source: docs/explanation/design.md, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.crypto.fields import Fields
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata
from gdp.names import Name, name_of

__all__ = ["Subject"]


@dataclass(frozen=True, slots=True)
class Subject:
    """What a claim or a delegation is about.

    Args:
        digest: SHA-256 of the canonical metadata.
        owner_key: compressed P-256 point, or empty for an unowned name. Whether it is a point shows at its first use.

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
        """Return the subject that this metadata and this owner make."""
        return cls(metadata.digest(), owner_key)

    @classmethod
    def from_fields(cls, fields: Fields, name: Name) -> Subject:
        """Read ``digest`` and ``owner`` of a statement's body and prove ``name`` by them.

        Raises:
            StatementError: MALFORMED, or WRONG_NAME where the hash does not come out.
        """
        return cls.proving(name, fields.bytes_("digest"), fields.bytes_("owner"))

    @classmethod
    def proving(cls, name: Name, digest: bytes, owner_key: bytes) -> Subject:
        """Return the subject if its hash is ``name``.

        Raises:
            StatementError: MALFORMED, or WRONG_NAME where the hash does not come out.
        """
        try:
            subject = cls(digest, owner_key)
        except LocalError as error:
            raise StatementError(DropReason.MALFORMED, str(error)) from error
        if subject.name != name:
            raise StatementError(DropReason.WRONG_NAME, "the hash of metadata and key does not come out")
        return subject

    def to_fields(self) -> dict[str, object]:
        """Return what ``from_fields`` reads, but for the name."""
        return {"digest": self.digest, "owner": self.owner_key}
