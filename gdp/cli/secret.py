"""Secrets that commands take: from a private file, the environment or a prompt, never from an argument.

I/O. An argument is visible in ``/proc/PID/cmdline`` to every user of the host, and in the shell's history.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.errors import LocalError
from gdp.metadata import SALT

PROMPT: Final = Path("-")


@dataclass(frozen=True, slots=True)
class Secret:
    """Kind of secret that commands take.

    Args:
        name: for people, such as ``salt``.
        option: names a private file with it.
        variable: environment variable that holds it.
    """

    name: str
    option: str
    variable: str

    def read(self, file: Path | None) -> str | None:
        """Return the secret without blanks around it; None: no file is named, and the variable is not set.

        Programs that this command starts do not inherit the variable.

        Args:
            file: a private file (mode 0600) with the secret as its only line; ``-``: read it from a prompt, or from
                standard input if that is not a terminal.

        Raises:
            LocalError: the file is not private, or the secret is empty or not text.
        """
        if file is None:
            where, text = self.variable, os.environ.pop(self.variable, None)
            if text is None:
                return None
        elif file == PROMPT:
            where = "standard input"
            is_terminal = sys.stdin.isatty()
            text = typer.prompt(self.name.capitalize(), hide_input=True, err=True) if is_terminal else sys.stdin.read()
        else:
            from gdp.stores.files import read_private

            where = str(file)
            try:
                text = read_private(file).decode()
            except UnicodeDecodeError as error:
                raise LocalError(f"{file}: UTF-8 text is expected") from error
        if not text.strip():
            raise LocalError(f"{where}: a {self.name} is not empty")
        return text.strip()

    def refused(self, argument: str, instead: str = "") -> LocalError:
        """Return the error for a secret as an argument, without its text.

        Args:
            argument: how it was given, such as ``--meta salt=...``.
            instead: what to say for the file; empty: the ways of ``read``.
        """
        instead = instead or f"{self.option} FILE, or {self.option} - to be asked, or set {self.variable}"
        return LocalError(
            f"{argument}: every user of this host reads arguments; put the {self.name} into a private file and say"
            f" {instead}"
        )


NAME_SALT: Final = Secret("salt", "--salt-file", "GDP_SALT")

SaltFile = Annotated[
    Path | None,
    typer.Option(
        "--salt-file",
        metavar="FILE",
        help="the unguessable part of the name: a private file with it; -: ask for it. Without: GDP_SALT, if set",
    ),
]


def read_salt(file: Path | None) -> dict[str, str]:
    """Return the salt as an item of metadata; empty if none is given.

    Args:
        file: as for ``Secret.read``.

    Raises:
        LocalError: the file is not private, or the salt is empty or not text.
    """
    text = NAME_SALT.read(file)
    return {} if text is None else {SALT: text}
