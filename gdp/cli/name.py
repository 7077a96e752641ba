"""``gdp name``: command that prints the 256-bit name of metadata and an owner."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.metadata import hidden
from gdp.names import name_of

Owner = Annotated[
    Path | None,
    typer.Option("--owner", metavar="FILE", help="the owner's public key, PEM; without it the name is unowned"),
]


def name(
    kind: options.Kind,
    *,
    described: options.NameOptions,
    owner: Owner = None,
    as_json: options.Json = False,
) -> None:
    """Print the 256-bit name of metadata and an owner's key.

    \b
    Example:
      gdp name --kind topic --name /camera/image --type sensor_msgs/msg/Image --author lab --owner owner.pub
      gdp name --kind action --name /navigate --type nav2_msgs/action/NavigateToPose --owner owner.pub
      gdp name --kind topic --name /camera/image --type sensor_msgs/msg/Image --owner owner.pub --salt-file camera.salt
    """
    metadata = described.metadata(kind)
    owner_key = b"" if owner is None else _owner_key(owner)
    digest = metadata.digest()
    found = name_of(digest, owner_key)
    result = {
        "name": found.to_text(),
        "short": found.short,
        "digest": digest.hex(),
        "owner": owner_key.hex() or None,
        "metadata": hidden(metadata),
    }
    show(result, as_json=as_json, plain=found.to_text())


def _owner_key(file: Path) -> bytes:
    from gdp.stores.keyring import load_public_key  # it loads what reads keys

    return load_public_key(file).compressed
