"""Name: 256 bits, their derivation, and their text form.

Sans-I/O. Source: docs/explanation/design.md, section 2:
``name = SHA-256("gdp-name-1" || SHA-256(canonical metadata) || owner public key)``.
"""

from __future__ import annotations

import hashlib
from typing import Final

from gdp.errors import LocalError

NAME_BYTES: Final = 32
OWNER_KEY_BYTES: Final = 33  # a compressed P-256 point; SEC 1, section 2.3.3
_PREFIX: Final = b"gdp-name-1"


class Name(bytes):
    """Thirty-two bytes; equal to, and hashed like, the same plain bytes, so a slice of a frame finds it in a table.

    Raises:
        LocalError: not exactly 32 bytes.
    """

    __slots__ = ()

    def __new__(cls, value: bytes | bytearray | memoryview) -> Name:  # noqa: D102  # the class has it
        name = super().__new__(cls, value)
        if len(name) != NAME_BYTES:
            raise LocalError(f"a name has {NAME_BYTES} bytes, not {len(name)}")
        return name

    @classmethod
    def from_text(cls, text: str) -> Name:
        """Read 64 hex digits. Raises ``LocalError``: anything else."""
        if len(text) != 2 * NAME_BYTES or not set(text) <= set("0123456789abcdefABCDEF"):
            raise LocalError(f"a name is written as {2 * NAME_BYTES} hex digits")
        return cls(bytes.fromhex(text))

    def to_text(self) -> str:
        """Return 64 hex digits, leading zeros kept."""
        return self.hex()

    @property
    def short(self) -> str:
        """Return the form for people, such as ``75e…0fc``. Not unique; never parse it."""
        text = self.hex()
        return f"{text[:3]}…{text[-3:]}"

    def __repr__(self) -> str:
        return f"Name({self.short})"

    __str__ = to_text


ZERO: Final = Name(bytes(NAME_BYTES))


def name_of(metadata_digest: bytes, owner_key: bytes) -> Name:
    """Return the name of a metadata digest and an owner's key.

    Args:
        metadata_digest: SHA-256 of the canonical metadata, 32 bytes.
        owner_key: compressed P-256 point, 33 bytes, or empty for an unowned name.

    Raises:
        LocalError: a length is wrong.
    """
    if len(metadata_digest) != 32 or len(owner_key) not in (0, OWNER_KEY_BYTES):
        raise LocalError("a name is made of a 32-byte digest and a key of 33 bytes or none")
    return Name(hashlib.sha256(_PREFIX + metadata_digest + owner_key).digest())
