"""Preemption notice of a machine: ``notice.json`` in the machine's folder.

I/O: the file system.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Final

NOTICE_FILE: Final = "notice.json"


def write_notice(home: Path, leaves_at_unix_s: float) -> None:
    """Write when the machine will be preempted; an earlier notice is replaced.

    Raises:
        OSError: the system refuses.
    """
    draft = home / f".{NOTICE_FILE}"
    draft.write_text(json.dumps({"leaves_at_unix_s": leaves_at_unix_s}), encoding="ascii")
    draft.replace(home / NOTICE_FILE)


def read_notice(home: Path) -> float | None:
    """Return when the machine will be preempted, as Unix time; None: there is no notice."""
    try:
        leaves_at_unix_s = float(json.loads((home / NOTICE_FILE).read_bytes())["leaves_at_unix_s"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
    return leaves_at_unix_s if math.isfinite(leaves_at_unix_s) else None


def given_unix_s(home: Path) -> float | None:
    """Return when the notice was given, as Unix time; None: there is none."""
    try:
        return (home / NOTICE_FILE).stat().st_mtime
    except OSError:
        return None
