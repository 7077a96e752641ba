"""Workspace as archives by content: one for each package, so that a change is packed and sent alone.

I/O. A part is a folder at the top of the workspace, or all files there. Its archive is the same bytes for the same
files. Archives are kept by a digest of names, sizes, times and modes, so an unchanged part is not read again.
"""

from __future__ import annotations

import fnmatch
import gzip
import hashlib
import os
import stat
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.errors import LocalError

IGNORE_FILE: Final = ".fogignore"  # at the top of the workspace: more patterns, one a line
_TOP: Final = "top"
_FOLDER_PREFIX: Final = "d-"
_SUFFIX: Final = ".tar.gz"


@dataclass(frozen=True, slots=True)
class Part:
    """Files that travel in one archive.

    Args:
        name: of the archive without its ending.
        paths: each folder before its content.
        digest: changes when a file does.
    """

    name: str
    paths: tuple[Path, ...]
    digest: str


def parts_of(workspace: Path, ignore: Sequence[str]) -> list[Part]:
    """Return the parts of a workspace.

    Args:
        ignore: patterns of what is left out, in addition to those of ``.fogignore``. One without a slash is about any
            name at any depth, one with a slash about a path from the top. A slash at its end: folders only.

    Raises:
        LocalError: a file cannot be read.
    """
    try:
        patterns = (*ignore, *_stated(workspace / IGNORE_FILE))
        found: dict[str, list[Path]] = {}
        for path in _below(workspace, workspace, patterns):
            first = workspace / path.relative_to(workspace).parts[0]
            is_folder = first.is_dir() and not first.is_symlink()
            found.setdefault(f"{_FOLDER_PREFIX}{first.name}" if is_folder else _TOP, []).append(path)
        return [Part(name, tuple(paths), _digest(workspace, paths)) for name, paths in sorted(found.items())]
    except (OSError, UnicodeDecodeError) as error:
        raise LocalError(f"software.workspace: {error}") from error


def packed_parts(workspace: Path, parts: Sequence[Part], folder: Path) -> dict[str, Path]:
    """Return name and archive of each part; only what changed is packed.

    Args:
        folder: of archives, by digest.

    Raises:
        OSError: a file cannot be read, or the archive cannot be written.
    """
    folder.mkdir(mode=0o700, exist_ok=True)
    packed = {}
    for part in parts:
        archive = folder / f"{part.digest}{_SUFFIX}"
        if not archive.exists():
            unfinished = archive.with_suffix(".part")
            _pack(workspace, part.paths, unfinished)
            unfinished.rename(archive)
        packed[f"{part.name}{_SUFFIX}"] = archive
    return packed


def remove_unused(parts: Sequence[Part], folder: Path) -> None:
    """Remove archives of earlier workspaces; only before machines fetch."""
    kept = {f"{part.digest}{_SUFFIX}" for part in parts}
    for each in folder.iterdir() if folder.exists() else ():
        if each.name not in kept:
            each.unlink()


def _stated(file: Path) -> list[str]:
    if not file.exists():
        return []
    lines = (line.strip() for line in file.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def _below(folder: Path, top: Path, patterns: Sequence[str]) -> Iterator[Path]:
    """Yield what is in a folder, each folder before its content; links are not followed."""
    for path in sorted(folder.iterdir()):
        is_folder = path.is_dir() and not path.is_symlink()
        if path == top / IGNORE_FILE or _is_ignored(path.relative_to(top).as_posix(), patterns, is_folder=is_folder):
            continue
        yield path
        if is_folder:
            yield from _below(path, top, patterns)


def _is_ignored(path: str, patterns: Sequence[str], *, is_folder: bool) -> bool:
    for pattern in patterns:
        if pattern.endswith("/") and not is_folder:
            continue
        form = pattern.rstrip("/")
        if fnmatch.fnmatchcase(path if "/" in form else path.rpartition("/")[2], form.removeprefix("/")):
            return True
    return False


def _digest(top: Path, paths: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        has = path.lstat()
        target = os.readlink(path) if stat.S_ISLNK(has.st_mode) else ""
        size, time_ns = (has.st_size, has.st_mtime_ns) if stat.S_ISREG(has.st_mode) else (0, 0)
        digest.update(repr((path.relative_to(top).as_posix(), has.st_mode, size, time_ns, target)).encode())
    return digest.hexdigest()


def _pack(top: Path, paths: Sequence[Path], packed: Path) -> None:
    """Write an archive: sorted, owned by root, without times."""
    with (
        packed.open("wb") as raw,
        gzip.GzipFile(fileobj=raw, mode="wb", filename="", mtime=0) as zipped,
        tarfile.open(fileobj=zipped, mode="w|") as archive,
    ):
        for path in paths:
            entry = archive.gettarinfo(str(path), arcname=str(path.relative_to(top)))
            entry.uid = entry.gid = entry.mtime = 0
            entry.uname = entry.gname = ""
            if entry.islnk():  # a second name of a file that this archive has; on the machine it is a file of its own
                entry.type, entry.linkname, entry.size = tarfile.REGTYPE, "", path.stat().st_size
            if entry.isreg():
                with path.open("rb") as content:
                    archive.addfile(entry, content)
            elif entry.isdir() or entry.issym():
                archive.addfile(entry)
