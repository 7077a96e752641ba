"""Files with endpoint records, ``*.endpoints``: what a switch states about itself, and what it reads about its peers.

I/O.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.crypto.identity import Identity
from gdp.crypto.tunnel_key import TunnelKey

RECORD_SUFFIX: Final = ".endpoints"


def own_record(
    identity: Identity, uplinks: int, candidates: Sequence[Candidate], *, sequence: int | None = None
) -> EndpointRecord:
    """Return the record that a switch signs about itself; it is valid as long as its membership.

    Args:
        uplinks: how many of them have tunnels, at least 1.
        sequence: None: milliseconds since 1970.
    """
    keys = tuple(TunnelKey.derive(identity.kem, uplink).public for uplink in range(uplinks))
    return EndpointRecord.make(
        identity,
        keys,
        tuple(candidates),
        sequence=time.time_ns() // 1_000_000 if sequence is None else sequence,
        until_unix_s=identity.member.not_after_unix_s,
    )


def public_candidates(endpoints: Sequence[Endpoint], uplinks: int = 1) -> tuple[Candidate, ...]:
    """Return the endpoints that an operator states; each further uplink listens on the next port."""
    return tuple(
        Candidate(uplink, CandidateType.PUBLIC, endpoint._replace(port=endpoint.port + uplink))
        for uplink in range(uplinks)
        for endpoint in endpoints
    )


def record_files(folder: Path) -> Iterator[tuple[Path, tuple[int, int]]]:
    """Yield the record files of a folder, each with its size in bytes and time of change in ns."""
    with contextlib.suppress(FileNotFoundError):  # a folder that is removed holds no peers
        for path in sorted(folder.glob(f"*{RECORD_SUFFIX}")):
            with contextlib.suppress(FileNotFoundError):
                found = path.stat()
                yield path, (found.st_size, found.st_mtime_ns)
