"""Files of a site that its machines fetch: read, hashed, and the workspace packed.

I/O. A workspace travels as one archive for each package, by content (``workspace.py``). A machine's user data has the
digest of the manifest, so the cloud's API authenticates every file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from fog.software.config import SoftwareConfig
from fog.software.workspace import packed_parts, parts_of, remove_unused
from gdp.errors import LocalError

WHEELS: Final = "wheels"
WORKSPACE: Final = "workspace"
_PARTS: Final = "workspace"  # folder of archives in the scratch folder
_PIECE_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True, order=True)
class _Artifact:
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
    def of(cls, name: str, content: bytes) -> _Artifact:
        """Return the entry of a file with this content."""
        return cls(name, len(content), hashlib.sha256(content).hexdigest())


@dataclass(frozen=True, slots=True)
class Offered:
    """Software of a site at one moment.

    Args:
        manifest: list of the files as JSON, the same bytes for the same files.
        files: SHA-256 in hex -> file with that content.
    """

    manifest: bytes
    files: dict[str, Path]

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the manifest in hex."""
        return hashlib.sha256(self.manifest).hexdigest()


def offered(config: SoftwareConfig, scratch: Path) -> Offered:
    """Read and hash all files; ``scratch``: folder for the archives of the workspace.

    Raises:
        LocalError: a folder has no wheel, or a file cannot be read.
    """
    entries: list[_Artifact] = []
    files: dict[str, Path] = {}
    try:
        for path in _wheels(config):
            _add(f"{WHEELS}/{path.name}", path, entries, files)
        if config.workspace is not None:
            parts = parts_of(config.workspace, config.ignore)
            for name, packed in packed_parts(config.workspace, parts, scratch / _PARTS).items():
                _add(f"{WORKSPACE}/{name}", packed, entries, files)
    except OSError as error:
        raise LocalError(f"software: {error.filename}: {error.strerror}") from error
    return Offered(_manifest_bytes(entries), files)


def signature(config: SoftwareConfig) -> tuple[tuple[str, int, int] | str, ...]:
    """Return a value that changes when a file of the software does: names, sizes and times of all files.

    Raises:
        LocalError: as ``offered``.
    """
    stats = [(str(path), path.lstat()) for path in _wheels(config)]
    parts = [] if config.workspace is None else parts_of(config.workspace, config.ignore)
    return (*((name, has.st_size, has.st_mtime_ns) for name, has in stats), *(part.digest for part in parts))


def remove_unused_archives(config: SoftwareConfig, scratch: Path) -> None:
    """Remove the archives of earlier workspaces; only before machines fetch."""
    parts = [] if config.workspace is None else parts_of(config.workspace, config.ignore)
    remove_unused(parts, scratch / _PARTS)


def _wheels(config: SoftwareConfig) -> list[Path]:
    if config.wheels is None:
        return []
    found = sorted(config.wheels.glob("*.whl"))
    if not found:
        raise LocalError(f"software.wheels: {config.wheels} has no wheel: fill it with `fog wheels {config.wheels}`")
    return found


def _add(name: str, path: Path, entries: list[_Artifact], files: dict[str, Path]) -> None:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while piece := file.read(_PIECE_BYTES):
            digest.update(piece)
            size += len(piece)
    entries.append(_Artifact(name, size, digest.hexdigest()))
    files[digest.hexdigest()] = path


def _manifest_bytes(artifacts: Sequence[_Artifact]) -> bytes:
    """Return the list as JSON, the same bytes for the same files."""
    return json.dumps([asdict(each) for each in sorted(artifacts)], separators=(",", ":")).encode()
