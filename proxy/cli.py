"""The ``gdp-proxy`` command.

Place: command.
"""

from __future__ import annotations

import typer

from gdp.cli.node import Check, Config, Json, Verbose, failing_clearly, set_up_logging
from proxy.checking import check_proxy
from proxy.config import ProxyConfig
from proxy.live import carry
from proxy.recording import record
from proxy.schema_cli import Schema

__all__ = ["main"]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(epilog="Example: gdp-proxy --config proxy.yaml --check")
def proxy(
    config: Config, check: Check = False, json: Json = False, verbose: Verbose = False, schema: Schema = False
) -> None:
    """Carry what the configuration names between ROS and the overlay, until Ctrl-C; SIGHUP reads it again.

    With a ros section it takes part in that graph; without one it records what it imports.
    """
    del schema  # it ends the command by itself
    set_up_logging(verbose=verbose)
    with failing_clearly():
        settings = ProxyConfig.load(config)
        if check:
            check_proxy(settings, json=json)
        elif settings.ros:
            carry(config, settings, json=json)
        else:
            record(settings, json=json)


def main() -> None:
    """Run the command."""
    app()


if __name__ == "__main__":
    main()
