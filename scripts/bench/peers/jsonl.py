"""How a process of a contender is told what to do, and how it answers: settings as one argument, lines of JSON back.

I/O. Standard output.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass

from peers.exchange import Load

__all__ = ["EndSettings", "say"]


@dataclass(frozen=True, slots=True)
class EndSettings:
    """What an end is told, whoever the contender.

    Attributes:
        role: ``ping`` (A) or ``pong`` (B).
        load: what to measure.
        pids: processes whose CPU counts, by place; A adds itself.
        own: what only this contender's end needs.
    """

    role: str
    load: Load
    pids: dict[str, list[int]]
    own: dict[str, str]

    def to_argument(self) -> str:
        """Return the argument that ``from_argument`` reads."""
        return json.dumps(asdict(self))

    @classmethod
    def from_argument(cls) -> EndSettings:
        """Read the only argument of this process."""
        fields = json.loads(sys.argv[1])
        load = Load(tuple(fields["load"]["sizes"]), fields["load"]["count"])
        return cls(fields["role"], load, fields["pids"], fields["own"])


def say(**values: object) -> None:
    """Print one line of JSON for whoever started this process."""
    print(json.dumps(values), flush=True)
