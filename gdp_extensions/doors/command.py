"""Options that the doors share, and the course of a door's command."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import typer

from gdp.access_token import new_access_token
from gdp.cli.completion import complete_node
from gdp.cli.node import AwaitIface, Json
from gdp.cli.secret import Secret
from gdp.errors import LocalError
from gdp.links.uplink import wait_for_device
from proxy.cli.tool_options import Delegations, Iface

if TYPE_CHECKING:
    from gdp_extensions.doors.endpoint import NewSession

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


DoorNode = Annotated[
    Path,
    typer.Argument(
        metavar="NODE", autocompletion=complete_node, help="The door's own node: its directory, or its proxy.yaml."
    ),
]
Origins = Annotated[
    list[str], typer.Option("--origin", metavar="URL", help="Let pages of this origin connect, as in the example.")
]
Listen = Annotated[str, typer.Option("--listen", metavar="HOST:PORT", help="Where clients connect.")]


class DoorOptions(NamedTuple):
    """Options of every door: who may connect, and which member it is."""

    token_file: TokenFile = None
    no_token: NoToken = False
    iface: Iface = None
    delegations: Delegations = None
    await_iface: AwaitIface = 0.0
    json: Json = False


def serve_door(
    label: str,
    new_session: NewSession,
    node: Path,
    listen: str,
    origins: Sequence[str],
    options: DoorOptions,
    *,
    subprotocols: tuple[str, ...] = (),
) -> None:
    """Serve clients of a door until Ctrl-C.

    Raises:
        LocalError: keys, delegations, the token, the device or the address are not as stated.
    """
    from gdp_extensions.doors.endpoint import DoorEndpoint, DoorSettings
    from gdp_extensions.doors.node import run_door
    from proxy.node.member_config import member_config

    config, _ = member_config(node, options.iface, options.delegations)
    token = door_token(options.token_file, no_token=options.no_token)
    settings = DoorSettings(label=label, listen=listen, origins=tuple(origins), subprotocols=subprotocols, token=token)
    wait_for_device(config.iface, options.await_iface)
    run_door(config, lambda rights: DoorEndpoint(settings, new_session, rights), json=options.json)
