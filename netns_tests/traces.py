"""``gdp`` as a user types it, for nodes that run already."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

GDP: Final = (sys.executable, "-m", "gdp.cli.gdp")
_PATIENCE_S: Final = 60.0


def gdp(*words: object) -> list[str]:
    """Run a command; return the lines that it prints."""
    argv = [*GDP, *map(str, words)]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout.splitlines()


def traced(where: str, name: str, node: Path) -> list[dict[str, Any]]:
    """Trace a name from a node, print how long that took, and return the paths."""
    (line,) = gdp("trace", name, "--node", node, "--json")
    result = json.loads(line)
    print(f"gdp trace through {where}: {result['elapsed_ms']} ms")
    paths: list[dict[str, Any]] = result["paths"]
    return paths
