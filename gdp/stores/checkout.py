"""Protection of private files against ``git add``: each key folder has a ``.gitignore`` that covers all of it.

I/O. Git reads a ``.gitignore`` in every folder; with the pattern ``*`` it also ignores that file itself.
Source: gitignore(5).
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.stores.files import public, write_all

_FILE: Final = ".gitignore"
_TEXT: Final = "# private keys; git must not take any file of this folder\n*\n"


def refuse_work_tree(directory: Path) -> None:
    """Refuse the root of a work tree as a key folder. Raises ``LocalError``: all in it would have to be ignored."""
    if (directory / ".git").exists():
        raise LocalError(
            f"{directory} is the root of a git work tree; keep keys in a folder of their own, such as"
            f" {directory / 'keys'}"
        )


def ignore_folder(directory: Path) -> None:
    """Let git ignore a folder of keys, also if it is moved into a work tree later; an existing file stays.

    Raises:
        LocalError: the system refuses.
    """
    if not (directory / _FILE).exists() and not _is_ours(directory.parent / _FILE):
        write_all(directory, {_FILE: public(_TEXT.encode())})


def _is_ours(path: Path) -> bool:
    return path.is_file() and path.read_text(encoding="utf-8", errors="replace") == _TEXT


def work_tree_of(path: Path) -> Path | None:
    """Return the git work tree in which a path lies, without asking git; None: it lies in none."""
    return next((each for each in path.absolute().parents if (each / ".git").exists()), None)
