"""List of the files that a machine fetches, each with its size and SHA-256.

Sans-I/O. A machine's user data has the digest of this list, so the cloud's API authenticates every file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

__all__ = ["Artifact", "manifest_bytes"]


@dataclass(frozen=True, slots=True, order=True)
class Artifact:
    """File for a machine.

    Args:
        name: path below the machine's folder of software, such as ``wheels/numpy-2.3.0-cp311-...whl``.
        size: in bytes.
        sha256: 64 hex digits.
    """

    name: str
    size: int
    sha256: str

    @classmethod
    def of(cls, name: str, content: bytes) -> Artifact:
        """Return the entry of a file with this content."""
        return cls(name, len(content), hashlib.sha256(content).hexdigest())


def manifest_bytes(artifacts: Sequence[Artifact]) -> bytes:
    """Return the list as JSON, the same bytes for the same files."""
    return json.dumps([asdict(each) for each in sorted(artifacts)], separators=(",", ":")).encode()
