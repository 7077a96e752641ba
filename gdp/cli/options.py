"""Options that several sub-commands of ``gdp`` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from gdp.cli.output import items_from_text
from gdp.cli.secret import SaltFile, read_salt
from gdp.errors import LocalError
from gdp.limits import CERTIFICATE_LIFE_MAX_S
from gdp.metadata import Metadata

Kind = Annotated[str, typer.Option("--kind", help="topic, service, action, switch, rib, proxy, ...")]
More = Annotated[list[str], typer.Option("--meta", metavar="KEY=VALUE", help="further metadata; may be repeated")]

_DAYS_MAX = CERTIFICATE_LIFE_MAX_S / 86_400
Json = Annotated[bool, typer.Option("--json", help="print one JSON object")]
Force = Annotated[bool, typer.Option("--force", help="replace what is there")]
Host = Annotated[bool, typer.Option("--host", help="Nodes of other network namespaces of this host, too.")]
Days = Annotated[float, typer.Option("--days", min=0.001, max=_DAYS_MAX, help="how long it is valid")]
Label = Annotated[str, typer.Option("--label", help="its name for people")]
Directory = Annotated[Path, typer.Argument(metavar="DIR", help="where its files are, or are made")]
Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", help="write it to this file")]
Protect = Annotated[bool, typer.Option("--protect", help="put private keys under a passphrase; see gdp key --help")]
KeyUri = Annotated[
    str | None, typer.Option("--key", metavar="URI", help="the signing key is in a token: pkcs11:... (RFC 7512)")
]


def known_name(example: str, complete: Callable[..., list[str]]) -> object:
    """Return the argument of a command for a name that exists already; ``complete``: returns those that begin so."""
    text = f"ROS name such as {example}, the 256-bit name in hex, or its short form such as 75e…0fc."
    return typer.Argument(metavar="NAME", autocompletion=complete, help=text)


class NameOptions(NamedTuple):
    """Options that describe a name, apart from its kind."""

    name: Annotated[str | None, typer.Option("--name", help="its ROS name, such as /camera/image")] = None
    type_: Annotated[str | None, typer.Option("--type", help="its type, such as sensor_msgs/msg/Image")] = None
    author: Annotated[str | None, typer.Option("--author", help="who made it")] = None
    maintainer: Annotated[str | None, typer.Option("--maintainer", help="who looks after it")] = None
    description: Annotated[str | None, typer.Option("--description", help="what it is")] = None
    pin: Annotated[int | None, typer.Option("--pin", help="a number that people remember")] = None
    more: More = []  # noqa: RUF012 (the library copies it)
    salt_file: SaltFile = None

    def metadata(self, kind: str) -> Metadata:
        """Return the metadata that the options describe; options that are not given are absent.

        Raises:
            LocalError: an unknown kind, a key given twice, a salt as an argument, or a value of the wrong form.
        """
        given = {"kind": kind, **self._asdict()}
        keys = ("kind", "name", "type_", "author", "maintainer", "description", "pin")
        items = {key.rstrip("_"): given[key] for key in keys if given[key] is not None}
        for key, value in items_from_text(self.more).items():
            if key in items:
                raise LocalError(f"metadata {key!r} is given twice")
            items[key] = value
        return Metadata({**items, **read_salt(self.salt_file)})
