"""Command ``fog`` of ``ros2``.

I/O; imported by ros2cli through the entry point ``ros2cli.command``.
Source: ros2cli 0.32 (jazzy), ``ros2cli.command``.
"""

from __future__ import annotations

import argparse

from ros2cli.command import CommandExtension, add_subparsers_on_demand

from fog.ros2cli.verb import VerbExtension

_VERB = "_verb"


class FogCommand(CommandExtension):  # type: ignore[misc]  # ros2cli has no types
    """Replicated services on machines in the cloud."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the arguments of ``ros2 fog`` to a parser."""
        self._parser = parser
        add_subparsers_on_demand(parser, cli_name, _VERB, "fog.verb", required=False)

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:  # noqa: ARG002  # their call
        """Run a verb of ``ros2 fog``; return its exit code."""
        verb: VerbExtension | None = getattr(args, _VERB, None)
        if verb is None:
            self._parser.print_help()
            return 0
        return verb.main(args=args)
