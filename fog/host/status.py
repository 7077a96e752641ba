"""What a machine says of itself, in ``status.json`` of its folder: replaced whole, so that a reader never sees half.

I/O: the file system; times come in as arguments.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from fog.machine import MachineState

__all__ = ["STATUS_FILE", "ProgramStatus", "Status"]

STATUS_FILE: Final = "status.json"


@dataclass(frozen=True, slots=True)
class ProgramStatus:
    """One program now.

    Args:
        pid: None: it does not run. It leads a process group of its own.
        up: it said that it is ready.
        restarts: how often it was started again.
    """

    pid: int | None = None
    up: bool = False
    restarts: int = 0


@dataclass(frozen=True, slots=True)
class Status:
    """A machine now; ``reason``: why it is leaving or gone, in a few words."""

    state: MachineState
    changed_unix_s: float
    programs: Mapping[str, ProgramStatus] = field(default_factory=dict)
    reason: str = ""

    def write(self, home: Path) -> None:
        """Replace what the machine said before.

        Raises:
            OSError: the system refuses.
        """
        draft = home / f".{STATUS_FILE}"
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            json.dump({**asdict(self), "state": self.state.value}, file)
        draft.replace(home / STATUS_FILE)

    @classmethod
    def read(cls, home: Path) -> Status | None:
        """Return what the machine said last; None: nothing yet, or nothing that can be read."""
        try:
            told = json.loads((home / STATUS_FILE).read_bytes())
            programs = {name: ProgramStatus(**each) for name, each in told["programs"].items()}
            return cls(MachineState(told["state"]), told["changed_unix_s"], programs, told["reason"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
