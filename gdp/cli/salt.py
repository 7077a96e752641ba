"""Salt of a name: its unguessable part, a secret that commands take.

I/O.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Optional

import typer

from gdp.cli.secret import Secret

__all__ = ["NAME_SALT", "SALT", "SaltFile", "hidden", "read_salt"]

SALT: Final = "salt"  # the salt's key in the metadata
NAME_SALT: Final = Secret("salt", "--salt-file", "GDP_SALT")

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
        file: as for ``Secret.read``.

    Raises:
        LocalError: the file is not private, or the salt is empty or not text.
    """
    text = NAME_SALT.read(file)
    return {} if text is None else {SALT: text}


def hidden(metadata: Mapping[str, str | int]) -> dict[str, str | int]:
    """Return metadata for display, without the salt's text."""
    return {key: "(hidden)" if key == SALT else value for key, value in metadata.items()}
