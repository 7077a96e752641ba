"""Security bench: cost of single measures and resistance to attacks, one subcommand for each question.

    sudo .venv/bin/python scripts/bench/security.py revocation            # the whole; docs/benchmarks/security.json
    sudo .venv/bin/python scripts/bench/security.py revocation --rounds 1 --no-save
    sudo .venv/bin/python scripts/bench/security.py flood                 # by strangers; half an hour

Each subcommand is a module in this folder with ``add_arguments(parser)`` and ``run(options)``. ``run`` returns its
figures, which are stored under the subcommand's name, and whether every target was met.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import security_flood
import security_revocation
from machine import MachineState, machine_state
from preconditions import require_trust, require_writable
from skeleton import add_allow_load, clean_exit

OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks" / "security.json"
COMMANDS: Final[Mapping[str, ModuleType]] = {
    "revocation": security_revocation,
    "flood": security_flood,
}


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, module in COMMANDS.items():
        command = commands.add_parser(
            name, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        module.add_arguments(command)
        command.add_argument("--json", type=Path, default=OUTPUT, help="where the figures go")
        command.add_argument("--no-save", action="store_true", help="print only")
        command.add_argument("--strict", action="store_true", help="exit 1 when a target was missed")
        add_allow_load(command)
    return parser


def held(path: Path) -> dict[str, dict[str, Any]]:
    """Return the figures of earlier runs, by subcommand."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return document


def save(path: Path, command: str, figures: Mapping[str, object], state: MachineState) -> None:
    """Write the figures of one subcommand; figures of others, and parts that were not measured now, are kept."""
    document: dict[str, Any] = {"bench": "security", **held(path)}
    document[command] = {**document.get(command, {}), **figures, "machine": asdict(state)}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Run one subcommand."""
    options, state = arguments().parse_args(), machine_state()
    with clean_exit():
        if not options.no_save:
            require_writable(options.json.parent)
            require_trust(state, allow_load=options.allow_load)
        figures, has_met = COMMANDS[options.command].run(options)
    if not options.no_save:
        save(options.json, options.command, figures, state)
    sys.exit(options.strict and not has_met)


if __name__ == "__main__":
    main()
