"""Who publishes, and with which secrets.

Place: pure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gdp.crypto.envelope import Signer
from gdp.names import Name

__all__ = ["Secrets", "Source"]

Secrets = Mapping[int, bytes]  # key epoch -> topic secret, 32 bytes


@dataclass(frozen=True, slots=True)
class Source:
    """Who publishes, in this life of its process."""

    name: Name
    incarnation: int
    signer: Signer
