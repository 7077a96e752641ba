"""Preconditions of a bench, an experiment or a script: its data are there, its page can be written and trusted.

I/O: reads the file system. Each precondition is checked before anything is measured; see ``skeleton.clean_exit``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from machine import ROOT, MachineState

DATA: Final = ROOT / "scripts" / "data"


class RefusedError(Exception):
    """A command cannot begin; the text says what is wrong and what to do."""


def data_folder(name: str, patterns: Iterable[str], within: Path = DATA) -> Path:
    """Return a folder of recorded data, such as ``spot``; at least one file matches each pattern.

    Raises:
        RefusedError: none does.
    """
    folder = within / name
    for pattern in patterns:
        if not any(folder.glob(pattern)):
            does = "scripts/data/fetch.sh fetches" if name == "planning" else "git checkout -- scripts/data restores"
            raise RefusedError(f"no {folder / pattern}: {does} it")
    return folder


def require_trust(state: MachineState, *, allow_load: bool) -> None:
    """Refuse to measure for a page that could not name its commit, or whose machine does other work.

    Args:
        allow_load: the rows are marked instead.

    Raises:
        RefusedError: such a page.
    """
    if not state.commit:
        raise RefusedError(f"a page names its commit, and {ROOT} is no git repository: clone it by git, or use --quick")
    if state.is_busy and not allow_load:
        raise RefusedError(
            f"the load before, {state.load_before:.2f}, exceeds half of {state.cores} cores:"
            " wait for a quiet machine, or mark each row by --allow-load"
        )


def require_writable(folder: Path) -> None:
    """Make a folder, and write a file into it for a moment.

    Raises:
        RefusedError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise RefusedError(f"{folder} cannot be written ({error.strerror}): choose another folder") from error
