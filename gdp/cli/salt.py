"""Salt of a name: its unguessable part, read from a file, the environment or a prompt, never from an argument.

I/O. An argument is visible in ``/proc/PID/cmdline`` to every user of the host, and in the shell's history.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Optional

import typer

from gdp.errors import LocalError
from gdp.stores.files import read_private

__all__ = ["SALT", "SaltFile", "hidden", "read_salt"]

SALT: Final = "salt"  # the salt's key in the metadata
_VARIABLE: Final = "GDP_SALT"
_PROMPT: Final = Path("-")

SaltFile = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option(
        "--salt-file",
        metavar="FILE",
        help="the unguessable part of the name: a private file with it; -: ask for it. Without: GDP_SALT, if set",
    ),
]


def read_salt(file: Path | None) -> dict[str, str]:
    """Return the salt as an item of metadata; empty if none is given.

    Args:
        file: a private file (mode 0600) with the salt as its only line; ``-``: read it from a prompt, or from standard
            input if that is not a terminal.

    Raises:
        LocalError: the file is not private, or the salt is empty or not text.
    """
    if file is None:
        where, text = _VARIABLE, os.environ.get(_VARIABLE)
        if text is None:
            return {}
    elif file == _PROMPT:
        where = "the salt"
        text = typer.prompt("Salt of the name", hide_input=True, err=True) if sys.stdin.isatty() else sys.stdin.read()
    else:
        where = str(file)
        try:
            text = read_private(file).decode()
        except UnicodeDecodeError as error:
            raise LocalError(f"{file}: UTF-8 text is expected") from error
    if not text.strip():
        raise LocalError(f"{where}: a salt is not empty")
    return {SALT: text.strip()}


def hidden(metadata: Mapping[str, str | int]) -> dict[str, str | int]:
    """Return metadata for display, without the salt's text."""
    return {key: "(hidden)" if key == SALT else value for key, value in metadata.items()}
