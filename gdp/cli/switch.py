"""``gdp-switch`` command.

I/O. A command loads what a node needs when it runs one, so that its help comes at once.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pwd
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gdp.cli.node import Check, FoundConfig, Json, Logs, emit_wait, report, running, with_plane
from gdp.cli.program import Program

if TYPE_CHECKING:
    from gdp.config.config import SwitchConfig
    from gdp.crypto.identity import Identity

log = logging.getLogger(__name__)

app = Program("gdp-switch")
main = app.run


@app.command(epilog="Examples: gdp-switch --iface eth0; gdp-switch --iface eth0 --iface eth1 --config switch.yaml")
def switch(
    config: FoundConfig = None,
    iface: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DEVICE", help="A port; once for each. Adds to the file's; replaces those of a found file."
        ),
    ] = None,
    data_plane: Annotated[
        str | None, typer.Option(metavar="PLANE", help="auto, kernel, raw or scapy; instead of the file's.")
    ] = None,
    check: Check = False,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Switch frames by 256-bit names between layer-2 ports, until Ctrl-C.

    With the identity of a leaf it serves its attached nodes, and forwards nothing between its neighbours. Without
    --config it looks for the switch.yaml of this machine: here, in a folder here, as gdp lab leaves it, and where gdp
    join puts it.
    """
    from gdp.nodes.switch import run_switch

    with running(logs):
        settings = with_plane(_settings(config, iface or []), data_plane)
        if check:
            from gdp.crypto.certificates import Role
            from gdp.nodes.membership import load_member

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
    from gdp.config.config import SwitchConfig
    from gdp.config.found_config import find_switch_config

    if config is not None:
        return SwitchConfig.load(config).with_ifaces(ifaces)
    found = find_switch_config(ifaces, Path.cwd(), _machine_folders())
    log.info("configuration found path=%s", found)
    settings = SwitchConfig.load(found)
    return settings.only_ifaces(ifaces) if ifaces else settings


def _machine_folders() -> list[Path]:
    """Return where joining a domain puts the files of this machine; behind sudo also for the user who called it."""
    from gdp.enrolment.addresses import default_directory

    is_root = os.geteuid() == 0
    folders = [default_directory("", is_root=is_root, state_home=os.environ.get("XDG_STATE_HOME", ""))]
    caller = os.environ.get("SUDO_UID", "")
    if is_root and caller.isascii() and caller.isdigit():
        with contextlib.suppress(KeyError):  # a user of a directory service that is away has no home here
            folders.append(Path(pwd.getpwuid(int(caller)).pw_dir, ".local/state/gdp"))
    return folders


def _report_check(identity: Identity, ports: int, *, json: bool) -> None:
    role = identity.role.value
    text = f"configuration good: {role} {identity.name.short}, {ports} ports"
    report("checked", text, json=json, name=identity.name.to_text(), role=role, ports=ports)


def _report_ready(identity: Identity, plane: str, reason: str, *, json: bool) -> None:
    name, role = identity.name, identity.role.value
    text = f"{role} {name.short} is up, data plane {plane}; Ctrl-C ends it"
    if reason:
        text += f"\nnot the kernel data plane: {reason}"
    report("ready", text, json=json, name=name.to_text(), role=role, data_plane=plane, reason=reason)


if __name__ == "__main__":
    main()
