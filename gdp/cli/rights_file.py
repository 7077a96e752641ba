"""``gdp delegate rights``: all delegations that a file of rights states, in one call.

I/O. A node that has a valid delegation with these rights and epochs keeps it, so the command may run again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer
from pydantic import AfterValidator, Field, PrivateAttr, ValidationInfo, field_validator, model_validator

from gdp.cli import options
from gdp.cli.delegations import until
from gdp.cli.output import show, table
from gdp.cli.secret import read_salt
from gdp.config.schema import Directory, ExistingFile, Section, load, relative
from gdp.errors import LocalError, StatementError
from gdp.intervals import DAY_S
from gdp.limits import CERTIFICATE_LIFE_MAX_S
from gdp.metadata import SALT, Metadata
from gdp.names import Name
from gdp.ros_names import Kind
from gdp.stores.issue import DELEGATION_DAYS, valid_delegation, widened
from gdp.stores.keyring import (
    CARD,
    DELEGATIONS,
    delegation_file,
    load_card,
    load_delegations,
    load_owner,
    load_root,
    save_delegation,
)
from gdp.trust.delegation import Delegation
from gdp.trust.grants import EPOCH_MAX
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right

_COLUMNS: Final = ("state", "name", "kind", "rights", "node", "until", "file")
_RIGHTS: Final = ("publish", "read", "serve", "call")  # keys of the file, and rights


def _card(path: Path) -> Path:
    """Return the card of a node that the file names by its directory or by its card."""
    card = path / CARD if path.is_dir() else path
    try:
        load_card(card)
    except LocalError as error:
        raise ValueError(f"expected a node's directory or its card: {error}") from error
    return card


Days = Annotated[float, Field(gt=0, le=CERTIFICATE_LIFE_MAX_S / DAY_S)]
Epoch = Annotated[int, Field(ge=0, le=EPOCH_MAX)]
Cards = tuple[Annotated[Path, AfterValidator(relative), AfterValidator(_card)], ...]
File = Annotated[Path, typer.Argument(metavar="FILE", help="a file of rights, such as rights.yaml")]
Renew = Annotated[bool, typer.Option("--renew", help="make those again that are there")]
Check = Annotated[bool, typer.Option("--check", help="check the file, show what would be made, and change nothing")]


class NameRights(Section):
    """Rights of nodes on one name."""

    kind: Kind = Field(default="topic", description="What it is.")
    name: str = Field(min_length=1, description="As `--name`.")
    type_name: str | None = Field(default=None, alias="type", description="As `--type`.")
    metadata: dict[str, str | int] = Field(default_factory=dict, description="As `--meta`, `--author` and others.")
    salt_file: ExistingFile | None = Field(default=None, description="As `--salt-file`.")
    publish: Cards = Field(default=(), description="Topics: nodes, each a directory or a card.")
    read: Cards = Field(default=(), description="Topics: nodes.")
    serve: Cards = Field(default=(), description="Services and actions: nodes.")
    call: Cards = Field(default=(), description="Services and actions: nodes.")
    epochs: tuple[Epoch, ...] = Field(default=(0,), description="Whose secrets the nodes get.")
    days: Days = Field(default=DELEGATION_DAYS, description="How long each is valid.")

    _meaning: Metadata = PrivateAttr()

    @property
    def meaning(self) -> Metadata:
        """Return what the 256-bit name digests, in addition to the owner's key."""
        return self._meaning

    def by_card(self) -> dict[Path, set[Right]]:
        """Return the rights of each node."""
        found: dict[Path, set[Right]] = {}
        for right in _RIGHTS:
            for card in getattr(self, right):
                found.setdefault(card, set()).add(Right(right))
        return found

    @field_validator(*_RIGHTS)
    @classmethod
    def _fits_kind(cls, cards: tuple[Path, ...], info: ValidationInfo) -> tuple[Path, ...]:
        kinds = "topics" if info.field_name in _RIGHTS[:2] else "services and actions"
        if cards and str(info.data.get("kind", kinds)) not in kinds:
            raise ValueError(f"only {kinds} have this")
        return cards

    @model_validator(mode="after")
    def _has_meaning(self, info: ValidationInfo) -> NameRights:
        if not self.by_card():
            raise ValueError(f"{self.name}: state nodes under publish, read, serve or call")
        own = {"kind": self.kind, "name": self.name, **({"type": self.type_name} if self.type_name else {})}
        if twice := sorted({*own, SALT} & self.metadata.keys()):
            raise ValueError(f"metadata: {', '.join(twice)}: a key of its own has this, next to name")
        try:
            self._meaning = Metadata({**own, **self.metadata, **(read_salt(self.salt_file) if self.salt_file else {})})
        except LocalError as error:
            raise ValueError(str(error)) from error
        seen = info.context.setdefault("names", set()) if isinstance(info.context, dict) else set()
        if self._meaning.digest() in seen:
            raise ValueError(f"{self.name} stands twice; state all its nodes in one place")
        seen.add(self._meaning.digest())
        return self


