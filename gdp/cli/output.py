"""Output of the ``gdp`` command, and the parsers that several of its sub-commands share.

I/O. Results go to stdout, as ``key: value`` lines or as one JSON object; errors go to stderr.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING

from gdp.cli.secret import NAME_SALT
from gdp.cli.tables import columns
from gdp.errors import LocalError
from gdp.metadata import SALT
from gdp.terminal import echo

if TYPE_CHECKING:  # a short command loads nothing of keys
    from gdp.crypto.validity import Validity
    from gdp.trust.right import Right


def show(result: Mapping[str, object], *, as_json: bool, plain: str | None = None) -> None:
    """Print a result; ``plain``, if given, replaces the lines for people."""
    if as_json:
        echo(json.dumps(result, ensure_ascii=False))
    elif plain is not None:
        echo(plain)
    else:
        width = max(map(len, result))
        for key, value in result.items():
            echo(f"{key:<{width}}  {_text(value)}")


def table(rows: Sequence[Mapping[str, object]], keys: Sequence[str]) -> str:
    """Return rows as aligned columns under their keys."""
    return "\n".join(columns(keys, [[_text(row[key]) for key in keys] for row in rows]))


def moment(unix_s: int) -> str:
    """Return a time as text in UTC, for people and JSON."""
    return datetime.fromtimestamp(unix_s, timezone.utc).isoformat().replace("+00:00", "Z")


def span(validity: Validity) -> dict[str, str]:
    """Return both ends of a validity, for a result."""
    return {"from": moment(validity.not_before_unix_s), "until": moment(validity.not_after_unix_s)}


def items_from_text(texts: Iterable[str]) -> dict[str, str]:
    """Read ``key=value`` options.

    Raises:
        LocalError: one without ``=``, a duplicate key, or the salt of a name, which every user of the host could read
            here.
    """
    items: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise LocalError(f"--meta {text!r}: expected key=value")
        if key == SALT:
            raise NAME_SALT.refused("--meta salt=...")
        if key in items:
            raise LocalError(f"metadata {key!r} is given twice")
        items[key] = value
    return items


def rights_from_text(texts: Iterable[str]) -> frozenset[Right]:
    """Read the rights to delegate. Raises ``LocalError``: an unknown right."""
    from gdp.trust.right import Right

    known = {right.value: right for right in Right}
    for text in texts:
        if text not in known:
            raise LocalError(f"--right {text!r}: expected publish, serve, call or read")
    return frozenset(known[text] for text in texts)


def epochs_from_text(text: str) -> list[int]:
    """Read epochs, such as ``0``, ``0-3`` or ``0,2,7-9``. Raises ``LocalError``: anything else."""
    from gdp.trust.grants import EPOCH_MAX

    epochs: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.partition("-")
        ends = (first, last if dash else first)
        if not all(end.isascii() and end.isdigit() and len(end) <= 5 for end in ends):
            raise LocalError(f"--epochs {text!r}: expected numbers or spans, such as 0,2,7-9")
        low, high = int(ends[0]), int(ends[1])
        if not low <= high <= EPOCH_MAX:
            raise LocalError(f"--epochs {text!r}: epochs go from 0 to {EPOCH_MAX}, the lower first")
        epochs.update(range(low, high + 1))
    return sorted(epochs)


def _text(value: object) -> str:
    if isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
        return "".join(f"\n  {_text(each)}" for each in value)
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "-"
    if isinstance(value, dict):
        return "  ".join(f"{key}={'-' if each is None else each}" for key, each in value.items())
    return "-" if value is None else str(value)
