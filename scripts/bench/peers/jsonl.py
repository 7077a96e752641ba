"""Process's side of a bench: its settings as one argument, commands to it and its replies as lines of JSON.

I/O. Standard input and output. ``lab.process`` is the other side.
"""

from __future__ import annotations

import json
import select
import sys
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class EndSettings:
    """Settings of an endpoint, the same for every baseline.

    ``role``: ``ping`` (A) or ``pong`` (B). ``size``, ``count``: of the measured messages. ``pids``: processes whose CPU
    counts, by machine; A adds itself. ``own``: further settings of this baseline's endpoint.
    """

    role: str
    size: int
    count: int
    pids: dict[str, list[int]]
    own: dict[str, str]

    def to_argument(self) -> str:
        """Return the argument that ``from_argument`` reads."""
        return json.dumps(asdict(self))

    @classmethod
    def from_argument(cls) -> EndSettings:
        """Read the only argument of this process."""
        return cls(**json.loads(sys.argv[1]))


def say(**values: object) -> None:
    """Print one line of JSON for the parent process."""
    print(json.dumps(values), flush=True)


def read_order() -> dict[str, Any]:
    """Wait for the next command; the process ends with its bench."""
    line = sys.stdin.readline()
    if not line:
        sys.exit(0)
    order: dict[str, Any] = json.loads(line)
    return order


def order_waits() -> bool:
    """Return whether ``read_order`` would return at once. One line is read at a time, so none is in a buffer."""
    return bool(select.select([sys.stdin], [], [], 0)[0])
