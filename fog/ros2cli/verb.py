"""Verbs of ``ros2 fog``: each passes its arguments to the ``fog`` command.

I/O; imported by ros2cli through the entry points ``ros2cli.extension_point`` and ``fog.verb``.
Source: ros2cli 0.32 (jazzy), ``ros2cli.plugin_system``.
"""

from __future__ import annotations

import argparse

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version

__all__ = [
    "CostVerb",
    "DownVerb",
    "LaunchVerb",
    "LocalVerb",
    "LogsVerb",
    "LsVerb",
    "PlanVerb",
    "PricesVerb",
    "PushVerb",
    "ScaleVerb",
    "SshVerb",
    "StatusVerb",
    "SuperviseVerb",
    "VerbExtension",
    "WheelsVerb",
]


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


class LaunchVerb(VerbExtension):
    """Start what a launch file describes, the cluster first."""


class LsVerb(VerbExtension):
    """List clusters."""


class StatusVerb(VerbExtension):
    """Show a cluster's machines and what they serve."""


class ScaleVerb(VerbExtension):
    """Add or take away replicas while all runs."""


class LogsVerb(VerbExtension):
    """Show what a machine's programs wrote."""


class PushVerb(VerbExtension):
    """Bring the present software to a cluster's machines."""


class SshVerb(VerbExtension):
    """Open a shell on a machine."""


class CostVerb(VerbExtension):
    """Show what clusters cost."""


class PlanVerb(VerbExtension):
    """Compute how many replicas are needed, and their price."""


class PricesVerb(VerbExtension):
    """Show what machines cost, and how far away they are."""


class SuperviseVerb(VerbExtension):
    """Keep clusters as they are wanted."""


class WheelsVerb(VerbExtension):
    """Build the wheels that rented machines install."""


class LocalVerb(VerbExtension):
    """Let something happen to a local machine."""


class DownVerb(VerbExtension):
    """Give all machines of a cluster back."""
