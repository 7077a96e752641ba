"""State of one node's sharing: what it exposes and to which nodes, what it accepts, and what others offer to it.

I/O. The folder ``proxy.yaml.shares`` lies in the folder of ``proxy.yaml`` and belongs to the node's user alone::

    rules.json                      exposed names with their recipients, accepted names, senders of offers
    offers/NAME.delegation          what an owner gave this node, accepted or not
    owners/KEY.pub                  public keys of the owners of accepted offers
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, ValidationError

from gdp.config.offered_qos import OfferedQos
from gdp.config.schema import Section, first_fault
from gdp.crypto.keys import PublicKey
from gdp.crypto.statements import parse
from gdp.errors import LocalError, StatementError
from gdp.names import Name
from gdp.ros_names import Kind, is_pattern, meets
from gdp.sharing.proxy_files import Side, fits
from gdp.stores.files import private, public, read_private, write_all
from gdp.stores.keyring import load_delegation, save_delegation
from gdp.trust.adcert import AdCert
from gdp.trust.delegation import Delegation
from gdp.trust.right import Right

_SUFFIX: Final = ".shares"
OFFERS_MAX: Final = 1_000
_RULES: Final = "rules.json"
_OFFERS: Final = "offers"
_OWNERS: Final = "owners"
_GIVES: Final = frozenset({Right.PUBLISH, Right.SERVE})


class ExposedName(Section):
    """A name, or a pattern of names, that this node exposes under an owner key of this machine.

    Args:
        type_name: empty: as the local graph shows it.
        to: labels of nodes and groups that get the right to read or call.
        owner: directory of the owner.
        owner_key: the owner's public key, hex.
        days: life of each delegation.
        salt: the unguessable part of its 256-bit name; empty: none.
        encoding, deadline_ms, repair, weight, max_bits_s: keys of the rule; None: the rule's default.
    """

    kind: Kind
    name: str
    type_name: str = ""
    to: tuple[str, ...] = ()
    owner: Path
    owner_key: str
    days: float
    salt: str = ""
    encoding: str | None = None
    deadline_ms: float | None = None
    repair: Literal["never", "in-time"] | None = None
    weight: int | None = None
    max_bits_s: float | None = None

    @property
    def rule_options(self) -> dict[str, object]:
        """Return the keys of the rule that are set."""
        keys = ("encoding", "deadline_ms", "repair", "weight", "max_bits_s")
        return {key: value for key in keys if (value := getattr(self, key)) is not None}

    @property
    def more_metadata(self) -> dict[str, str | int]:
        """Return what its 256-bit name digests in addition to kind, name and type."""
        return {"salt": self.salt} if self.salt else {}


class AcceptedName(Section):
    """A name, or a pattern of names, whose present and later offers this node accepts.

    Args:
        side: ``import`` for offers to read or call, ``expose`` for offers to publish or serve.
        source: label of the only sender that counts; None: any member.
    """

    side: Side
    name: str
    source: str | None = None


class OfferSource(Section):
    """Sender of an offer, its number in the order of arrival, when it came first, and what the sender said later.

    Args:
        qos: of a topic; None: not known.
        is_withdrawn: the sender no longer exposes the name.
        node: name of the offered node that brings it, as the live proxy has found; empty: none.
    """

    sender: str
    number: int
    received_unix_s: float
    qos: OfferedQos | None = None
    is_withdrawn: bool = False
    node: str = ""


class ShareState(Section):
    """Content of ``rules.json``; offers are listed by name, 64 hex digits."""

    exposed: tuple[ExposedName, ...] = ()
    accepted: tuple[AcceptedName, ...] = ()
    offers: dict[str, OfferSource] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """A delegation that came from another node."""

    delegation: Delegation
    sender: str
    received_unix_s: float
    qos: OfferedQos | None = None
    is_withdrawn: bool = False
    node: str = ""

    @property
    def kind(self) -> str:
        """Return the kind of its name."""
        return str(self._meaning["kind"])

    @property
    def ros_name(self) -> str:
        """Return the ROS name."""
        return str(self._meaning["name"])

    @property
    def type_name(self) -> str:
        """Return the type."""
        return str(self._meaning["type"])

    @property
    def more_metadata(self) -> dict[str, str | int]:
        """Return what its 256-bit name digests in addition to kind, name and type."""
        return {key: value for key, value in self._meaning.items() if key not in ("kind", "name", "type")}

    @property
    def sides(self) -> tuple[Side, ...]:
        """Return the sides of ``proxy.yaml`` on which a rule can use it."""
        rights = self.delegation.rights
        return (*(("expose",) if rights & _GIVES else ()), *(("import",) if rights - _GIVES else ()))

    @property
    def until_unix_s(self) -> int:
        """Return when it expires."""
        return min(link.validity.not_after_unix_s for link in links_of(self.delegation))

    @property
    def age(self) -> tuple[int, int]:
        """Return what rises with each offer of a name: when it expires, and its newest epoch."""
        return self.until_unix_s, max(self.delegation.grants, default=-1)

    @property
    def owner(self) -> PublicKey:
        """Return the public key of the name's owner."""
        return PublicKey.from_compressed(self.delegation.subject.owner_key)

    def fits(self, accepted: AcceptedName) -> bool:
        """Return whether an accepted name covers this offer, or some of the nodes of a pattern that it offers."""
        is_sender = accepted.source is None or accepted.source == self.sender
        is_covered = fits(accepted.name, self.ros_name) or (self._is_of_nodes and meets(self.ros_name, accepted.name))
        return is_sender and accepted.side in self.sides and is_covered

    def names_for(self, accepted: Iterable[AcceptedName]) -> list[str]:
        """Return the names of the rules that use it: of a pattern of nodes those that are accepted."""
        names = dict.fromkeys(each.name for each in accepted if self.fits(each))
        is_whole = not self._is_of_nodes or any(fits(each, self.ros_name) for each in names)
        return [self.ros_name] if is_whole else list(names)

    @property
    def _is_of_nodes(self) -> bool:
        return self.kind == "node" and is_pattern(self.ros_name)

    @property
    def _meaning(self) -> dict[str, str | int]:
        return dict(self.delegation.metadata or {})


