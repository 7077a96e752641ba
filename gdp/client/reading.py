"""Who reads, how far it is, and what comes of it: what a feed and its owner say to each other.

Place: pure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from itertools import count
from typing import NamedTuple

from gdp.client.note_keys import NoteKeys
from gdp.names import Name

__all__ = ["Delivered", "Ended", "FeedState", "Reader"]


class FeedState(Enum):
    """How far a feed is."""

    NEW = "new"
    LIVE = "live"


@dataclass(frozen=True, slots=True)
class Reader:
    """Who reads, in this life of its process: one for all its feeds, since they share its numbers for notes.

    Args:
        notes: its keys for notes.
        introduction: returns the wire form of what proves whose keys they are.
    """

    name: Name
    incarnation: int
    notes: NoteKeys = field(compare=False)
    introduction: Callable[[], bytes] = field(compare=False)
    note_numbers: Iterator[int] = field(default_factory=lambda: count(1), compare=False)


class Delivered(NamedTuple):
    """One message, opened, verified and in its place."""

    publisher: bytes
    incarnation: int  # of the publisher, within which numbers rise
    number: int
    message: bytes
    parts: int
    hops: int
    place: int = 0  # among the messages of one number: several come in one bundle
    sequence: int = 0  # which message of its publisher's life this is, from 1; one that is skipped is lost


class Ended(NamedTuple):
    """Where a feed ended, for another one of the same: what came before is not opened again.

    Args:
        number: of the next message.
        status: the highest seen.
        sequence: of the next message.
        known: the first sequence number of which nothing is known: what lies between was published, and did not come.
        resumes: the feed ended without its reader's will: what it misses meanwhile is lost, and asked for again.
    """

    number: int = 0
    status: int = 0
    sequence: int = 0
    known: int = 0
    resumes: bool = False
