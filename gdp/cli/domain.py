"""``gdp domain``: commands that create and show a trust domain."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.domain_machine import create, ls, remove, serve, token
from gdp.cli.key import asked_passphrase, token_key
from gdp.cli.output import show
from gdp.cli.rollover import described_root
from gdp.stores.issue import ROOT_DAYS, make_domain
from gdp.stores.keyring import ROOT_CERTIFICATE, load_root

app = typer.Typer(no_args_is_help=True, help="Create a trust domain, let machines join it, or look at one.")
app.command("create", no_args_is_help=True)(create)
app.command("token", no_args_is_help=True)(token)
app.command("ls", no_args_is_help=True)(ls)
app.command("remove", no_args_is_help=True)(remove)
app.command("serve", no_args_is_help=True)(serve)

RootFile = Annotated[Path, typer.Argument(metavar="FILE", help="a root certificate, PEM or DER")]


@app.command("init")
def init(
    directory: options.Directory,
    label: options.Label,
    days: options.Days = ROOT_DAYS,
    protect: options.Protect = False,
    key: options.KeyUri = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Create a trust domain: a root key, and the certificate that other domains add to their trusted roots.

    \b
    Examples:
      gdp domain init keys/school --label school
      gdp domain init keys/school --label school --protect
    """
    guard = asked_passphrase(protect)
    root = make_domain(directory, label, days=days, key=token_key(key), passphrase=guard, force=force).root
    show({**described_root(root), "root": str(directory / ROOT_CERTIFICATE)}, as_json=as_json)


@app.command("show")
def show_(file: RootFile, as_json: options.Json = False) -> None:
    """Verify a root certificate and print its domain.

    \b
    Example:
      gdp domain show keys/school/root.crt
    """
    show(described_root(load_root(file)), as_json=as_json)
