"""``gdp demo``: the ring of five switches, from a clone of the project.

I/O. It replaces this process by the ring's, whose exit code is its own: 0 passed, 1 failed, 2 wrong input.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

import gdp
from gdp.cli.machine import say
from gdp.errors import LocalError

_SECONDS: Final = 5.0
_PICTURE: Final = """\
   domain school                                 domain cloud
   nuc1 (robot) -- nuc2 (RIB)                    nuc4 (RIB) -- nuc5 (server)
        |             |                             |             |
        |             `---- nuc3 (upper RIB) -------'             |
        |                   domain backbone                       |
        `------------------- a detour that costs more ------------'

Each nuc is a switch in a network namespace of its own. The robot replays a generated drive; the server
records what arrives at the end of the usual path, nuc1-nuc2-nuc3-nuc4-nuc5. Then both are compared.
"""


def demo(
    context: typer.Context,
    seconds: Annotated[float, typer.Option(min=1.0, help="Of traffic.")] = _SECONDS,
) -> None:
    """Send a robot's drive around a ring of five switches on this machine, and compare what arrives.

    Nothing stays behind. Other options go to scripts/ring_topology.sh, whose --help lists them.

    \b
    Examples:
      gdp demo
      gdp demo --seconds 20 --cut nuc2-nuc3@5
      gdp demo --live
      gdp demo --json result.json
    """
    root = Path(gdp.__file__).parents[1]
    privileged, ring = root / "scripts/privileged.sh", root / "scripts/ring"
    if not privileged.is_file() or not ring.is_dir():
        raise LocalError(
            "gdp demo runs from a clone of the project, because an installed package lacks the folder scripts; there,"
            " run scripts/setup.sh and .venv/bin/gdp demo"
        )
    say(_PICTURE)
    words = [str(privileged), sys.executable, "-m", "ring", "--seconds", f"{seconds:g}", *context.args]
    paths = os.pathsep.join(filter(None, [str(root / "scripts"), os.environ.get("PYTHONPATH", "")]))
    sys.stdout.flush()
    os.execve(words[0], words, {**os.environ, "PYTHONPATH": paths})
