"""``gdp-switch`` command.

I/O.
"""

from __future__ import annotations

from typing import Annotated

import typer

from gdp.cli.node import Check, Config, Json, Verbose, emit, emit_wait, failing_clearly, set_up_logging
from gdp.cli.version import Version
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import LocalError
from gdp.nodes.config import DataPlane, SwitchConfig
from gdp.nodes.membership import load_member
from gdp.nodes.switch import run_switch

__all__ = ["main"]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(
    epilog="Example: gdp-switch --iface eth0 --iface eth1 --config switch.yaml",
)
def switch(
    config: Config,
    iface: Annotated[list[str] | None, typer.Option(help="A port; once for each. Adds to the file's.")] = None,
    data_plane: Annotated[str | None, typer.Option(help="auto, kernel, raw or scapy; instead of the file's.")] = None,
    check: Check = False,
    json: Json = False,
    verbose: Verbose = False,
    version: Version = False,
) -> None:
    """Switch frames by 256-bit names between layer-2 ports, until Ctrl-C.

    With the identity of a leaf it serves its attached nodes, and forwards nothing between its neighbours.
    """
    del version  # the option's callback ends the command
    set_up_logging(verbose=verbose)
    with failing_clearly():
        settings = SwitchConfig.load(config).with_ifaces(iface or [])
        if data_plane is not None:
            settings = settings.model_copy(update={"data_plane": _data_plane(data_plane)})
        if check:
            identity, _ = load_member(settings.identity, settings.domain, Role.SWITCH)
            _report_check(identity, len(settings.ports), json=json)
            return
        run_switch(
            settings,
            lambda identity, plane, reason: _report_ready(identity, plane, reason, json=json),
            emit_wait if json else None,
        )


def _data_plane(text: str) -> DataPlane:
    known: dict[str, DataPlane] = {"auto": "auto", "kernel": "kernel", "raw": "raw", "scapy": "scapy"}
    if text not in known:
        raise LocalError(f"--data-plane is {', '.join(known)}, not {text}")
    return known[text]


def _report_check(identity: Identity, ports: int, *, json: bool) -> None:
    if json:
        emit("checked", name=identity.name.to_text(), role=identity.role.value, ports=ports)
    else:
        typer.echo(f"configuration good: {identity.role.value} {identity.name.short}, {ports} ports")


def _report_ready(identity: Identity, plane: str, reason: str, *, json: bool) -> None:
    if json:
        emit("ready", name=identity.name.to_text(), role=identity.role.value, data_plane=plane, reason=reason)
        return
    typer.echo(f"{identity.role.value} {identity.name.short} is up, data plane {plane}; Ctrl-C ends it")
    if reason:
        typer.echo(f"not the kernel data plane: {reason}")


def main() -> None:
    """Run the command."""
    app(prog_name="gdp-switch")


if __name__ == "__main__":
    main()
