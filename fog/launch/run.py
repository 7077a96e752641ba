"""Starter of a node that is resolved on this machine: ``python -m fog.launch.run PACKAGE EXECUTABLE ...``."""

from __future__ import annotations

import os
import sys

from fog.cluster import CloudNode
from fog.launch.resolve import PYTHON, command_line
from gdp.errors import LocalError


def main() -> None:
    """Replace this process with the node; exit with status 2 if it is not found."""
    if len(sys.argv) < 3:
        sys.exit("expected: PACKAGE EXECUTABLE [ARGUMENT ...]")
    try:
        words = command_line(CloudNode(sys.argv[1], sys.argv[2], tuple(sys.argv[3:])), os.environ)
    except LocalError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
    words = tuple(sys.executable if word == PYTHON else word for word in words)
    os.execv(words[0], words)


if __name__ == "__main__":
    main()
