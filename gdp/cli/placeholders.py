"""Commands of other packages and of extensions under ``gdp``, loaded through their entry points when they run.

I/O. All but the last two are shown and run where a package or an extra is not installed: the error says which.
"""

from __future__ import annotations

from pathlib import Path

import typer

from gdp.cli.extension import load_command

__all__ = [
    "dashboard",
    "decrypt_pcap",
    "foxglove",
    "recording",
    "rosbridge",
    "rule",
    "rules_of_proxies",
    "service",
    "suggest_rules",
    "watch",
    "wireshark",
]


def dashboard() -> None:
    """Show domains, switches, links, names, replicas, drops and events live, on one page, until Ctrl-C."""
    load_command("dashboard")


def decrypt_pcap() -> None:
    """Write a capture with the messages that the given keys open, for Wireshark with the dissector of gdp wireshark."""
    load_command("decrypt-pcap")


def foxglove() -> None:
    """Let Foxglove see what a node's delegations allow, through a WebSocket server on this machine."""
    load_command("foxglove")


def rosbridge() -> None:
    """Let rosbridge clients use what a node's delegations allow, through a WebSocket server on this machine."""
    load_command("rosbridge")


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


def wireshark() -> None:
    """Print a Wireshark dissector for our frames, in Lua, made from the Scapy layers; --install puts it in place."""
    load_command("wireshark")


def rules_of_proxies(context: typer.Context) -> None:
    """Give each proxy the delegations that the rules of its file need."""
    load_command("delegate")(context.args)


def suggest_rules(directory: Path) -> None:
    """Write a commented ``proxy.yaml`` from the live ROS graph into a machine's folder.

    Raises:
        LocalError: the package ``proxy`` or a ROS is not installed, or the file cannot be written.
    """
    load_command("suggest", user="gdp up --suggest")(directory)
