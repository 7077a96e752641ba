"""Process's side of a bench: its role and settings as arguments, commands and replies as lines of JSON.

I/O. Standard input and output. ``lab.process`` is the other side.
"""

from __future__ import annotations

import json
import select
import sys
from collections.abc import Callable, Mapping
from typing import Any

Settings = Mapping[str, Any]


def run_role(roles: Mapping[str, Callable[[Settings], object]]) -> None:
    """Run the role of the first argument with the settings of the second, a JSON object."""
    roles[sys.argv[1]](json.loads(sys.argv[2]))


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
