"""Rights of a node on a name."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from enum import Enum
from types import MappingProxyType
from typing import Final

from gdp.crypto.schema import many, mapped, one_of
from gdp.errors import LocalError


class Right(str, Enum):
    """One right. ``ATTACH`` is the right of a node on its own name, and cannot be delegated."""

    PUBLISH = "publish"
    SERVE = "serve"
    CALL = "call"
    READ = "read"
    ATTACH = "attach"


RIGHT: Final = one_of(Right)
DELEGABLE: Final = frozenset({Right.PUBLISH, Right.SERVE, Right.CALL, Right.READ})
HEARS: Final = MappingProxyType({Right.READ: Right.PUBLISH, Right.SERVE: Right.CALL, Right.CALL: Right.SERVE})
"""Who hears whom on one name: a node that claims the first gets what those that claim the second send to it."""


def right_on(kind: object, *, gives: bool) -> Right:
    """Return the right to give a name of a kind of ROS to others (``gives``), or to use it."""
    if kind == "topic":
        return Right.PUBLISH if gives else Right.READ
    return Right.SERVE if gives else Right.CALL


def _sorted(rights: Collection[Right]) -> tuple[Right, ...]:
    """Return rights as they are sent. Raises ``LocalError``: none, or one that cannot be delegated."""
    if not rights or not DELEGABLE.issuperset(rights):
        raise LocalError("the rights to delegate are one or more of publish, serve, call and read")
    return tuple(sorted(set(rights)))


def _delegable(rights: Collection[Right]) -> frozenset[Right]:
    if not rights or not DELEGABLE.issuperset(rights):
        raise ValueError("rights that cannot be delegated")
    return frozenset(rights)


RIGHTS: Final = replace(mapped(many(RIGHT, len(DELEGABLE)), _delegable, _sorted), edges=([], ["read"]))
