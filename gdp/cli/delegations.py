"""``gdp delegate ls`` and ``show``: what delegations that a node holds allow, and until when.

I/O. Files of delegations have names of 64 hex digits, which say nothing to people.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.output import moment, show, span
from gdp.crypto.statements import parse
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.stores.keyring import DELEGATIONS, load_delegation
from gdp.trust.adcert import AdCert
from gdp.trust.delegation import Delegation

_MEANING: Final = ("kind", "name", "type")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="a node's directory, or its delegations")]
File = Annotated[Path, typer.Argument(metavar="FILE", help="a delegation; gdp delegate ls prints the files")]


def ls(directory: Folder, as_json: options.Json = False) -> None:
    """List the delegations of a node: state, end, rights, and the name that each is about.

    \b
    Example:
      gdp delegate ls robot/proxy
    """
    folder = directory / DELEGATIONS if (directory / DELEGATIONS).is_dir() else directory
    files = sorted(folder.glob("[!.]*.delegation"))
    if not folder.is_dir():
        raise LocalError(f"{directory}: no such directory; name a node's directory, such as robot/proxy")
    rows = [_row(file, load_delegation(file)) for file in files]
    lines = _aligned([_cells(row) for row in rows]) or [f"no delegation is in {folder}; see gdp delegate --help"]
    show({"directory": str(folder), "delegations": rows}, as_json=as_json, plain="\n".join(lines))


def show_file(file: File, as_json: options.Json = False) -> None:
    """Show one delegation: name, node, rights, epochs, validity, and each link from the owner to the node.

    \b
    Example:
      gdp delegate show camera.delegation
    """
    given = load_delegation(file)
    chain = [AdCert.from_statement(parse(wire)) for wire in given.chain]
    links = [{"issuer": link.issuer.short, "delegate": link.delegate.short, **span(link.validity)} for link in chain]
    result = {**_row(file, given), "from": _begin(given), "links": links}
    show(result, as_json=as_json)


def described(delegation: Delegation) -> dict[str, object]:
    """Return the fields of a delegation that was just made or taken."""
    validity = AdCert.from_statement(parse(delegation.chain[-1])).validity if delegation.chain else None
    return {
        "name": delegation.name.to_text(),
        "node": delegation.node.to_text(),
        "rights": sorted(right.value for right in delegation.rights),
        "epochs": sorted(delegation.grants),
        **(span(validity) if validity is not None else {}),
    }


def until(delegation: Delegation) -> str | None:
    """Return when the first link of a delegation ends; None: it has no end."""
    end_unix_s = min((each.not_after_unix_s for each in _validities(delegation)), default=None)
    return None if end_unix_s is None else moment(end_unix_s)


def _row(file: Path, delegation: Delegation) -> dict[str, object]:
    known: Mapping[str, str | int] = delegation.metadata or {}
    return {
        "state": _state(delegation, time.time()),
        "until": until(delegation),
        "rights": sorted(right.value for right in delegation.rights),
        **{f"ros_{key}" if key == "name" else key: known.get(key) for key in _MEANING},
        "name": delegation.name.to_text(),
        "node": delegation.node.to_text(),
        "epochs": sorted(delegation.grants),
        "file": str(file),
    }


def _begin(delegation: Delegation) -> str | None:
    begin_unix_s = max((each.not_before_unix_s for each in _validities(delegation)), default=None)
    return None if begin_unix_s is None else moment(begin_unix_s)


def _state(delegation: Delegation, unix_s: float) -> str:
    """Return whether the validities of all links hold at a Unix time; signatures and revocations are not checked."""
    validities = _validities(delegation)
    if any(unix_s > each.not_after_unix_s for each in validities):
        return "expired"
    return "early" if any(unix_s < each.not_before_unix_s for each in validities) else "valid"


def _validities(delegation: Delegation) -> list[Validity]:
    return [AdCert.from_statement(parse(wire)).validity for wire in delegation.chain]


def _cells(row: dict[str, object]) -> list[str]:
    rights, epochs = row["rights"], row["epochs"]
    words = [str(row[key]) for key in ("kind", "ros_name") if row[key] is not None]
    return [
        str(row["state"]),
        str(row["until"] or "no end"),
        ",".join(map(str, rights)) if isinstance(rights, list) else "",
        " ".join(words) or "not stated by the owner",
        f"[{row['type']}]" if row["type"] is not None else "",
        f"epochs {','.join(map(str, epochs))}" if isinstance(epochs, list) and len(epochs) > 1 else "",
        str(row["file"]),
    ]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True) if width) for row in rows]
