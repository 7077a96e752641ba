"""``fog wheels``: the wheels that rented machines install."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fog.cli.options import AsJson
from fog.cli.views import print_json
from fog.software.wheels import DEBIAN_12, Platform, wheels
from gdp.cli.node import failing_clearly
from gdp.terminal import echo

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="where the wheels are written; `software.wheels`")]
Sources = Annotated[
    list[str] | None,
    typer.Argument(metavar="[SOURCE]...", help="a folder with the nodes' Python project, or a requirement of pip"),
]
Build = Annotated[
    list[str] | None,
    typer.Option("--build", metavar="NAME", help="a package without a wheel on the index, which is built here"),
]
Python = Annotated[str, typer.Option("--python", metavar="X.Y", help="of the machines; Debian 12 has 3.11")]


def wheels_command(
    folder: Folder,
    sources: Sources = None,
    build: Build = None,
    python: Python = DEBIAN_12.python,
    as_json: AsJson = False,
) -> None:
    """Build the wheel of this package and of your nodes, and fetch all that they need, for x86-64 machines.

    Packages have the versions that are installed here. Name the folder in software.wheels of fog.yaml: machines
    fetch the wheels from the supervisor, each checked by its SHA-256.

    \b
    Examples:
      fog wheels dist
      fog wheels dist ./my_nodes ros-jazzy-rmw-fastrtps-cpp --build empy
    """
    with failing_clearly():
        found = wheels(folder, sources or (), Platform(python, DEBIAN_12.tags), build or ())
        if as_json:
            print_json([each.name for each in found])
        else:
            size_mb = sum(each.stat().st_size for each in found) / 1e6
            echo(f"{folder}: {len(found)} wheels, {size_mb:.0f} MB")