class StateFolder:
    """The folder ``proxy.yaml.shares`` of one proxy; ``path``: of ``proxy.yaml``."""

    def __init__(self, path: Path) -> None:
        self.folder = path.with_name(path.name + _SUFFIX)

    def read_state(self) -> ShareState:
        """Return the state; an empty one if nothing was shared yet. Raises ``LocalError``: a file is invalid."""
        file = self.folder / _RULES
        if not file.exists():
            return ShareState()
        try:
            return ShareState.model_validate_json(read_private(file))
        except ValidationError as error:
            raise LocalError(f"{file}: not the state of a node that shares names: {first_fault(error)}") from error

    def save(self, state: ShareState) -> None:
        """Replace the state. Raises ``LocalError``: the folder cannot be written."""
        write_all(self.folder, {_RULES: private(state.model_dump_json(indent=1).encode())}, force=True)

    def offers(self, state: ShareState) -> Iterator[Offer]:
        """Yield the offers, the oldest first. Raises ``LocalError``: a file is invalid."""
        for name, source in sorted(state.offers.items(), key=lambda item: item[1].number):
            file = self.folder / _OFFERS / f"{name}.delegation"
            if file.exists():
                stated = source.model_dump(include={"sender", "received_unix_s", "is_withdrawn", "node"})
                yield Offer(delegation=load_delegation(file), qos=source.qos, **stated)

    def save_offer(self, state: ShareState, delegation: Delegation, sender: str, unix_s: float) -> ShareState:
        """Store an offer, in place of an earlier one of the same name; return the state that lists it.

        Raises:
            LocalError: too many offers are stored, of all or of this sender, or the folder cannot be written.
        """
        name = delegation.name.to_text()
        of_sender = sum(each.sender == sender for each in state.offers.values())
        if name not in state.offers and of_sender >= OFFERS_MAX // 4:
            raise LocalError(f"{self.folder}: {of_sender} offers of {sender} are stored; no more of it are taken")
        if name not in state.offers and len(state.offers) >= OFFERS_MAX:
            raise LocalError(f"{self.folder}: {OFFERS_MAX} offers are stored; no more are taken")
        save_delegation(self.folder / _OFFERS, delegation, force=True)
        before = state.offers.get(name)
        number = max((each.number for each in state.offers.values()), default=0) + 1
        first = before or OfferSource(sender=sender, number=number, received_unix_s=unix_s)
        return state.model_copy(update={"offers": {**state.offers, name: first}})

    def update_offer(self, state: ShareState, name: Name, sender: str, **news: object) -> ShareState:
        """Return the state with fields of an offer's source. Raises ``LocalError``: the sender has not offered it."""
        text = name.to_text()
        source = state.offers.get(text)
        if source is None or source.sender != sender:
            raise LocalError(f"news of {name.short}, which {sender} has not offered")
        return state.model_copy(update={"offers": {**state.offers, text: source.model_copy(update=news)}})

    def remove_offer(self, state: ShareState, name: Name) -> ShareState:
        """Remove an offer; return the state without it."""
        text = name.to_text()
        (self.folder / _OFFERS / f"{text}.delegation").unlink(missing_ok=True)
        return state.model_copy(update={"offers": {key: value for key, value in state.offers.items() if key != text}})

    def owner_file(self, key: PublicKey) -> Path:
        """Return the file with an owner's public key, which is written if it is missing."""
        file = self.folder / _OWNERS / f"{key.compressed.hex()}.pub"
        if not file.exists():
            write_all(file.parent, {file.name: public(key.to_pem())}, force=True)
        return file


def links_of(delegation: Delegation) -> list[AdCert]:
    """Return the links of a delegation's chain, from the owner on; signatures are not checked.

    Raises:
        LocalError: a link is malformed.
    """
    try:
        return [AdCert.from_statement(parse(wire)) for wire in delegation.chain]
    except StatementError as error:
        raise LocalError(f"a delegation of {delegation.name.short} is malformed: {error}") from error
