"""Record of a local machine: ``machine.json`` in the folder of its run.

I/O: the file system; times are arguments.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from fog.hardware import Hardware, Offer
from fog.machine import MachineSpec

_FILE: Final = "machine.json"


@dataclass(frozen=True, slots=True)
class MachineFile:
    """Machine as it was requested.

    Args:
        gateway: file of the namespace of its gateway.
        is_bounded: cgroups limit processor time and memory of its processes to its hardware.
        gone_unix_s: when it was killed, or first observed as gone.
    """

    spec: MachineSpec
    started_unix_s: float
    gateway: str
    is_bounded: bool = False
    gone_unix_s: float | None = None

    def write(self, directory: Path) -> None:
        """Replace the file. Raises ``OSError``: the system refuses."""
        draft = directory / f".{_FILE}"
        draft.write_text(json.dumps(asdict(self)), encoding="utf-8")
        draft.replace(directory / _FILE)

    @classmethod
    def read(cls, directory: Path) -> MachineFile | None:
        """Return the record; None: the folder has no record of a machine (yet)."""
        try:
            document = json.loads((directory / _FILE).read_bytes())
            offer = document["spec"]["offer"]
            offer = Offer(**{**offer, "hardware": Hardware(**offer["hardware"])})
            return cls(**{**document, "spec": MachineSpec(**{**document["spec"], "offer": offer})})
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
