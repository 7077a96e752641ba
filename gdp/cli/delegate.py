"""``gdp delegate``: commands by which an owner lets a node act on a name, and a node lets a switch attract its traffic.

I/O. Files without a command are the command ``rules``, so ``gdp delegate --owner owner proxy.yaml`` is enough.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from gdp.cli import options
from gdp.cli.delegations import described, ls, show_file
from gdp.cli.extension import ANY_ARGUMENTS, COMMANDS
from gdp.cli.output import (
    epochs_from_text,
    rights_from_text,
    show,
    span,
)
from gdp.cli.program import Program
from gdp.cli.rights_file import delegate_rights
from gdp.crypto.statements import parse
from gdp.errors import LocalError
from gdp.names import Name
from gdp.stores.audit_log import note_once
from gdp.stores.files import private, public, work_tree_of, write_all
from gdp.stores.issue import DELEGATION_DAYS, delegate, delegate_route, install_delegation
from gdp.stores.keyring import load_card, load_delegation, load_owner, load_root
from gdp.terminal import echo
from gdp.trust.adcert import AdCert
from gdp.trust.audit import Action
from gdp.trust.rtcert import RtCert

_RULES: Final = "rules"


class _RulesByDefault(TyperGroup):
    """Commands of which ``rules`` is the one that is meant where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert ``rules`` before the arguments if they name no command and no option of this group."""
        known = {*self.commands, *ctx.help_option_names, "--version"}
        return super().parse_args(ctx, [_RULES, *args] if args and args[0] not in known else args)


app = Program(
    "gdp-delegate",
    cls=_RulesByDefault,
    no_args_is_help=True,
    help="Let nodes act on names: all that proxies need by their files, a file of rights, or one name; or a switch"
    " attract a node's traffic. The command rules is the default: gdp delegate --owner owner robot/proxy.yaml",
)
main = app.run

OwnerDir = Annotated[Path, typer.Option("--owner", metavar="DIR", help="the owner's directory")]
CardFile = Annotated[Path, typer.Option("--card", metavar="FILE", help="the node's card (node.card)")]
Rights = Annotated[
    list[str], typer.Option("--right", metavar="RIGHT", help="publish, read, serve or call; may be repeated")
]
Epochs = Annotated[str, typer.Option("--epochs", help="whose secrets it gets, such as 0 or 0-3")]
MayDelegate = Annotated[bool, typer.Option("--may-delegate", help="the node may pass the rights on")]
TrustedRoot = Annotated[
    Path | None, typer.Option("--root", metavar="FILE", help="refuse a card that is not of this domain")
]
OutFile = Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="where to write it")]
NodeDir = Annotated[Path, typer.Option("--node", metavar="DIR", help="the node's directory")]


@app.command(_RULES, context_settings=ANY_ARGUMENTS)
def rules_of_proxies(context: typer.Context) -> None:
    """Give each proxy the delegations that the rules of its file need."""
    COMMANDS.get("delegate", "gdp delegate rules")(context.args)


app.command("rights", no_args_is_help=True)(delegate_rights)
app.command("ls", no_args_is_help=True)(ls)
app.command("show", no_args_is_help=True)(show_file)


@app.command("name")
def name(
    owner: OwnerDir,
    card: CardFile,
    right: Rights,
    kind: options.Kind,
    out: OutFile,
    *,
    subject: options.NameOptions,
    epochs: Epochs = "0",
    days: options.Days = DELEGATION_DAYS,
    may_delegate: MayDelegate = False,
    root: TrustedRoot = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Let a node publish, read, serve or call a name (AdCert), with the secrets it needs (grants).

    \b
    Example:
      gdp delegate name --owner keys/lab --card robot.card --right publish --kind topic --name /camera/image \\
          --type sensor_msgs/msg/Image --author lab --epochs 0-3 --out camera.delegation
      gdp delegate name --owner keys/lab --card server.card --right serve --kind service --name /plan \\
          --type nav_msgs/srv/GetPlan --out plan.delegation
    """
    metadata = subject.metadata(kind)
    face = load_card(card)
    if root is not None:
        face.member_of(load_root(root), time.time())
    made = delegate(
        owner, face, metadata, rights_from_text(right), epochs_from_text(epochs), days=days, may_delegate=may_delegate
    )
    write_all(out.parent, {out.name: private(made.to_wire())}, force=force)
    if (tree := work_tree_of(out)) is not None:
        echo(f"{out} is private and lies in the git work tree {tree}; do not commit it", err=True)
    show({**described(made), "label": face.label, "delegation": str(out)}, as_json=as_json)


@app.command("install")
def install(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="a delegation, as its owner wrote it")],
    node: NodeDir,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Verify that a delegation is for this node and opens, and install it in the node's directory.

    \b
    Example:
      gdp delegate install camera.delegation --node keys/robot
    """
    given = load_delegation(file)
    path = install_delegation(node, given, force=force)
    show({**described(given), "delegation": str(path)}, as_json=as_json)


@app.command("route")
def route(
    node: NodeDir,
    switch: Annotated[str, typer.Option("--switch", metavar="NAME", help="the switch's name, 64 hex digits")],
    out: OutFile,
    days: options.Days = 1.0,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Let a switch attract a node's traffic (RtCert). A running proxy makes its own; other nodes need this command.

    \b
    Example:
      gdp delegate route --node keys/robot --switch $(cat switch.name) --out robot.rtcert
    """
    target = Name.from_text(switch)
    wire = delegate_route(node, target, days=days)
    write_all(out.parent, {out.name: public(wire)}, force=force)
    statement = parse(wire)
    result = {
        "node": statement.signer.to_text(),
        "switch": target.to_text(),
        **span(RtCert.from_statement(statement).validity),
        "rtcert": str(out),
    }
    show(result, as_json=as_json)


@app.command("revoke")
def revoke(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="the delegation to take back")],
    owner: OwnerDir,
    out: OutFile,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Revoke a delegation: write the revocation for the RIBs.

    \b
    Example:
      gdp delegate revoke camera.delegation --owner keys/lab --out camera.revoke
    """
    given = load_delegation(file)
    if not given.chain:
        raise LocalError(f"{file}: nothing was delegated: the node owns the name itself")
    holder = load_owner(owner)
    link = AdCert.from_statement(parse(given.chain[0 if holder.founder is None else -1]))
    statement = holder.revoke(given.subject, link.fingerprint, link.validity.not_after_unix_s)
    who, about = given.node.to_text(), given.name.to_text()
    note_once(owner, Action.REVOKED, "delegation", who=who, about=about, unix_s=time.time())
    write_all(out.parent, {out.name: public(statement)}, force=force)
    show({**described(given), "revocation": str(out)}, as_json=as_json)
