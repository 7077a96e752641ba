"""``gdp-switch`` command.

I/O.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pwd
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli.completion import allow_completion
from gdp.cli.node import (
    Check,
    Format,
    FoundConfig,
    Json,
    Level,
    LogFormat,
    LogLevel,
    Verbose,
    emit,
    emit_wait,
    failing_clearly,
    set_up_logging,
)
from gdp.cli.version import HELP, Version, versioned
from gdp.config.config import DataPlane, SwitchConfig
from gdp.config.found_config import find_switch_config
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.enrolment.addresses import default_directory
from gdp.errors import LocalError
from gdp.nodes.membership import load_member
from gdp.nodes.switch import run_switch
from gdp.terminal import echo

__all__ = ["main"]

log = logging.getLogger(__name__)

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(
    context_settings=HELP,
    epilog="Examples: gdp-switch --iface eth0; gdp-switch --iface eth0 --iface eth1 --config switch.yaml",
)
def switch(
    config: FoundConfig = None,
    iface: Annotated[
        list[str] | None,
        typer.Option(help="A port; once for each. Adds to the file's; replaces those of a found file."),
    ] = None,
    data_plane: Annotated[str | None, typer.Option(help="auto, kernel, raw or scapy; instead of the file's.")] = None,
    check: Check = False,
    json: Json = False,
    verbose: Verbose = False,
    log_level: LogLevel = Level.INFO,
    log_format: LogFormat = Format.TEXT,
    version: Version = False,
) -> None:
    """Switch frames by 256-bit names between layer-2 ports, until Ctrl-C.

    With the identity of a leaf it serves its attached nodes, and forwards nothing between its neighbours. Without
    --config it looks for the switch.yaml of this machine: here, in a folder here, as gdp lab leaves it, and where gdp
    join puts it.
    """
    del version  # the option's callback ends the command
    set_up_logging(verbose=verbose, level=log_level, form=log_format)
    with failing_clearly():
        settings = _settings(config, iface or [])
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


def _settings(config: Path | None, ifaces: list[str]) -> SwitchConfig:
    """Return the configuration of a given file, or of the one that this machine has, with the ports of the line."""
    if config is not None:
        return SwitchConfig.load(config).with_ifaces(ifaces)
    found = find_switch_config(ifaces, Path.cwd(), _machine_folders())
    log.info("configuration found path=%s", found)
    settings = SwitchConfig.load(found)
    return settings.only_ifaces(ifaces) if ifaces else settings


def _machine_folders() -> list[Path]:
    """Return where joining a domain puts the files of this machine; behind sudo also for the user who called it."""
    is_root = os.geteuid() == 0
    folders = [default_directory("", is_root=is_root, state_home=os.environ.get("XDG_STATE_HOME", ""))]
    caller = os.environ.get("SUDO_UID", "")
    if is_root and caller.isascii() and caller.isdigit():
        with contextlib.suppress(KeyError):  # a user of a directory service that is away has no home here
            folders.append(Path(pwd.getpwuid(int(caller)).pw_dir, ".local/state/gdp"))
    return folders


def _data_plane(text: str) -> DataPlane:
    known: dict[str, DataPlane] = {"auto": "auto", "kernel": "kernel", "raw": "raw", "scapy": "scapy"}
    if text not in known:
        raise LocalError(f"--data-plane is {', '.join(known)}, not {text}")
    return known[text]


def _report_check(identity: Identity, ports: int, *, json: bool) -> None:
    if json:
        emit("checked", name=identity.name.to_text(), role=identity.role.value, ports=ports)
    else:
        echo(f"configuration good: {identity.role.value} {identity.name.short}, {ports} ports")


def _report_ready(identity: Identity, plane: str, reason: str, *, json: bool) -> None:
    if json:
        emit("ready", name=identity.name.to_text(), role=identity.role.value, data_plane=plane, reason=reason)
        return
    echo(f"{identity.role.value} {identity.name.short} is up, data plane {plane}; Ctrl-C ends it")
    if reason:
        echo(f"not the kernel data plane: {reason}")


def main() -> None:
    """Run the command."""
    allow_completion("gdp-switch")
    versioned(app)(prog_name="gdp-switch")


if __name__ == "__main__":
    main()
