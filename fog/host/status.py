"""Status of a machine: ``status.json`` in its folder, replaced atomically so that readers never see a partial file.

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

STATUS_FILE: Final = "status.json"


@dataclass(frozen=True, slots=True)
class ProgramStatus:
    """Status of one program; ``pid``: process id, also of its process group; None: it does not run."""

    pid: int | None = None
    up: bool = False
    restarts: int = 0


@dataclass(frozen=True, slots=True)
class Status:
    """Status of a machine; ``reason``: why it is leaving or gone, in a few words."""

    state: MachineState
    changed_unix_s: float
    programs: Mapping[str, ProgramStatus] = field(default_factory=dict)
    reason: str = ""

    def write(self, home: Path) -> None:
        """Replace the status file. Raises ``OSError``: the system refuses."""
        draft = home / f".{STATUS_FILE}"
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            json.dump({**asdict(self), "state": self.state.value}, file)
        draft.replace(home / STATUS_FILE)

    @classmethod
    def read(cls, home: Path) -> Status | None:
        """Return the last status; None: no readable status."""
        try:
            document = json.loads((home / STATUS_FILE).read_bytes())
            programs = {name: ProgramStatus(**each) for name, each in document["programs"].items()}
            return cls(MachineState(document["state"]), document["changed_unix_s"], programs, document["reason"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
