"""Command ``ros2``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from .command import CommandExtension, add_subparsers_on_demand


def main(*, script_name: str = "ros2", argv: Sequence[str] | None = None, description: str | None = None) -> int:
    parser = argparse.ArgumentParser(description=description)
    add_subparsers_on_demand(parser, script_name, "_command", "ros2cli.command", required=False, argv=argv)
    args = parser.parse_args(args=argv)
    command: CommandExtension | None = getattr(args, "_command", None)
    if command is None:
        parser.print_help()
        return 0
    return command.main(parser=parser, args=args)
