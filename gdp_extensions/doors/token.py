"""Token of a door: a new one, or the one of a private file, so that the URL of its clients stays.

I/O.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.access_token import new_access_token
from gdp.cli.secret import Secret
from gdp.errors import LocalError

__all__ = ["NoToken", "TokenFile", "door_token"]

log = logging.getLogger(__name__)

DOOR_TOKEN: Final = Secret("door token", "--token-file", "GDP_DOOR_TOKEN")
_CHARACTERS_MIN: Final = 16

TokenFile = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        metavar="FILE",
        help="a private file with the token of the door's URL, or GDP_DOOR_TOKEN. Default: a new one at each start",
    ),
]
NoToken = Annotated[
    bool, typer.Option("--no-token", help="Admit clients without a token: all who reach the door have its rights.")
]


def door_token(file: Path | None, *, no_token: bool) -> str:
    """Return the token that a client must state; empty: none.

    Raises:
        LocalError: the file is not private, or the token has fewer than 16 characters.
    """
    if no_token:
        if file is not None:
            raise LocalError("--no-token and --token-file: leave one of them out")
        log.warning("clients need no token: every user of this host, and all who reach the address, have its rights")
        return ""
    token = DOOR_TOKEN.read(file)
    if token is None:
        return new_access_token()
    if len(token) < _CHARACTERS_MIN:
        raise LocalError(
            f"a door token has at least {_CHARACTERS_MIN} characters, such as 'openssl rand -hex 24' makes"
        )
    return token
