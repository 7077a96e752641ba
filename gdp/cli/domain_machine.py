"""``gdp domain create``, ``token``, ``ls``, ``remove`` and ``serve``: a domain whose machines join with tokens."""

from __future__ import annotations

import asyncio
import json
import re
import sys
import time
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.machine import AtDirectory, NoSystemd, Start, directory_of, say, start_machine
from gdp.cli.node import set_up_logging
from gdp.cli.output import moment, show
from gdp.cli.tables import columns
from gdp.enrolment.addresses import default_addresses, duration_s, endpoint_of, is_private, server_text
from gdp.enrolment.create import BORDER, DomainPlan, create_domain, make_token
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.member_setup import LISTEN_PORT, RELAY_PORT
from gdp.enrolment.preflight import check_ports, check_tunnels
from gdp.enrolment.registry import MachineRow, Registry
from gdp.enrolment.removal import remove_machine
from gdp.enrolment.server import POLL_MAX_S, bind_server, serve_domain
from gdp.errors import LocalError
from gdp.host.interruption import Interrupted, interruptible
from gdp.terminal import echo
from gdp.trust.join_token import JoinRole

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}", re.ASCII)

Name = Annotated[str, typer.Argument(metavar="NAME", help="of the domain")]
Public = Annotated[
    list[str],
    typer.Option("--public", metavar="HOST[:PORT]", help="where everyone reaches this machine, by UDP and TCP"),
]
JoinRoleText = Annotated[str, typer.Option("--role", help="robot, switch or leaf; see the how-to page on joining")]
Valid = Annotated[str, typer.Option("--valid", metavar="TIME", help="how long the token can be used: 30m, 1h, 7d")]
RelayPort = Annotated[int, typer.Option("--relay-port", min=0, max=65_535, help="TCP port of the relay; 0: none")]
Tokens = Annotated[int, typer.Option("--tokens", min=1, max=100, help="how many to print: one joins one machine")]
Listen = Annotated[int, typer.Option("--listen", min=1, max=65_535, help="UDP port of tunnels, TCP port of enrolment")]


def create(
    name: Name,
    public: Public = [],  # noqa: B006 (the library copies it)
    directory: AtDirectory = None,
    listen: Listen = LISTEN_PORT,
    relay_port: RelayPort = RELAY_PORT,
    label: options.Label = BORDER,
    tokens: Tokens = 1,
    no_systemd: NoSystemd = False,
    start: Start = True,
    as_json: options.Json = False,
) -> None:
    """Create a trust domain on a reachable machine, start its border, and print a token for each machine to join.

    \b
    Examples:
      gdp domain create lab --public lab.example.org --tokens 2
      gdp domain create lab --public 203.0.113.7:51820 --no-systemd
    """
    if not _NAME.fullmatch(name):
        raise LocalError(f"domain create: a name has letters, digits, '.', '_' and '-', not {name!r}")
    servers = [server_text(each, listen) for each in public] or _own_servers(listen)
    plan = DomainPlan(
        name=name,
        directory=directory_of(name, directory),
        public=[endpoint_of(each) for each in servers],
        servers=servers,
        listen=listen,
        relay_port=relay_port,
        label=label,
    )
    if start:
        check_tunnels()
        relay = {relay_port: "--relay-port"} if relay_port else {}
        check_ports({listen: "--listen"}, {listen: "--listen", **relay})
    files = create_domain(plan)
    say(f"domain {name} is in {files.directory}; keep a copy of {files.directory / 'domain'} in a safe place")
    made = [make_token(files, JoinRole.ROBOT, valid_s=duration_s("1h")).to_text() for _ in range(tokens)]
    result = {"domain": name, "directory": str(files.directory), "servers": servers, "tokens": made}
    say("on each machine: gdp join, which asks for a token; each is good once, for an hour")
    show(result, as_json=as_json, plain="\n".join(made))
    sys.stdout.flush()
    if start:
        start_machine(files.directory, no_systemd=no_systemd)