class RightsFile(Section):
    """Rights that one owner gives."""

    owner: Directory = Field(description="The owner's directory.")
    root: ExistingFile | None = Field(default=None, description="Root of the only domain whose cards are accepted.")
    rights: tuple[NameRights, ...] = Field(description="Names, each with the rights of nodes.")


class _Wanted(NamedTuple):
    """A delegation that the file states; ``held``: the valid one that the node has of that name."""

    stated: NameRights
    card: NodeDescriptor
    name: Name
    folder: Path
    rights: frozenset[Right]
    held: Delegation | None

    @property
    def is_held(self) -> bool:
        held = self.held
        return held is not None and self.rights <= held.rights and held.grants.keys() >= set(self.stated.epochs)


def delegate_rights(file: File, renew: Renew = False, check: Check = False, as_json: options.Json = False) -> None:
    """Give nodes all rights that a file states; valid delegations are kept.

    A node that the file names by its directory has its delegations installed. Those of server.card are written to
    server.delegations; install them with 'gdp delegate install'.

    \b
    Examples:
      gdp delegate rights rights.yaml
      gdp delegate rights rights.yaml --check
    """
    config = load(RightsFile, file)
    rows = [_done(config.owner, each, renew=renew, check=check) for each in list(_wanted(config))]
    show({"file": str(file), "rights": rows}, as_json=as_json, plain=table(rows, _COLUMNS))


def _wanted(config: RightsFile) -> Iterator[_Wanted]:
    key, now = load_owner(config.owner).public, time.time()
    for stated in config.rights:
        name = stated.meaning.name(key.compressed)
        for path, rights in stated.by_card().items():
            card = load_card(path)
            if config.root is not None:
                try:
                    card.member_of(load_root(config.root), now)
                except StatementError as error:
                    raise LocalError(f"{path}: {error}") from error
            folder = path.with_name(DELEGATIONS) if path.name == CARD else path.with_suffix(f".{DELEGATIONS}")
            held = valid_delegation(load_delegations(folder), card, name, now)
            yield _Wanted(stated, card, name, folder, frozenset(rights), held)


def _done(owner: Path, wanted: _Wanted, *, renew: bool, check: bool) -> dict[str, object]:
    """Make a delegation unless the node has it; return its row."""
    stated, given, state = wanted.stated, wanted.held, "kept"
    if given is None or renew or not wanted.is_held:
        state, given = "missing", None
        if not check:
            state, given = (
                "made",
                widened(
                    owner, wanted.card, stated.meaning, wanted.rights, wanted.held, stated.epochs, days=stated.days
                ),
            )
            save_delegation(wanted.folder, given, force=True)
    return {
        "state": state,
        "name": stated.name,
        "kind": stated.kind,
        "rights": sorted(right.value for right in (wanted.rights if given is None else given.rights)),
        "node": wanted.card.label,
        "until": None if given is None else until(given),
        "file": str(delegation_file(wanted.folder, wanted.name)),
    }
