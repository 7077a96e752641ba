"""``gdp-rib`` command.

I/O.
"""

from __future__ import annotations

import typer

from gdp.cli.completion import allow_completion
from gdp.cli.node import (
    AWAIT_IFACE_S,
    AwaitIface,
    Check,
    Config,
    Format,
    Json,
    Level,
    LogFormat,
    LogLevel,
    MemberPlane,
    Verbose,
    emit,
    emit_wait,
    failing_clearly,
    member_plane,
    set_up_logging,
)
from gdp.cli.version import HELP, Version, versioned
from gdp.config.config import RibConfig
from gdp.crypto.certificates import Role
from gdp.links.uplink import wait_for_device
from gdp.names import Name
from gdp.nodes.membership import load_member
from gdp.nodes.rib import run_rib
from gdp.terminal import echo

__all__ = ["main"]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(context_settings=HELP, epilog="Example: gdp-rib --config rib.yaml")
def rib(
    config: Config,
    await_iface: AwaitIface = AWAIT_IFACE_S,
    data_plane: MemberPlane = None,
    check: Check = False,
    json: Json = False,
    verbose: Verbose = False,
    log_level: LogLevel = Level.INFO,
    log_format: LogFormat = Format.TEXT,
    version: Version = False,
) -> None:
    """Answer queries for the nodes that advertise a name in one trust domain, until Ctrl-C."""
    del version  # the option's callback ends the command
    set_up_logging(verbose=verbose, level=log_level, form=log_format)
    with failing_clearly():
        settings = RibConfig.load(config)
        if data_plane is not None:
            settings = settings.model_copy(update={"data_plane": member_plane(data_plane)})
        if check:
            identity, _ = load_member(settings.identity, settings.domain, Role.RIB)
            _report("checked", f"configuration good: RIB {identity.name.short}", identity.name, json=json)
            return
        wait_for_device(settings.iface, await_iface)
        run_rib(
            settings,
            lambda name: _report("ready", f"RIB {name.short} is up; Ctrl-C ends it", name, json=json),
            emit_wait if json else None,
        )


def _report(event: str, text: str, name: Name, *, json: bool) -> None:
    if json:
        emit(event, name=name.to_text())
    else:
        echo(text)


def main() -> None:
    """Run the command."""
    allow_completion("gdp-rib")
    versioned(app)(prog_name="gdp-rib")


if __name__ == "__main__":
    main()