def token(
    name: Name,
    role: JoinRoleText = JoinRole.ROBOT.value,
    valid: Valid = "1h",
    label: Annotated[str, typer.Option("--label", help="the machine must have this label")] = "",
    directory: AtDirectory = None,
    as_json: options.Json = False,
) -> None:
    """Print a token: one machine joins with it, once, in one role. Type gdp join there, which asks for it.

    \b
    Examples:
      gdp domain token lab
      gdp domain token lab --role switch --valid 1d --label gateway
    """
    roles = [each.value for each in JoinRole if not each.is_of_cluster]
    if role not in roles:
        raise LocalError(f"domain token: --role is {', '.join(roles)}, not {role!r}")
    files = DomainFiles.load(directory_of(name, directory))
    made = make_token(files, JoinRole(role), valid_s=duration_s(valid), label=label)
    until = moment(made.expires_unix_s)
    result = {"token": made.to_text(), "role": role, "label": label or None, "until": until}
    show(result, as_json=as_json, plain=made.to_text())


def ls(
    name: Name,
    directory: AtDirectory = None,
    everything: Annotated[bool, typer.Option("--all", help="removed machines, too")] = False,
    as_json: options.Json = False,
) -> None:
    """List the machines of a domain.

    \b
    Examples:
      gdp domain ls lab
      gdp domain ls lab --all --json
    """
    files = DomainFiles.load(directory_of(name, directory))
    with Registry(files.config.state) as registry:
        rows = [_row(each) for each in registry.machines(with_removed=everything)]
    if as_json:
        echo(json.dumps(rows, ensure_ascii=False))
        return
    titles = {"label": "label", "role": "role", "name": "name", "joined": "joined", "seen": "last seen",
              "expires": "expires", "state": "state"}  # fmt: skip
    cells = [[str(row[key] or "-")[: 8 if key == "name" else None] for key in titles] for row in rows]
    echo("\n".join(columns([*titles.values()], cells)))


def remove(
    name: Name,
    node: Annotated[str, typer.Argument(metavar="LABEL", help="of the machine")],
    directory: AtDirectory = None,
    as_json: options.Json = False,
) -> None:
    """Remove a machine from a domain: its memberships are revoked, and its tunnel closes within a second.

    \b
    Example:
      gdp domain remove lab robot-7
    """
    removed = remove_machine(DomainFiles.load(directory_of(name, directory)), node)
    show({"removed": removed.machine.label, "revoked": removed.revoked}, as_json=as_json)


def serve(directory: options.Directory, as_json: options.Json = False) -> None:
    """Run the enrolment server of a domain until Ctrl-C; the units of the border do that.

    \b
    Example:
      gdp domain serve /var/lib/gdp/lab
    """
    set_up_logging(verbose=False)
    files = DomainFiles.load(directory)
    listening = bind_server(files.config.listen)
    show({"listening": files.config.listen}, as_json=as_json, plain=f"listening on TCP port {files.config.listen}")
    sys.stdout.flush()
    try:
        asyncio.run(interruptible(serve_domain(files, listening)))
    except Interrupted:
        say("the enrolment server has ended")


def _own_servers(listen: int) -> list[str]:
    addresses = default_addresses()
    if not addresses:
        raise LocalError("domain create: this machine has no default route: state --public HOST")
    for each in addresses:
        if is_private(each):
            say(f"{each} is a private address: machines elsewhere need a --public HOST that leads here")
    return [server_text(each, listen) for each in addresses]


def _row(machine: MachineRow) -> dict[str, object]:
    names = {each.role: each.name.to_text() for each in machine.nodes}
    switch = next((each.name.to_text() for each in machine.nodes if each.role in ("switch", "leaf")), "")
    is_online = time.time() - machine.seen_unix_s < 2 * POLL_MAX_S
    state = "online" if is_online else "offline"
    if machine.removed_unix_s is not None:
        state = "revoked"
    elif machine.has_double:
        state = "two machines have this identity"
    return {
        "label": machine.label,
        "role": machine.role,
        "name": switch,
        "nodes": names,
        "joined": moment(int(machine.joined_unix_s)),
        "seen": moment(int(machine.seen_unix_s)) if machine.seen_unix_s else None,
        "expires": moment(machine.until_unix_s) if machine.nodes else None,
        "revoked": None if machine.removed_unix_s is None else moment(int(machine.removed_unix_s)),
        "state": state,
    }
