"""``gdp keygen``: commands that make keys for an owner and keys for a node."""

from __future__ import annotations

from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.key import asked_passphrase, token_key
from gdp.cli.output import items_from_text, show
from gdp.crypto.certificates import Role
from gdp.stores.issue import make_node_keys, make_owner
from gdp.stores.keyring import OWNER_PUBLIC, REQUEST

app = typer.Typer(no_args_is_help=True, help="Make keys for an owner of names, or for a node.")

RoleOption = Annotated[
    Role, typer.Option("--role", help="what the node is; a leaf is a switch that carries no transit")
]


@app.command("owner")
def owner(
    directory: options.Directory,
    protect: options.Protect = False,
    key: options.KeyUri = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Make an owner's keys. Programs that derive names need owner.pub; the other files are private.

    \b
    Examples:
      gdp keygen owner keys/lab
      gdp keygen owner keys/lab --protect
    """
    made = make_owner(directory, key=token_key(key), passphrase=asked_passphrase(protect), force=force)
    path = directory / OWNER_PUBLIC
    show({"owner": made.key.public.compressed.hex(), "public": str(path)}, as_json=as_json)


@app.command("node")
def node(
    directory: options.Directory,
    role: RoleOption,
    label: options.Label,
    more: options.More = [],  # noqa: B006 (the library copies it)
    protect: options.Protect = False,
    key: options.KeyUri = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Make the keys of a switch, a leaf, a RIB or a proxy, and its request for a membership.

    \b
    Examples:
      gdp keygen node keys/robot --role proxy --label robot --meta site=roof
      gdp keygen node keys/robot-switch --role leaf --label robot
      gdp keygen node keys/roof --role switch --label roof --key 'pkcs11:token=roof;object=node?module-path=...'
    """
    guard = asked_passphrase(protect)
    made = make_node_keys(
        directory, role, label, more=items_from_text(more), key=token_key(key), passphrase=guard, force=force
    )
    result = {
        "name": made.subject.name.to_text(),
        "role": role.value,
        "label": label,
        "request": str(directory / REQUEST),
    }
    show(result, as_json=as_json)
