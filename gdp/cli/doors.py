"""Commands of the package ``proxy`` under ``gdp``, loaded by name when they run.

I/O.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from pathlib import Path

import typer

from gdp.errors import LocalError

__all__ = ["foxglove", "rosbridge", "rule", "run_of_proxy", "suggest_rules", "watch"]


def foxglove(context: typer.Context) -> None:
    """Let Foxglove see what a node's delegations allow, through a WebSocket server on this machine."""
    run_of_proxy("foxglove", context.args, extras="proxy,doors")


def rosbridge(context: typer.Context) -> None:
    """Let rosbridge clients use what a node's delegations allow, through a WebSocket server on this machine."""
    run_of_proxy("rosbridge", context.args, extras="proxy,doors")


def rule(context: typer.Context) -> None:
    """Add, remove and list rules of a proxy while it runs."""
    run_of_proxy("rule", context.args)


def watch(context: typer.Context) -> None:
    """Print events when publishers, readers and servers of a name appear, go or are silent."""
    run_of_proxy("watch", context.args)


def suggest_rules(directory: Path) -> None:
    """Write a commented ``proxy.yaml`` from the live ROS graph into a machine's folder.

    Raises:
        LocalError: the package ``proxy`` or a ROS is not installed, or the file cannot be written.
    """
    if find_spec("proxy") is None:
        raise LocalError("gdp up --suggest needs the package proxy (run: pip install 'gdp-ros[proxy,dds]')")
    importlib.import_module("proxy.cli.suggest").suggest(directory)


def run_of_proxy(command: str, arguments: list[str], *, extras: str = "proxy") -> None:
    """Run ``main`` of a module of ``proxy.cli``.

    Args:
        extras: of this distribution that it needs, for the error.

    Raises:
        LocalError: the package ``proxy`` is not installed.
    """
    if find_spec("proxy") is None:
        raise LocalError(f"gdp {command} needs the package proxy (run: pip install 'gdp-ros[{extras}]')")
    importlib.import_module(f"proxy.cli.{command}").main(arguments)
