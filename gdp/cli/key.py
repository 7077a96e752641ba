"""``gdp key``: commands for the protection of private keys of a domain, an owner or a node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.crypto.keys import SigningKey
from gdp.errors import LocalError
from gdp.stores.keyring import storage, store_again
from gdp.stores.passphrase import FILE_VARIABLE, VARIABLE, new_passphrase
from gdp.stores.private_keys import TOKEN_KEYS, Storage

app = typer.Typer(
    no_args_is_help=True,
    help=(
        "Private keys: under a passphrase, plain, or in a token. A passphrase comes from the file that"
        f" {FILE_VARIABLE} names, from {VARIABLE}, from systemd's credential gdp.passphrase, or from a prompt."
    ),
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="of a domain, an owner or a node")]
NewFile = Annotated[
    Path | None, typer.Option("--new-passphrase-file", metavar="FILE", help="a private file with the new passphrase")
]


@app.command("protect")
def protect(directory: Folder, new: NewFile = None, as_json: options.Json = False) -> None:
    """Put the private keys of a directory under a passphrase, or under a new one.

    \b
    Examples:
      gdp key protect keys/school
      GDP_PASSPHRASE_FILE=old.txt gdp key protect keys/school --new-passphrase-file new.txt
    """
    if all(each is Storage.TOKEN for each in storage(directory).values()):
        raise LocalError(f"{directory}: its key is in a token, which guards it")
    _report(store_again(directory, new_passphrase(new)), as_json=as_json)


@app.command("unprotect")
def unprotect(directory: Folder, as_json: options.Json = False) -> None:
    """Remove the passphrase, so that a node starts by itself: only the files' mode (0600) protects them then.

    \b
    Example:
      gdp key unprotect keys/robot
    """
    _report(store_again(directory, None), as_json=as_json)


@app.command("show")
def show_(directory: Folder, as_json: options.Json = False) -> None:
    """Show for each private key whether it is plain, under a passphrase, or in a token.

    \b
    Example:
      gdp key show keys/school
    """
    _report(storage(directory), as_json=as_json)


@app.command("generate")
def generate(
    uri: Annotated[str, typer.Argument(metavar="URI", help="pkcs11:token=...;object=...?module-path=... (RFC 7512)")],
    as_json: options.Json = False,
) -> None:
    """Make a signing key in a token; it cannot be read out. Its PIN comes from the sources of passphrases.

    \b
    Example:
      gdp key generate 'pkcs11:token=roof;object=node?module-path=/usr/lib/softhsm/libsofthsm2.so'
    """
    made = TOKEN_KEYS.get("pkcs11", uri).generate_token_key(uri)
    show({"public": made.public.compressed.hex(), "key": uri}, as_json=as_json)


def asked_passphrase(wanted: bool) -> bytes | None:
    """Return the passphrase for keys that are about to be made; None: they stay plain.

    Raises:
        LocalError: a passphrase is requested, and none is given.
    """
    return new_passphrase() if wanted else None


def token_key(uri: str | None) -> SigningKey | None:
    """Return the key in a token that an option names; None: the key is to be made here.

    Raises:
        LocalError: there is no such key.
    """
    return None if uri is None else TOKEN_KEYS.get("pkcs11", uri).open_token_key(uri, Path(uri))


def _report(found: dict[Path, Storage], *, as_json: bool) -> None:
    show({path.name: each.value for path, each in found.items()}, as_json=as_json)
