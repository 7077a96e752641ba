"""Environment in which processes that tests start can import the packages below ``scripts/``."""

from __future__ import annotations

import os

from tests.pages import ROOT

__all__ = ["PYTHON_PATH", "share_script_packages"]

_VARIABLE = "PYTHONPATH"
PYTHON_PATH = os.pathsep.join((str(ROOT), str(ROOT / "scripts")))  # of processes with a path of their own


def share_script_packages() -> None:
    """Add ``scripts/`` to PYTHONPATH, which child processes inherit."""
    folders = [each for each in os.environ.get(_VARIABLE, "").split(os.pathsep) if each]
    scripts = str(ROOT / "scripts")
    if scripts not in folders:
        os.environ[_VARIABLE] = os.pathsep.join([*folders, scripts])
