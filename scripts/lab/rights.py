"""Rights of nodes on names: delegations of an owner, by name. I/O: files of keys."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD
from gdp.trust.right import Right


def grant(
    owner: Path, node: Path, rights: Mapping[str, Collection[Right]], types: Mapping[str, str] | None = None
) -> None:
    """Let a node act on names; ``types``: ROS types of names."""
    for name, given in rights.items():
        kind = "service" if {Right.SERVE, Right.CALL} & set(given) else "topic"
        typed = {"type": types[name]} if types and name in types else {}
        metadata = Metadata({"kind": kind, "name": name, **typed})
        install_delegation(node, delegate(owner, node / CARD, metadata, list(given)))
