"""Options that several sub-commands of ``gdp`` share.

I/O.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from gdp.limits import CERTIFICATE_LIFE_MAX_S

__all__ = [
    "Author",
    "Days",
    "Description",
    "Directory",
    "Force",
    "Host",
    "Json",
    "KeyUri",
    "Kind",
    "Label",
    "Maintainer",
    "More",
    "Name",
    "Out",
    "Pin",
    "Protect",
    "Type",
]

Kind = Annotated[str, typer.Option("--kind", help="topic, service, action, switch, rib, proxy, ...")]
# typer reads these annotations at run time, on Python 3.10 too: hence Optional.
Name = Annotated[Optional[str], typer.Option("--name", help="its ROS name, such as /camera/image")]  # noqa: UP045
Type = Annotated[Optional[str], typer.Option("--type", help="its type, such as sensor_msgs/msg/Image")]  # noqa: UP045
Author = Annotated[Optional[str], typer.Option("--author", help="who made it")]  # noqa: UP045
Maintainer = Annotated[Optional[str], typer.Option("--maintainer", help="who looks after it")]  # noqa: UP045
Description = Annotated[Optional[str], typer.Option("--description", help="what it is")]  # noqa: UP045
Pin = Annotated[Optional[int], typer.Option("--pin", help="a number that people remember")]  # noqa: UP045
More = Annotated[list[str], typer.Option("--meta", metavar="KEY=VALUE", help="further metadata; may be repeated")]

_DAYS_MAX = CERTIFICATE_LIFE_MAX_S / 86_400
Json = Annotated[bool, typer.Option("--json", help="print one JSON object")]
Force = Annotated[bool, typer.Option("--force", help="replace what is there")]
Host = Annotated[bool, typer.Option("--host", help="Nodes of other network namespaces of this host, too.")]
Days = Annotated[float, typer.Option("--days", min=0.001, max=_DAYS_MAX, help="how long it is valid")]
Label = Annotated[str, typer.Option("--label", help="its name for people")]
Directory = Annotated[Path, typer.Argument(metavar="DIR", help="where its files are, or are made")]
Out = Annotated[Optional[Path], typer.Option("--out", "-o", metavar="FILE", help="write it to this file")]  # noqa: UP045
Protect = Annotated[bool, typer.Option("--protect", help="put private keys under a passphrase; see gdp key --help")]
KeyUri = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--key", metavar="URI", help="the signing key is in a token: pkcs11:... (RFC 7512)"),
]
