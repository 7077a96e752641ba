"""Schema option of ``gdp-proxy``: prints the JSON schema of ``proxy.yaml``.

I/O.
"""

from __future__ import annotations

import json
from typing import Annotated

import typer

from proxy.config.config import ProxyConfig

__all__ = ["Schema", "schema_text"]


def schema_text() -> str:
    """Return the content of ``docs/proxy.schema.json``."""
    return json.dumps(ProxyConfig.json_schema(), indent=2) + "\n"


def _print_and_end(wanted: bool) -> None:
    if wanted:
        typer.echo(schema_text(), nl=False)
        raise typer.Exit


Schema = Annotated[
    bool,
    typer.Option(
        "--schema",
        is_eager=True,
        callback=_print_and_end,
        help="Print the JSON schema of the configuration, for editors, and end.",
    ),
]
