"""Who publishes, and with which secrets.

Place: pure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gdp.client.note_keys import NoteKeys
from gdp.crypto.envelope import Signer
from gdp.names import Name

__all__ = ["Secrets", "Source"]

Secrets = Mapping[int, bytes]  # key epoch -> topic secret, 32 bytes


@dataclass(frozen=True, slots=True)
class Source:
    """Who publishes, in this life of its process.

    Args:
        random_bytes: the system's randomness, asked for each message that is sealed.
        notes: its keys for the notes of readers.
    """

    name: Name
    incarnation: int
    signer: Signer
    random_bytes: Callable[[int], bytes]
    notes: NoteKeys
