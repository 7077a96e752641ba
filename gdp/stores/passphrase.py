"""Passphrases of private files: from a file, the environment, systemd's credentials or a prompt, never an argument.

I/O; reads the environment, files and the terminal. An argument is visible in ``/proc/PID/cmdline`` to every user of the
host, and in the shell's history. One process has one passphrase, except for prompts, which ask for each folder.
"""

from __future__ import annotations

import getpass
import os
import sys
from functools import lru_cache
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.stores.files import read_private

FILE_VARIABLE: Final = "GDP_PASSPHRASE_FILE"
VARIABLE: Final = "GDP_PASSPHRASE"
CREDENTIAL: Final = "gdp.passphrase"  # systemd.exec(5), LoadCredentialEncrypted=
_CREDENTIALS: Final = "CREDENTIALS_DIRECTORY"
_SOURCES: Final = f"set {FILE_VARIABLE} to a private file, or {VARIABLE}, or give systemd's credential {CREDENTIAL}"


def passphrase_for(path: Path) -> bytes:
    """Return the passphrase, or PIN, of a private file.

    It is the first of these that exists: the file named by ``GDP_PASSPHRASE_FILE``, ``GDP_PASSPHRASE``, the credential,
    a prompt at a terminal.

    Raises:
        LocalError: none exists, the file is not private, or its content is empty.
    """
    given = _given()
    if given is not None:
        return given
    if not _is_terminal():
        raise LocalError(f"{path}: is protected by a passphrase, and there is no terminal to ask at: {_SOURCES}")
    return _asked(path.parent, path.name)


def new_passphrase(file: Path | None = None) -> bytes:
    """Return the passphrase to put files under.

    Args:
        file: a private file with it; otherwise as for ``passphrase_for``, and a prompt asks twice.

    Raises:
        LocalError: none exists, the two inputs differ, the file is not private, or its content is empty.
    """
    if file is not None:
        return _first_line(str(file), read_private(file))
    given = _given()
    if given is not None:
        return given
    if not _is_terminal():
        raise LocalError(f"a new passphrase is needed, and there is no terminal to ask at: {_SOURCES}")
    answer = getpass.getpass("New passphrase: ")
    if answer != getpass.getpass("Once more: "):
        raise LocalError("the two differ: nothing was written")
    return _first_line("the passphrase", answer.encode())


def _given() -> bytes | None:
    if file := os.environ.get(FILE_VARIABLE):
        return _first_line(file, read_private(Path(file)))
    if (text := os.environ.get(VARIABLE)) is not None:
        return _first_line(VARIABLE, text.encode())
    if folder := os.environ.get(_CREDENTIALS):
        credential = Path(folder) / CREDENTIAL
        if credential.exists():
            return _first_line(str(credential), read_private(credential))
    return None


@lru_cache(maxsize=16)
def _asked(folder: Path, first: str) -> bytes:
    return _first_line("the passphrase", getpass.getpass(f"Passphrase of {folder / first}: ").encode())


def _first_line(where: str, data: bytes) -> bytes:
    line = data.split(b"\n", 1)[0].rstrip(b"\r")
    if not line:
        raise LocalError(f"{where}: a passphrase is not empty")
    return line


def _is_terminal() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()
