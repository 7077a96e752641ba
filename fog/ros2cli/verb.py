"""Verbs of ``ros2 fog``: each passes its arguments to the ``fog`` command.

I/O; imported by ros2cli through the entry points ``ros2cli.extension_point`` and ``fog.verb``.
Source: ros2cli 0.32 (jazzy), ``ros2cli.plugin_system``.
"""

from __future__ import annotations

import argparse
from functools import cache
from typing import Final

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version


class VerbExtension:
    """The extension point ``fog.verb``; ros2cli sets ``NAME`` to the name of the entry point."""

    NAME: str | None = None
    EXTENSION_POINT_VERSION = "0.1"

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, "^0.1")

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:  # noqa: ARG002  # their call
        """Accept all arguments unparsed, including ``--help``; the ``fog`` command parses them."""
        parser.prefix_chars = "\0"  # so that no argument is parsed as an option
        parser.add_argument("words", nargs=argparse.REMAINDER)

    def main(self, *, args: argparse.Namespace) -> int:
        """Run ``fog NAME WORDS``; exit with its status if that is not 0."""
        from fog.cli.app import main

        main([str(self.NAME), *args.words], name="ros2 fog")
        return 0


_VERBS: Final = {
    "LaunchVerb": "Start what a launch file describes, the cluster first.",
    "LsVerb": "List clusters.",
    "StatusVerb": "Show a cluster's machines and what they serve.",
    "ScaleVerb": "Add or take away replicas while all runs.",
    "LogsVerb": "Show what a machine's programs wrote.",
    "PushVerb": "Bring the present software to a cluster's machines.",
    "SshVerb": "Open a shell on a machine.",
    "CostVerb": "Show what clusters cost.",
    "PlanVerb": "Compute how many replicas are needed, and their price.",
    "PricesVerb": "Show what machines cost, and how far away they are.",
    "SuperviseVerb": "Keep clusters as they are wanted.",
    "WheelsVerb": "Build the wheels that rented machines install.",
    "LocalVerb": "Let something happen to a local machine.",
    "DownVerb": "Give all machines of a cluster back.",
}  # class, as an entry point names it, and what ros2cli shows


@cache
def __getattr__(name: str) -> type[VerbExtension]:
    """Return the class of a verb."""
    if name not in _VERBS:
        raise AttributeError(name)
    return type(name, (VerbExtension,), {"__doc__": _VERBS[name]})
