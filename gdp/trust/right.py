"""Rights of a node on a name.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum
from types import MappingProxyType
from typing import Final

from gdp.crypto.fields import Fields
from gdp.crypto.schema import Form, text
from gdp.errors import DropReason, LocalError, StatementError

__all__ = ["DELEGABLE", "HEARS", "RIGHT", "Right", "rights_from_fields", "rights_to_wire"]


class Right(str, Enum):
    """One right. ``ATTACH`` is the right of a node on its own name, and cannot be delegated."""

    PUBLISH = "publish"
    SERVE = "serve"
    CALL = "call"
    READ = "read"
    ATTACH = "attach"

    @classmethod
    def from_wire(cls, text: str) -> Right:
        """Read a right. Raises ``StatementError``: MALFORMED, an unknown one."""
        try:
            return cls(text)
        except ValueError as error:
            raise StatementError(DropReason.MALFORMED, "an unknown right") from error


RIGHT: Final = Form("a right", lambda value: Right(text(16).read(value)), lambda right: right.value)
DELEGABLE: Final = frozenset({Right.PUBLISH, Right.SERVE, Right.CALL, Right.READ})
HEARS: Final = MappingProxyType({Right.READ: Right.PUBLISH, Right.SERVE: Right.CALL, Right.CALL: Right.SERVE})
"""Who hears whom on one name: a node that claims the first gets what those that claim the second send to it."""


def rights_to_wire(rights: Collection[Right]) -> list[str]:
    """Return the sorted texts of a set of rights. Raises ``LocalError``: none, or one that cannot be delegated."""
    if not rights or not DELEGABLE.issuperset(rights):
        raise LocalError("the rights to delegate are one or more of publish, serve, call and read")
    return sorted({right.value for right in rights})


def rights_from_fields(fields: Fields, key: str) -> frozenset[Right]:
    """Read a set of delegable rights; a malformed one raises ``StatementError``."""
    rights = frozenset(Right.from_wire(text) for text in fields.texts(key, len(DELEGABLE)))
    if not rights or not rights <= DELEGABLE:
        raise StatementError(DropReason.MALFORMED, "rights that cannot be delegated")
    return rights
