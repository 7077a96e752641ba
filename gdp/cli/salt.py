"""Salt of a name: its unguessable part, a secret that commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli.secret import Secret
from gdp.metadata import SALT

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
