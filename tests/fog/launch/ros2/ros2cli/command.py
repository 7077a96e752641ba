"""Commands and their sub-commands; arguments become known step by step, so each parser runs twice."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from importlib import metadata
from unittest.mock import patch

from .plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version


class CommandExtension:
    NAME: str | None = None

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, "^0.1")

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        pass

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:
        raise NotImplementedError


def _exit_on_error(leave: Callable[[int, str | None], None], status: int = 0, message: str | None = None) -> None:
    if status:
        leave(status, message)


def add_subparsers_on_demand(
    parser: argparse.ArgumentParser,
    cli_name: str,
    dest: str,
    group_name: str,
    hide_extensions: Sequence[str] | None = None,
    required: bool = True,
    argv: Sequence[str] | None = None,
) -> None:
    chosen = parser.add_subparsers(title="Commands", metavar=f"Call `{cli_name} <command> -h` for more detailed usage.")
    chosen.dest = " " + dest.lstrip("_")
    chosen.required = required
    points = {each.name: each for each in metadata.entry_points().select(group=group_name)}
    parsers = {name: chosen.add_parser(name) for name in sorted(points)}
    root = getattr(parser, "_root_parser", parser)
    with ExitStack() as quiet:
        for one in (parser, *parsers.values()):
            quiet.enter_context(patch.object(one, "print_help"))
            quiet.enter_context(patch.object(one, "exit", partial(_exit_on_error, one.exit)))
        known, _ = root.parse_known_args(argv)
    name = getattr(known, chosen.dest)
    for each in [name] if name else points:
        extension = points[each].load()()
        extension.NAME = each
        parsers[each].set_defaults(**{dest: extension})
        parser.epilog = f"{parser.epilog or ''}  {each}  {extension.__doc__.strip()}  "
        if name:
            vars(parsers[each])["_root_parser"] = root
            extension.add_arguments(parsers[each], f"{cli_name} {each}")
            del vars(parsers[each])["_root_parser"]
