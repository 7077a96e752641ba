"""``gdp cert rollover``: commands that replace the root key of a domain without an interruption."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.key import asked_passphrase, token_key
from gdp.cli.output import moment, show, span
from gdp.crypto.certificates import Root
from gdp.stores.issue import ROOT_DAYS
from gdp.stores.keyring import ROOT_CERTIFICATE
from gdp.stores.rollover import NEXT, RETIRED, begin_rollover, finish_rollover

app = typer.Typer(no_args_is_help=True, help="Another root key for a domain: begin, hand the root out, finish.")

Domain = Annotated[Path, typer.Option("--domain", metavar="DIR", help="the domain's directory, with its root key")]
Overlap = Annotated[float, typer.Option("--overlap-days", min=0.0, help="how long the present root is trusted still")]


@app.command("begin")
def begin(
    domain: Domain,
    overlap_days: Overlap = 30.0,
    days: options.Days = ROOT_DAYS,
    protect: options.Protect = False,
    key: options.KeyUri = None,
    as_json: options.Json = False,
) -> None:
    """Make a successor of the root. Then give next/root.crt to every node, with gdp cert trust, and finish.

    \b
    Example:
      gdp cert rollover begin --domain keys/school --overlap-days 30
    """
    guard = asked_passphrase(protect)
    made = begin_rollover(domain, days=days, overlap_days=overlap_days, key=token_key(key), passphrase=guard)
    show({**described_root(made.root), "root": str(domain / NEXT / ROOT_CERTIFICATE)}, as_json=as_json)


@app.command("finish")
def finish(domain: Domain, as_json: options.Json = False) -> None:
    """Issue with the successor from now on. Then renew every membership before the old root retires.

    \b
    Example:
      gdp cert rollover finish --domain keys/school
    """
    root = finish_rollover(domain)
    show({**described_root(root), "retired": str(domain / RETIRED)}, as_json=as_json)


def described_root(root: Root) -> dict[str, object]:
    """Return the fields that a command prints about a root."""
    result: dict[str, object] = {"domain": root.domain.to_text(), "label": root.label, **span(root.validity)}
    result["key"] = root.key.compressed.hex()
    if root.predecessors:
        result["predecessor until"] = moment(root.predecessors[-1].validity.not_after_unix_s)
    return result
