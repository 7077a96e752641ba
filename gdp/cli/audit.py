"""``gdp audit``: verification of what a node or an authority accepted, refused and revoked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.errors import LocalError
from gdp.stores.audit_log import verify_audit

app = typer.Typer(no_args_is_help=True, help="Audit logs of switches, RIBs, domains and owners.")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="the folder with audit.jsonl")]


@app.callback()
def audit() -> None:
    """Keep the sub-command's name, although it is the only one."""


@app.command("verify")
def verify(folder: Folder, as_json: options.Json = False) -> None:
    """Verify the chain of an audit log and print a summary; an error names the file and line of a break.

    \b
    Example:
      gdp audit verify /var/lib/gdp/audit
    """
    if not folder.is_dir():
        raise LocalError(f"{folder}: no such folder")
    found = verify_audit(folder)
    events = {f"{action} {what}": count for (action, what), count in sorted(found.events.items())}
    show({"lines": found.lines, "first": found.first, "last hash": found.last_hash, **events}, as_json=as_json)
