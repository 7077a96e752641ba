"""Settings of a baseline process as one argument, and its replies as lines of JSON.

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
    """Settings of an endpoint, the same for every baseline.

    Attributes:
        role: ``ping`` (A) or ``pong`` (B).
        load: what to measure.
        pids: processes whose CPU counts, by machine; A adds itself.
        own: further settings of this baseline's endpoint.
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
    """Print one line of JSON for the parent process."""
    print(json.dumps(values), flush=True)
