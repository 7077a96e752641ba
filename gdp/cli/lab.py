"""``gdp lab``: command that makes the keys, memberships and files of a small lab, except the rules of its proxies."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.stores.files import public, write_all
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import DELEGATIONS, OWNER_PUBLIC, load_domain, load_owner

_SWITCH: Final = """\
identity: switch
domain: {{root: switch/root.crt}}
{ports}attach: [{attach}]
"""
_PORTS: Final = "ports: [{{iface: {iface}}}]\n"
_RIB: Final = """\
identity: rib
domain: {root: rib/root.crt}
iface: rib0
"""
_SWITCH_NODE: Final = Path("switch")
_RIB_NODE: Final = Path("rib")

Hosts = Annotated[list[Path], typer.Argument(metavar="HOST...", help="a directory to make for each machine")]
DomainDir = Annotated[Path, typer.Option("--domain", metavar="DIR", help="the trust domain; made if it is not there")]
OwnerDir = Annotated[Path, typer.Option("--owner", metavar="DIR", help="the owner of names; made if it is not there")]
Iface = Annotated[str, typer.Option("--iface", help="what joins the machines")]
IsLeaf = Annotated[
    bool, typer.Option("--leaf", help="their switches are leaves: nothing passes through them between other switches")
]

IsProgram = Annotated[
    bool, typer.Option("--program", help="each HOST is the node of a program of this machine, next to one switch")
]


def lab(
    hosts: Hosts,
    domain: DomainDir = Path("lab"),
    owner: OwnerDir = Path("owner"),
    iface: Iface = "eth0",
    leaf: IsLeaf = False,
    program: IsProgram = False,
    as_json: options.Json = False,
) -> None:
    """Make a small lab: one trust domain, one owner, and for each machine a directory with a switch and a proxy.

    A new domain's RIB is on the first machine. If the domain exists already, the command adds machines to it.
    With --program, the switch, its RIB and the nodes are in this directory, in a new domain.

    \b
    Examples:
      gdp lab robot server --iface eth0
      gdp lab arm --leaf
      gdp lab --program robot server
    """
    _refuse_what_is_there([*hosts, *([_SWITCH_NODE, _RIB_NODE, domain] if program else [])])
    is_new = not domain.exists()
    if is_new:
        make_domain(domain, domain.name)
    else:
        load_domain(domain)
    if owner.exists():
        load_owner(owner)
    else:
        make_owner(owner)
    if program:
        _make_programs(hosts, domain)
    for index, host in enumerate(() if program else hosts):
        has_rib = is_new and index == 0
        _make_host(host, domain, (owner / OWNER_PUBLIC).read_bytes(), iface, has_rib=has_rib, is_leaf=leaf)
    result = {
        "domain": f"{domain} ({'made' if is_new else 'was there'})",
        "owner": str(owner),
        "programs" if program else "machines": [str(host) for host in hosts],
        "rib": str(_RIB_NODE if program else hosts[0]) if is_new else None,
    }
    show(result, as_json=as_json)


def _refuse_what_is_there(hosts: Sequence[Path]) -> None:
    """Raise ``LocalError`` before the first change if any part exists already."""
    for index, host in enumerate(hosts):
        if host.exists() or host in hosts[:index]:
            raise LocalError(f"{host} is there already")


def _make_programs(programs: Sequence[Path], domain: Path) -> None:
    make_node(_SWITCH_NODE, Role.SWITCH, _SWITCH_NODE.name, domain)
    make_node(_RIB_NODE, Role.RIB, _RIB_NODE.name, domain)
    for each in programs:
        make_node(each, Role.PROXY, each.name, domain)
    attach = ", ".join(f"{each.name}0" for each in (_RIB_NODE, *programs))
    files = {"switch.yaml": _SWITCH.format(ports="", attach=attach), "rib.yaml": _RIB}
    write_all(Path(), {name: public(text.encode()) for name, text in files.items()})


def _make_host(host: Path, domain: Path, owner_key: bytes, iface: str, *, has_rib: bool, is_leaf: bool) -> None:
    roles = [Role.SWITCH, *([Role.RIB] if has_rib else []), Role.PROXY]
    for role in roles:
        make_node(host / role.value, Role.LEAF if is_leaf and role is Role.SWITCH else role, host.name, domain)
    (host / Role.PROXY.value / DELEGATIONS).mkdir(mode=0o700)
    attach = ", ".join(f"{role.value}0" for role in roles[1:])
    ports = _PORTS.format(iface=json.dumps(iface))
    files = {
        OWNER_PUBLIC: public(owner_key),
        "switch.yaml": public(_SWITCH.format(ports=ports, attach=attach).encode()),
    }
    if has_rib:
        files["rib.yaml"] = public(_RIB.encode())
    write_all(host, files)
