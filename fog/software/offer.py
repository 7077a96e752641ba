"""Files of a site that its machines fetch: read, hashed, and the workspace packed.

I/O. The archive of a workspace is the same bytes for the same files, so a machine that has it is up to date.
"""

from __future__ import annotations

import gzip
import hashlib
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fog.software.config import SoftwareConfig
from fog.software.manifest import Artifact, manifest_bytes
from gdp.errors import LocalError

__all__ = ["WHEELS", "WORKSPACE", "Offered", "offered", "signature"]

WHEELS: Final = "wheels"
WORKSPACE: Final = "workspace.tar.gz"
_PIECE_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Offered:
    """Software of a site at one moment.

    Args:
        manifest: as of ``manifest_bytes``.
        files: SHA-256 in hex -> file with that content.
    """

    manifest: bytes
    files: dict[str, Path]

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the manifest in hex."""
        return hashlib.sha256(self.manifest).hexdigest()


def offered(config: SoftwareConfig, scratch: Path) -> Offered:
    """Read and hash all files; ``scratch``: folder for the archive of the workspace.

    Raises:
        LocalError: a folder has no wheel, or a file cannot be read.
    """
    entries: list[Artifact] = []
    files: dict[str, Path] = {}
    try:
        for path in _wheels(config):
            _add(f"{WHEELS}/{path.name}", path, entries, files)
        if config.workspace is not None:
            packed = scratch / WORKSPACE
            _pack(config.workspace, packed)
            _add(WORKSPACE, packed, entries, files)
    except OSError as error:
        raise LocalError(f"software: {error.filename}: {error.strerror}") from error
    return Offered(manifest_bytes(entries), files)


def signature(config: SoftwareConfig) -> tuple[tuple[str, int, int], ...]:
    """Return a value that changes when a file of the software does: names, sizes and times of all files."""
    paths = [*_wheels(config), *(_below(config.workspace) if config.workspace is not None else ())]
    stats = [(str(path), path.lstat()) for path in paths]
    return tuple((name, has.st_size, has.st_mtime_ns) for name, has in stats)


def _wheels(config: SoftwareConfig) -> list[Path]:
    if config.wheels is None:
        return []
    found = sorted(config.wheels.glob("*.whl"))
    if not found:
        raise LocalError(f"software.wheels: {config.wheels} has no wheel: fill it with `fog wheels {config.wheels}`")
    return found


def _add(name: str, path: Path, entries: list[Artifact], files: dict[str, Path]) -> None:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while piece := file.read(_PIECE_BYTES):
            digest.update(piece)
            size += len(piece)
    entries.append(Artifact(name, size, digest.hexdigest()))
    files[digest.hexdigest()] = path


def _pack(folder: Path, packed: Path) -> None:
    """Write an archive of a folder: sorted, owned by root, without times."""
    with (
        packed.open("wb") as raw,
        gzip.GzipFile(fileobj=raw, mode="wb", filename="", mtime=0) as zipped,
        tarfile.open(fileobj=zipped, mode="w|") as archive,
    ):
        for path in _below(folder):
            entry = archive.gettarinfo(str(path), arcname=str(path.relative_to(folder)))
            entry.uid = entry.gid = entry.mtime = 0
            entry.uname = entry.gname = ""
            if entry.isreg():
                with path.open("rb") as content:
                    archive.addfile(entry, content)
            elif entry.isdir() or entry.issym():
                archive.addfile(entry)


def _below(folder: Path) -> list[Path]:
    """Return what is in a folder, each folder before its content; links are not followed."""
    return sorted(folder.rglob("*"))
