"""Drop-in rules of a proxy as a program writes them: a file of ``proxy.yaml.d`` that is replaced as a whole.

I/O. ``proxy.yaml`` itself never changes. A reader sees the old file or the new one. A proxy reads its drop-ins at the
start and at each reload; ``proxy.config.drop_ins`` is that reader.
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.stores.files import private, public, write_all

_SALT: Final = re.compile(r"""\bsalt["']?[ \t]*:""")  # under `metadata`
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


def drop_in_directory(path: Path) -> Path:
    """Return the drop-in directory of a proxy's configuration, whether it exists or not."""
    return path.with_name(f"{path.name}.d")


def read_drop_in(file: Path) -> str | None:
    """Return the text of a drop-in, None if it is missing. Raises ``LocalError``: the system refuses."""
    try:
        return file.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LocalError(f"{file}: {error.strerror}") from error


def write_drop_in(path: Path, name: str, text: str | None) -> Path:
    """Write or remove a drop-in of the configuration at ``path``; return its file.

    The file is private (0600) if ``path`` is, or if a rule contains a name's salt.

    Args:
        text: the whole content; None removes the file.

    Raises:
        LocalError: ``path`` is missing, or the system refuses.
    """
    file = drop_in_directory(path) / name
    try:
        if text is None:
            file.unlink(missing_ok=True)
            return file
        is_private = not path.stat().st_mode & _OTHERS
        file.parent.mkdir(mode=0o700 if is_private else 0o755, exist_ok=True)
    except OSError as error:
        raise LocalError(f"{error.filename or file}: {error.strerror}") from error
    new = private if is_private or _SALT.search(text) else public
    write_all(file.parent, {file.name: new(text.encode())}, force=True)
    return file


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Exclude other programs that change the rules of this configuration, by a lock on its folder.

    Raises:
        LocalError: the system refuses.
    """
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise LocalError(f"{path.parent}: {error.strerror}") from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)
