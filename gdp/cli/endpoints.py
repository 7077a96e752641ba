"""``gdp endpoints``: the endpoint record of a switch, which its peers need for a tunnel to it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.output import moment, show
from gdp.control.endpoints import Endpoint, inner_address
from gdp.errors import LocalError
from gdp.links.endpoint_files import RECORD_SUFFIX, own_record, public_candidates
from gdp.stores.files import public, write_all
from gdp.stores.keyring import load_identity

Identity = Annotated[Path, typer.Argument(metavar="DIR", help="the identity of a switch")]
Public = Annotated[list[str], typer.Option("--public", metavar="ADDRESS:PORT", help="reachable from everywhere")]
Uplinks = Annotated[int, typer.Option("--uplinks", min=1, max=4, help="how many uplinks have tunnels")]


def endpoints(
    identity: Identity,
    out: options.Out = None,
    public_: Public = [],  # noqa: B006 (the library copies it)
    uplinks: Uplinks = 1,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Write the endpoint record of a switch: its WireGuard keys, and where it can be reached.

    Peers that have the file in the folder ``links.peers`` of their switch.yaml open a tunnel. The record holds no
    secret.

    \b
    Examples:
      gdp endpoints cloud/switch --public 198.51.100.7:51820 -o robot/peers/cloud.endpoints
      gdp endpoints robot/switch -o cloud/peers/robot.endpoints
    """
    found = load_identity(identity, time.time())
    if not found.role.is_switch:
        raise LocalError(f"{identity}: the identity of a {found.role.value}; only switches have tunnels")
    record = own_record(found, uplinks, public_candidates([Endpoint.from_text(each) for each in public_], uplinks))
    path = out or Path(f"{found.member.label}{RECORD_SUFFIX}")
    if path.suffix != RECORD_SUFFIX:
        raise LocalError(f"{path}: the name of an endpoint record ends with {RECORD_SUFFIX}")
    write_all(path.parent, {path.name: public(record.wire)}, force=force)
    result = {
        "name": record.name.to_text(),
        "inner": inner_address(record.name),
        "public": ", ".join(each.endpoint.to_text() for each in record.candidates) or None,
        "until": moment(record.until_unix_s),
        "file": str(path),
    }
    show(result, as_json=as_json)
