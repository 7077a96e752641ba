"""Commands of other packages under ``gdp``, loaded through their entry points when they run.

I/O. The first six are shown and run where ``proxy`` or an extra is not installed: the error says which.
"""

from __future__ import annotations

from pathlib import Path

import typer

from gdp.cli.extension import load_command

__all__ = ["foxglove", "recording", "rosbridge", "rule", "rules_of_proxies", "service", "suggest_rules", "watch"]


def foxglove() -> None:
    """Let Foxglove see what a node's delegations allow, through a WebSocket server on this machine."""
    load_command("foxglove", extras="proxy,doors")


def rosbridge() -> None:
    """Let rosbridge clients use what a node's delegations allow, through a WebSocket server on this machine."""
    load_command("rosbridge", extras="proxy,doors")


def recording() -> None:
    """Complete a recording whose writer was killed."""
    load_command("recording")


def rule() -> None:
    """Add, remove and list rules of a proxy while it runs."""
    load_command("rule")


def service() -> None:
    """Call a service through the overlay, as a member."""
    load_command("service")


def watch() -> None:
    """Print events when publishers, readers and servers of a name appear, go or are silent."""
    load_command("watch")


def rules_of_proxies(context: typer.Context) -> None:
    """Give each proxy the delegations that the rules of its file need."""
    load_command("delegate")(context.args)


def suggest_rules(directory: Path) -> None:
    """Write a commented ``proxy.yaml`` from the live ROS graph into a machine's folder.

    Raises:
        LocalError: the package ``proxy`` or a ROS is not installed, or the file cannot be written.
    """
    load_command("suggest", user="gdp up --suggest", extras="proxy,dds")(directory)
