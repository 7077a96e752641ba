"""Command ``gdp`` of ``ros2``: passes its words to the ``gdp`` command, or to the program of a node.

I/O; imported by ros2cli through the entry point ``ros2cli.command``. Its verbs are those of ``gdp``, whichever there
are, and the programs: ``ros2 gdp switch`` is ``gdp-switch``.
Source: ros2cli 0.32 (jazzy), ``ros2cli.command``.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from typing import Final

from ros2cli.command import CommandExtension

PROGRAMS: Final = {  # verb to module and program
    "switch": ("gdp.cli.switch", "gdp-switch"),
    "rib": ("gdp.cli.rib", "gdp-rib"),
    "relay": ("gdp.cli.relay", "gdp-relay"),
    "proxy": ("proxy.cli.proxy", "gdp-proxy"),
    "replay": ("proxy.cli.replay", "gdp-replay"),
}


class GdpCommand(CommandExtension):  # type: ignore[misc]  # ros2cli has no types
    """Names, keys, switches and doors of the Global Data Plane."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:  # noqa: ARG002  # their call
        """Accept all arguments unparsed, including ``--help``; the ``gdp`` command parses them."""
        parser.prefix_chars = "\0"  # so that no argument is parsed as an option
        parser.add_argument("words", nargs=argparse.REMAINDER)

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:  # noqa: ARG002  # their call
        """Run ``gdp WORDS``; exit with its status if that is not 0."""
        words: list[str] = args.words
        if words and words[0] in PROGRAMS:
            module, program = PROGRAMS[words[0]]
            sys.argv = [program, *words[1:]]
            importlib.import_module(module).main()
        else:
            importlib.import_module("gdp.cli.gdp").main(words or ["--help"])
        return 0
