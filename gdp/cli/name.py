"""``gdp name``: command that prints the 256-bit name of metadata and an owner.

I/O.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from gdp.cli import options
from gdp.cli.output import metadata_from_options, show
from gdp.cli.salt import SaltFile
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
    name: options.Name = None,
    type_: options.Type = None,
    author: options.Author = None,
    maintainer: options.Maintainer = None,
    description: options.Description = None,
    pin: options.Pin = None,
    more: options.More = [],  # noqa: B006 (the library copies it)
    salt_file: SaltFile = None,
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
    metadata = metadata_from_options(
        kind=kind,
        name=name,
        type_=type_,
        author=author,
        maintainer=maintainer,
        description=description,
        pin=pin,
        more=more,
        salt_file=salt_file,
    )
    subject = Subject.of(metadata, load_public_key(owner).compressed if owner is not None else b"")
    result = {
        "name": subject.name.to_text(),
        "short": subject.name.short,
        "digest": subject.digest.hex(),
        "owner": subject.owner_key.hex() or None,
        "metadata": hidden(metadata),
    }
    show(result, as_json=as_json, plain=subject.name.to_text())
