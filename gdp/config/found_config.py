"""Configuration of this machine's switch, where joining a domain or ``gdp lab`` left it.

I/O; it reads directories.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.stores.ownership import refuse_shared_folder

SWITCH_FILE: Final = "switch.yaml"


def find_switch_config(ifaces: Iterable[str], here: Path, machine_folders: Iterable[Path]) -> Path:
    """Return the one ``switch.yaml`` of this machine: in ``here``, in a folder of it, or where joining put it.

    Args:
        ifaces: ports of the command line, for the advice.
        here: a file directly in it precedes all others.
        machine_folders: folders that hold one directory for each domain that this machine joined.

    Raises:
        LocalError: there is none, several, or another user could have written it. The text has the command to type.
    """
    found = [here / SWITCH_FILE] if (here / SWITCH_FILE).is_file() else []
    if not found:
        folders = (here, *machine_folders)
        found = sorted({path for folder in folders for path in folder.glob(f"*/{SWITCH_FILE}") if path.is_file()})
    if not found:
        iface = "".join(f" --iface {iface}" for iface in list(ifaces)[:1])
        raise LocalError(f"this machine has no identity yet; make one: gdp lab {socket.gethostname()}{iface}")
    if len(found) > 1:
        listed = ", ".join(_shown(path, here) for path in found)
        raise LocalError(f"several identities are here: {listed}; choose one with --config {_shown(found[0], here)}")
    refuse_shared_folder(found[0].parent)
    return found[0]


def _shown(path: Path, here: Path) -> str:
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
