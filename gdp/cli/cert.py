"""``gdp cert``: commands for memberships: issue, install, show, renew and revoke."""

from __future__ import annotations

import json
import shlex
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options, rollover
from gdp.cli.key import asked_passphrase, token_key
from gdp.cli.output import moment, show, span
from gdp.cli.rollover import described_root
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.x509_profile import read_request, to_pem
from gdp.errors import LocalError
from gdp.names import Name
from gdp.stores.audit_log import note_once
from gdp.stores.files import public, read_public, refuse_existing, write_all
from gdp.stores.issue import (
    MEMBER_DAYS,
    ROOT_DAYS,
    admit,
    admit_node,
    install_membership,
    renew,
    renew_node,
    succeed_owner,
)
from gdp.stores.keyring import (
    CARD,
    NODE_CERTIFICATE,
    ROOT_CERTIFICATE,
    load_delegation,
    load_domain,
    load_node_keys,
    load_root,
    parsed,
)
from gdp.stores.ledger import LEDGER, read_ledger
from gdp.stores.rollover import trust_successor
from gdp.terminal import echo
from gdp.trust.audit import Action
from gdp.trust.revocation import Revocation

app = typer.Typer(no_args_is_help=True, help="Memberships: issue, renew, install, show, revoke; rollover of roots.")
app.add_typer(rollover.app, name="rollover")

Domain = Annotated[Path, typer.Option("--domain", metavar="DIR", help="the domain's directory, with its root key")]
Node = Annotated[
    Path | None, typer.Option("--node", metavar="DIR", help="a node's directory at hand; it is completed in place")
]
Request = Annotated[
    Path | None, typer.Option("--request", metavar="FILE", help="a node.csr from elsewhere; needs --out")
]
ExpectedRole = Annotated[
    Role | None,
    typer.Option(
        "--role",
        help="what the node is to be, a leaf for a switch that carries no transit; compared with its request. "
        "Asked for at a terminal",
    ),
]
ExpectedLabel = Annotated[
    str | None, typer.Option("--label", help="its name for people; compared with its request. Asked for at a terminal")
]
Nodes = Annotated[list[Path], typer.Option("--node", metavar="DIR", help="a node's directory at hand; repeatable")]
OldCertificate = Annotated[
    Path | None, typer.Option("--cert", metavar="FILE", help="the membership of a node elsewhere; needs --out")
]
Before = Annotated[
    float | None, typer.Option("--before-days", min=0.0, help="renew only what ends within so many days")
]
RootFile = Annotated[Path, typer.Option("--root", metavar="FILE", help="the domain's root certificate")]
CertificateFile = Annotated[Path, typer.Argument(metavar="FILE", help="a membership, PEM or DER")]
OutFile = Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="where to write it")]


