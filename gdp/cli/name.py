"""``gdp name``: command that prints the 256-bit name of metadata and an owner.

I/O.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.crypto.subject import Subject
from gdp.metadata import hidden
from gdp.stores.keyring import load_public_key

__all__ = ["name"]

Owner = Annotated[
    Optional[Path],  # noqa: UP045
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
    subject = Subject.of(metadata, load_public_key(owner).compressed if owner is not None else b"")
    result = {
        "name": subject.name.to_text(),
        "short": subject.name.short,
        "digest": subject.digest.hex(),
        "owner": subject.owner_key.hex() or None,
        "metadata": hidden(metadata),
    }
    show(result, as_json=as_json, plain=subject.name.to_text())
