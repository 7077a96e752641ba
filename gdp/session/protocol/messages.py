"""Messages, requests and responses of a session, and the names that its node may use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias, Union

from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.right import Right

Paths = Literal[1, 2, "spread"]
Sign = Literal["always", "session"]
NameLike: TypeAlias = Union[str, Name, Metadata]  # noqa: UP007 (typing.get_type_hints on 3.10)
"""A name: the ``name`` of its metadata, 64 hex digits, a ``Name``, or the metadata."""


class Message(NamedTuple):
    """A published message as a subscriber receives it.

    Attributes:
        payload: the published bytes.
        publisher: name of the node that published it, proven by its signature.
        number: its number within the publisher's present incarnation, from 1; a gap is a lost message.
        hops: links between switches that it crossed.
        stamp_ns: when it was published, by the publisher's clock, in nanoseconds since 1970.
    """

    payload: bytes
    publisher: Name
    number: int
    hops: int
    stamp_ns: int

    @property
    def stamp(self) -> float:
        """Return when it was published, by the publisher's clock, in seconds since 1970."""
        return self.stamp_ns / 1e9


class Request(NamedTuple):
    """A request as a server's handler receives it.

    Attributes:
        payload: the bytes that the client sent.
        client: name of the client's node, proven by its signature.
    """

    payload: bytes
    client: Name


class Response(NamedTuple):
    """The response to a call.

    Attributes:
        payload: the bytes that the server's handler returned.
        server: name of the server's node, proven by its signature.
    """

    payload: bytes
    server: Name


class DelegatedName(NamedTuple):
    """A name that the node holds a delegation for.

    Attributes:
        name: the 256-bit name.
        rights: what the node may do with it.
        metadata: the metadata of the name, if its owner added them.
    """

    name: Name
    rights: frozenset[Right]
    metadata: Metadata | None

    @property
    def label(self) -> str:
        """Return the ``name`` of the metadata, or the first and last digits of the name."""
        return self.name.short if self.metadata is None else str(self.metadata.get("name", self.name.short))


def describe(names: Sequence[DelegatedName]) -> str:
    """Return names with their rights as one line for an error."""
    each = (f"{name.label} ({', '.join(sorted(right.value for right in name.rights))})" for name in names)
    return ", ".join(each) or "none"
