"""``gdp join``, ``gdp up`` and ``gdp agent``: a machine that becomes a member with a token, and its programs."""

from __future__ import annotations

import re
import signal
import socket
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.extension import COMMANDS
from gdp.cli.machine import (
    BORDER_SEEN_S,
    AtDirectory,
    NoSystemd,
    Start,
    directory_of,
    paths_up,
    run_programs,
    say,
    start_machine,
)
from gdp.cli.node import set_up_logging
from gdp.cli.output import show
from gdp.cli.secret import PROMPT, Secret
from gdp.enrolment.agent import Agent
from gdp.enrolment.channel import connect_any
from gdp.enrolment.domain_join import JoinRequest, join_domain, prefer_server
from gdp.enrolment.preflight import check_tunnels
from gdp.enrolment.programs import Machine, check_program, missing_ros, read_machine
from gdp.sharing.member_exchange import MemberExchange
from gdp.sharing.upkeep import ShareUpkeep
from gdp.stores.keyring import CARD
from gdp.trust.join_token import JoinToken

_UNSAFE: Final = re.compile(r"[^A-Za-z0-9._-]")

JOIN_TOKEN: Final = Secret("join token", "--token-file", "GDP_TOKEN")

Argument = Annotated[
    str | None, typer.Argument(metavar="[-]", help="ask for the token, as without a file and without GDP_TOKEN")
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        metavar="FILE",
        help="a private file with a token of gdp domain create or gdp domain token; -: ask for it, the default."
        " Without: GDP_TOKEN, if set",
    ),
]
LabelText = Annotated[
    str | None, typer.Option("--label", help="the machine's name for people; by default its host name")
]
MachinePath = Annotated[Path, typer.Argument(metavar="PATH", help="The machine's folder, or its machine.yaml.")]
Suggest = Annotated[bool, typer.Option("--suggest", help="Only write proxy.yaml, or proxy.yaml.suggested next to one.")]
Uplinks = Annotated[
    list[str], typer.Option("--uplink", metavar="IFACE", help="a device with a tunnel of its own; repeatable")
]


def join(
    argument: Argument = None,
    token_file: TokenFile = None,
    label: LabelText = None,
    directory: AtDirectory = None,
    uplink: Uplinks = [],  # noqa: B006 (the library copies it)
    no_systemd: NoSystemd = False,
    start: Start = True,
    as_json: options.Json = False,
) -> None:
    """Join the domain of a token: make keys, fetch the memberships, and start switch, proxy and agent.

    It asks for the token, so that no other user of the machine sees it. A token as an argument is refused.

    \b
    Examples:
      gdp join
      gdp join --token-file robot.token --label robot-7 --uplink wlan0 --uplink wwan0
      ssh border gdp domain token lab | gdp join --label robot-7
    """
    read = JoinToken.from_text(_token_text(argument, token_file))
    if start:
        check_tunnels()
    if directory is None:
        with connect_any(read.servers, read.root) as channel:
            directory = directory_of(_UNSAFE.sub("-", channel.root.label), None)
            read = prefer_server(read, channel.server)
    request = JoinRequest(token=read, label=label or _host_name(), directory=directory, uplinks=uplink)
    joined = join_domain(request)
    say(f"joined the domain {joined.root.label} as {joined.label} ({joined.role}); files are in {directory}")
    for identity in joined.identities:
        say(f"  {identity.role.value:<6} {identity.name.to_text()}")
    if as_json:
        names = {each.role.value: each.name.to_text() for each in joined.identities}
        result = {"domain": joined.root.label, "label": joined.label, "role": joined.role, "directory": str(directory)}
        show({**result, "nodes": names}, as_json=True)
        sys.stdout.flush()
    if start:
        start_machine(directory, no_systemd=no_systemd, observed=_say_border)


def _token_text(argument: str | None, file: Path | None) -> str:
    if argument is not None and argument != str(PROMPT):
        raise JOIN_TOKEN.refused("gdp join TOKEN")
    text = JOIN_TOKEN.read(file if argument is None else PROMPT)
    return text or JOIN_TOKEN.read(PROMPT) or ""


def up(
    path: MachinePath,
    suggest: Suggest = False,
    no_systemd: NoSystemd = False,
    as_json: options.Json = False,
) -> None:
    """Start the programs of a machine: switch, proxy, and RIB and store where it has them.

    A machine that joined or created a domain starts as systemd units, or in the foreground. Nodes that were configured
    by hand, in machine.yaml or in files of their own, run in the foreground until Ctrl-C; gdp unit install makes
    units. What ends is restarted, with growing pauses. The log is one, and each line begins with its program. The exit
    code is 1 if a program has failed. Without a proxy.yaml, the first start looks at the ROS graph, and writes one with
    a commented rule for each name.

    \b
    Examples:
      gdp up /var/lib/gdp/lab --no-systemd
      gdp up robot
      gdp up robot/machine.yaml
      gdp up robot --suggest
    """
    machine = read_machine(path)
    if suggest or _lacks_proxy_file(machine):
        COMMANDS.get("suggest", "gdp up --suggest")(machine.directory)
        if suggest:
            return
        machine = read_machine(path)
    if as_json:
        names = [each.name for each in machine.programs]
        show({"directory": str(machine.directory), "programs": names}, as_json=True)
        sys.stdout.flush()
    if machine.is_member:
        check_tunnels()
        start_machine(machine.directory, no_systemd=no_systemd, observed=_say_border)
        return
    for each in machine.programs:
        check_program(each)
    run_programs(machine.programs)


def _lacks_proxy_file(machine: Machine) -> bool:
    """Return whether a machine has keys of a proxy, but no configuration of it, and can run one."""
    if machine.missing_proxy is not None:
        return True
    has_keys = (machine.directory / "proxy" / CARD).is_file()
    return has_keys and all(each.name != "proxy" for each in machine.programs) and not missing_ros()


def agent(directory: options.Directory, as_json: options.Json = False) -> None:
    """Run the agent of a machine until Ctrl-C; the units of the machine do that.

    It renews memberships and delegations, fetches mail, and delegates shared names that appear.

    \b
    Example:
      gdp agent /var/lib/gdp/lab
    """
    set_up_logging(verbose=False)
    made = Agent(directory)
    show({"directory": str(directory)}, as_json=as_json, plain=f"agent of {directory}; Ctrl-C ends it")
    upkeep = ShareUpkeep(directory, MemberExchange(directory, fetches=False))
    has_proxy = (directory / "proxy.yaml").exists()
    if has_proxy:
        upkeep.start()
    try:
        run_agent(made)
    finally:
        if has_proxy:
            upkeep.stop()


def run_agent(made: Agent) -> None:
    """Run an agent until SIGINT or SIGTERM."""

    def stop(number: int, frame: FrameType | None) -> None:
        """End the agent."""
        del number, frame
        made.stop()

    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, stop)
    made.run()


def _say_border(directory: Path) -> None:
    """Say whether the border is a neighbour: it is observed, not assumed."""
    seen, has_relay = paths_up(directory)
    if seen:
        say(f"tunnels are up: {', '.join(seen)}")
    elif has_relay:
        say("no tunnel is up, UDP seems to be blocked: frames pass through TLS at the border, which is slower")
    else:
        say(
            f"no tunnel is up after {BORDER_SEEN_S:g} s: the switch keeps trying. Is UDP to the border let through? See"
            f" gdp status {directory / 'switch'}"
        )


def _host_name() -> str:
    return socket.gethostname().partition(".")[0] or "robot"
