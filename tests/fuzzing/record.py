"""Count of all executions, kept next to the corpus, so that several runs add up.

I/O. One JSON object a decoder: ``executions``, ``foreign`` (with a foreign exception), ``slowest_ms`` (processor
time) and ``memory_ratio`` (over an input's length) of the worst one. A value that a fix improved stays in the record
until its line is deleted.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from tests.fuzzing.runner import CORPUS, Outcome

__all__ = ["RECORD", "Tried", "add"]

RECORD: Final = CORPUS / "executions.json"


@dataclass(frozen=True, slots=True)
class Tried:
    """Executions of one decoder so far."""

    executions: int = 0
    foreign: int = 0
    slowest_ms: float = 0.0
    memory_ratio: float = 0.0

    def plus(self, outcome: Outcome) -> Tried:
        """Return it with one more run."""
        return Tried(
            self.executions + outcome.executions,
            self.foreign + outcome.foreign,
            round(max(self.slowest_ms, outcome.slowest_ms), 1),
            round(max(self.memory_ratio, outcome.memory_ratio), 2),
        )


def add(outcomes: Sequence[Outcome], path: Path = RECORD) -> Mapping[str, Tried]:
    """Add runs to the record, also while another process does so, and return it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        text = file.read()
        tried = {name: Tried(**fields) for name, fields in json.loads(text).items()} if text else {}
        for outcome in outcomes:
            name = outcome.decoder.name
            tried[name] = tried.get(name, Tried()).plus(outcome)
        lines = (f"{json.dumps(name)}: {json.dumps(asdict(each))}" for name, each in sorted(tried.items()))
        file.seek(0)
        file.truncate()
        file.write("{\n" + ",\n".join(lines) + "\n}\n")
    return tried