@app.command("issue")
def issue(
    domain: Domain,
    node: Node = None,
    request: Request = None,
    out: options.Out = None,
    role: ExpectedRole = None,
    label: ExpectedLabel = None,
    days: options.Days = MEMBER_DAYS,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Admit a node to a domain in the given role. The domain's ledger, issued.jsonl, records every membership.

    A switch may carry the traffic of every node. A leaf is a switch for its own nodes only, as on a robot or a rented
    machine. The other switches send no transit traffic through it, whatever it advertises.

    \b
    Examples:
      gdp cert issue --domain keys/school --node keys/robot --role proxy --label robot
      gdp cert issue --domain keys/school --node keys/robot-switch --role leaf --label robot
      gdp cert issue --domain keys/school --request node.csr --role switch --label roof --out node.crt
    """
    if node is not None and request is None and out is None:
        keys = load_node_keys(node)
        _state(domain, keys.subject.name, keys.role.value, keys.label, days, role, label)
        member = admit_node(domain, node, days=days, force=force).member
        written = {"certificate": str(node / NODE_CERTIFICATE), "card": str(node / CARD)}
    elif node is None and request is not None and out is not None:
        if not force:
            refuse_existing(out)
        asked = read_public(request)
        holder = parsed(request, read_request, asked)
        _state(domain, holder.subject.name, holder.unit, holder.label, days, role, label)
        member = parsed(request, lambda wire: admit(domain, wire, days=days), asked)
        write_all(out.parent, {out.name: public(to_pem(member.wire))}, force=force)
        written = {"certificate": str(out)}
    else:
        raise LocalError("cert issue: give either --node, or --request with --out")
    show({**_described(member), **written}, as_json=as_json)


@app.command("renew")
def renew_(
    domain: Domain,
    nodes: Nodes = [],  # noqa: B006 (the library copies it)
    certificate: OldCertificate = None,
    out: options.Out = None,
    before_days: Before = None,
    days: options.Days = MEMBER_DAYS,
    as_json: options.Json = False,
) -> None:
    """Issue memberships again, for the same keys. A running node reloads its new certificate by itself.

    \b
    Examples:
      gdp cert renew --domain keys/school --node keys/robot --node keys/roof --before-days 30
      gdp cert renew --domain keys/school --cert node.crt --out renewed.crt
    """
    if nodes and certificate is None and out is None:
        for node in nodes:
            member = renew_node(domain, node, days=days, before_days=before_days)
            result: dict[str, object] = {"node": str(node), "renewed": member is not None}
            show({**result, **({} if member is None else _described(member))}, as_json=as_json)
    elif not nodes and certificate is not None and out is not None:
        wire = read_public(certificate)
        member = parsed(certificate, lambda data: renew(domain, data, days=days), wire)
        write_all(out.parent, {out.name: public(to_pem(member.wire))}, force=True)
        show({**_described(member), "certificate": str(out)}, as_json=as_json)
    else:
        raise LocalError("cert renew: give either --node, which may be repeated, or --cert with --out")


@app.command("trust")
def trust(
    file: CertificateFile,
    roots: Annotated[list[Path], typer.Option("--root", metavar="FILE", help="a root that a node trusts; repeatable")],
    as_json: options.Json = False,
) -> None:
    """Replace a trusted root by its successor, if the present root vouches for the successor.

    \b
    Example:
      gdp cert trust next-root.crt --root keys/robot/root.crt
    """
    for root in roots:
        show({**described_root(trust_successor(file, root)), "root": str(root)}, as_json=as_json)


@app.command("succeed")
def succeed(
    owner: Annotated[Path, typer.Option("--owner", metavar="DIR", help="the owner's directory")],
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="the successor's; made if it is not there")],
    delegations: Annotated[
        list[Path],
        typer.Option("--delegation", metavar="PATH", help="of a name: a file, or a folder of them; repeatable"),
    ],
    days: options.Days = ROOT_DAYS,
    protect: options.Protect = False,
    key: options.KeyUri = None,
    as_json: options.Json = False,
) -> None:
    """Let another key delegate an owner's names from now on. The names and owner.pub do not change.

    \b
    Example:
      gdp cert succeed --owner keys/lab --to keys/lab2 --delegation keys/robot/delegations --days 730
    """
    files = [file for path in delegations for file in ([path] if path.is_file() else sorted(path.glob("*.delegation")))]
    names = {each.name: each.subject for each in map(load_delegation, files)}
    if not names:
        raise LocalError("cert succeed: none of --delegation has a delegation in it")
    guard = asked_passphrase(protect)
    heir = succeed_owner(owner, to, names.values(), days=days, key=token_key(key), passphrase=guard)
    known = sorted(name.to_text() for name in heir.successions)
    show({"owner": heir.public.compressed.hex(), "successor": heir.key.public.compressed.hex(), "names": known},
         as_json=as_json)  # fmt: skip


@app.command("issued")
def issued(domain: Domain, as_json: options.Json = False) -> None:
    """Verify the ledger of a domain and print what was issued, the oldest first.

    \b
    Example:
      gdp cert issued --domain keys/school
    """
    lines = read_ledger(domain)
    for line in lines:
        until = moment(line.until_unix_s)
        if as_json:
            echo(json.dumps(asdict(line)))
        else:
            echo(f"{moment(line.at_unix_s)}  {line.role:<6}  {line.label}  {line.name}  until {until}")
    echo(f"{domain / LEDGER}: {len(lines)} memberships, the chain of hashes holds", err=True)


@app.command("install")
def install(
    node: options.Directory,
    certificate: Annotated[Path, typer.Option("--cert", metavar="FILE", help="the membership that came back")],
    root: RootFile,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Complete a node's directory with a membership that was issued elsewhere.

    \b
    Example:
      gdp cert install keys/robot --cert node.crt --root root.crt
    """
    trusted, wire = load_root(root), read_public(certificate)
    identity = parsed(certificate, lambda data: install_membership(node, data, trusted, force=force), wire)
    show({**_described(identity.member), "card": str(node / CARD)}, as_json=as_json)


@app.command("show")
def show_(
    file: Annotated[Path, typer.Argument(metavar="NODE_DIR|FILE", help="a node's directory, or a membership")],
    root: Annotated[
        Path | None,
        typer.Option("--root", metavar="FILE", help="the domain's root certificate; default: that of NODE_DIR"),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Verify a membership under a root and print its holder.

    \b
    Examples:
      gdp cert show robot/rib
      gdp cert show keys/robot/node.crt --root keys/school/root.crt
    """
    if file.is_dir():
        file, root = file / NODE_CERTIFICATE, root or file / ROOT_CERTIFICATE
    if root is None:
        raise LocalError(f"{file}: state --root FILE, or the directory of a node")
    show(_described(_member(file, root)), as_json=as_json)


@app.command("revoke")
def revoke(
    file: CertificateFile, domain: Domain, out: OutFile, force: options.Force = False, as_json: options.Json = False
) -> None:
    """Revoke a membership: write the revocation for the RIBs.

    \b
    Example:
      gdp cert revoke keys/robot/node.crt --domain keys/school --out robot.revoke
    """
    authority = load_domain(domain)
    member = parsed(file, lambda wire: Membership.from_wire(wire, authority.root, time.time()), read_public(file))
    statement = Revocation.make(authority.key, authority.root.signer, member.fingerprint, member.not_after_unix_s)
    who, about = member.name.to_text(), member.fingerprint.hex()
    note_once(domain, Action.REVOKED, "membership", who=who, about=about, unix_s=time.time())
    write_all(out.parent, {out.name: public(statement)}, force=force)
    show({**_described(member), "revocation": str(out)}, as_json=as_json)


def _state(
    domain: Path, name: Name, role: str, label: str, days: float, wanted: Role | None, called: str | None
) -> None:
    """Print what is about to be signed, and check that it matches the caller's request.

    Args:
        domain: whose audit log records a request for something else.
        name, role, label: as in the request.
        wanted, called: as the caller states them; None: a person at the terminal confirms.

    Raises:
        LocalError: the request asks for something else, or there is no terminal.
    """
    if (wanted is not None and wanted.value != role) or (called is not None and called != label):
        why = "another role or label than was meant"
        note_once(domain, Action.REFUSED, "membership", who=name.to_text(), reason=why, unix_s=time.time())
    if wanted is not None and wanted.value != role:
        raise LocalError(f"the request asks for the role {role}, not {wanted.value}: nothing was signed")
    if called is not None and called != label:
        raise LocalError(f"the request asks for the label {label!r}, not {called!r}: nothing was signed")
    echo(f"about to sign: {role} {label!r}, name {name.to_text()}, for {days:g} days at most", err=True)
    if wanted is not None and called is not None:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise LocalError(f"cert issue: say what is meant: --role {role} --label {shlex.quote(label)}")
    if not typer.confirm("Is this what you mean?", err=True):
        raise LocalError("nothing was signed")


def _member(file: Path, root: Path) -> Membership:
    trusted = load_root(root)
    return parsed(file, lambda wire: Membership.from_wire(wire, trusted, time.time()), read_public(file))


def _described(member: Membership) -> dict[str, object]:
    return {
        "name": member.name.to_text(),
        "role": member.role.value,
        "label": member.label,
        "domain": member.domain.to_text(),
        **span(member.validity),
        "fingerprint": member.fingerprint.hex(),
    }
