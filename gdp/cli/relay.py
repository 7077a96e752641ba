"""``gdp-relay`` command.

I/O.
"""

from __future__ import annotations

from typing import Annotated

import typer

from gdp.cli.completion import allow_completion
from gdp.cli.node import (
    Check,
    Config,
    Format,
    Json,
    Level,
    LogFormat,
    LogLevel,
    Verbose,
    emit,
    failing_clearly,
    set_up_logging,
)
from gdp.cli.output import show
from gdp.cli.version import HELP, Version, versioned
from gdp.config.relay_config import RelayConfig
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.management.control_client import ask_node
from gdp.nodes.membership import load_member
from gdp.nodes.relay import Relay, relay_control_path, run_relay
from gdp.ports.tap import tap_name
from gdp.state.control_protocol import Command
from gdp.terminal import echo

__all__ = ["main"]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

_STATUS_S = 10.0


@app.command(
    context_settings=HELP,
    epilog="Examples: gdp-relay --config relay.yaml; gdp-relay --config relay.yaml --check prints the device of each"
    " border, which is an optional port of the switch; gdp-relay --config relay.yaml --status",
)
def relay(
    config: Config,
    status: Annotated[bool, typer.Option("--status", help="Show the status of the running relay, and end.")] = False,
    check: Check = False,
    json: Json = False,
    verbose: Verbose = False,
    log_level: LogLevel = Level.INFO,
    log_format: LogFormat = Format.TEXT,
    version: Version = False,
) -> None:
    """Carry a switch's frames through TLS where the network blocks UDP, until Ctrl-C. It is slower than a tunnel.

    With the section server it is a border's end, with borders it is a member's end. Each connection has a TAP device,
    which has a carrier only while the connection is open.
    """
    del version  # the option's callback ends the command
    set_up_logging(verbose=verbose, level=log_level, form=log_format)
    with failing_clearly():
        settings = RelayConfig.load(config)
        if check or status:
            identity, _ = load_member(settings.identity, settings.domain, Role.SWITCH)
            if check:
                _report_check(identity, settings, json=json)
            else:
                response = ask_node(relay_control_path(settings, identity.name), Command.STATUS, _STATUS_S)
                show(response.result, as_json=json)
            return
        run_relay(settings, lambda identity, relay: _report_ready(identity, relay, json=json))


def _report_check(identity: Identity, settings: RelayConfig, *, json: bool) -> None:
    devices = {each.peer.to_text(): tap_name(identity.name, each.peer) for each in settings.borders}
    port = None if settings.server is None else settings.server.port
    if json:
        emit("checked", name=identity.name.to_text(), port=port, devices=devices)
        return
    echo(f"configuration good: relay of {identity.role.value} {identity.name.short}, server port {port or 'none'}")
    for peer, device in devices.items():
        echo(f"{device} leads to {peer}")


def _report_ready(identity: Identity, relay: Relay, *, json: bool) -> None:
    port = None if relay.server is None else relay.server.listening_port
    devices = [dialer.port.device.ifname for dialer in relay.dialers]
    if json:
        emit("ready", name=identity.name.to_text(), port=port, devices=devices)
        return
    echo(f"relay of {identity.role.value} {identity.name.short} is up, via TLS (slower); Ctrl-C ends it")


def main() -> None:
    """Run the command."""
    allow_completion("gdp-relay")
    versioned(app)(prog_name="gdp-relay")


if __name__ == "__main__":
    main()
