"""Rules that follow from the state of a node's sharing, and the conflicts that a person must resolve.

Sans-I/O apart from the files of owners' public keys, which the rules name.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from gdp.crypto.keys import PublicKey
from gdp.errors import LocalError
from gdp.names import Name
from gdp.ros_names import TYPE_FORMS, Kind, fits_kind, is_name, is_pattern
from gdp.sharing.proxy_files import ProxyFiles, Side
from gdp.sharing.state import AcceptedName, ExposedName, Offer, ShareState, StateFolder

_HEAD: Final = "# Rules of shared names; gdp expose, gdp import and gdp share write this file.\n"
_OTHER_SIDE: Final[dict[Side, Side]] = {"expose": "import", "import": "expose"}


def check_name(name: str) -> None:
    """Raise ``LocalError`` unless the text is a full ROS name or a pattern of such."""
    if not is_name(name) and not is_pattern(name):
        raise LocalError(f"{name!r}: expected a full ROS name, such as /camera/image, or a pattern: /camera/**")


def kind_from_text(kind: str, type_name: str = "") -> Kind:
    """Return a kind, and check the type against it.

    Raises:
        LocalError: an unknown kind, or the type of another kind.
    """
    for known, (_, example) in TYPE_FORMS.items():
        if kind == known:
            if type_name and not fits_kind(type_name, known):
                raise LocalError(f"{type_name!r}: expected the type of a {kind} as ROS 2 writes it, such as {example}")
            return known
    raise LocalError(f"{kind!r}: expected topic, service, action or node")


def check_exposed(files: ProxyFiles, state: ShareState, offers: Iterable[Offer], wanted: ExposedName) -> None:
    """Refuse a name that is exposed or imported already. Raises ``LocalError``: the text says where, and what to do."""
    check_name(wanted.name)
    kind_from_text(wanted.kind, wanted.type_name)
    if wanted.kind != "topic" and (wanted.deadline_ms is not None or wanted.repair is not None):
        raise LocalError(f"{wanted.name} is a {wanted.kind}; only topics have a deadline, and parts that stay lost")
    if (rule := files.find("expose", wanted.kind, wanted.name)) is not None:
        raise LocalError(
            f"{wanted.name} is exposed already by {rule.where}; give it to a node with gdp share {wanted.name} --with"
        )
    for each in state.exposed:
        if (each.kind, each.name) == (wanted.kind, wanted.name):
            if each.owner_key != wanted.owner_key:
                raise LocalError(f"{wanted.name} is exposed already under the owner in {each.owner}; name that --owner")
            if wanted.type_name not in ("", each.type_name):
                raise LocalError(f"{wanted.name} is exposed already with type {each.type_name or 'as found'}")
            if set(wanted.to) <= set(each.to):
                raise LocalError(f"{wanted.name} is exposed already to {', '.join(each.to) or 'no node'}")
    _refuse_direction(files, state, offers, "expose", wanted.kind, wanted.name)


def check_accepted(files: ProxyFiles, state: ShareState, offers: Sequence[Offer], wanted: AcceptedName) -> None:
    """Refuse a name that is accepted already, or that goes in the other direction.

    Raises:
        LocalError: the text says where, and what to do.
    """
    check_name(wanted.name)
    if wanted in state.accepted:
        raise LocalError(f"{wanted.name} is accepted already; 'gdp import --list' shows what came")
    for kind in {each.kind for each in offers if each.fits(wanted)} or TYPE_FORMS:
        _refuse_direction(files, state, offers, wanted.side, kind, wanted.name)


def usable(
    files: ProxyFiles, state: ShareState, offers: Sequence[Offer], unused: dict[Name, str]
) -> Iterator[tuple[Side, Offer]]:
    """Yield the accepted offers with their side, except withdrawn ones; ``unused`` gets why another cannot be used.

    Of what an accepted node brings the rights to read and call are used; what leaves a machine is accepted by name.
    """
    nodes = accepted_nodes(state, offers)
    taken = set[tuple[str, str]]()
    for offer in offers:
        if offer.is_withdrawn:
            continue
        key = (offer.kind, offer.ros_name)
        sides = {each.side for each in state.accepted if offer.fits(each)}
        if not sides and (offer.sender, offer.node) in nodes:
            sides = {side for side in offer.sides if side == "import"}
        for side in sides:
            if key in taken:
                why = f"another owner's {offer.ros_name} is in use; state prefix: in the proxy.yaml of {offer.sender}"
                unused[offer.delegation.name] = why
                continue
            try:
                _refuse_direction(files, state, (), side, *key)
            except LocalError as error:
                unused[offer.delegation.name] = str(error)
                continue
            yield side, offer
        if sides:
            taken.add(key)


def accepted_nodes(state: ShareState, offers: Iterable[Offer]) -> set[tuple[str, str]]:
    """Return the nodes that are accepted, each with its sender; of a pattern also those that are, by their names."""
    return {
        (each.sender, name)
        for each in offers
        if each.kind == "node" and not each.is_withdrawn and any(each.fits(accepted) for accepted in state.accepted)
        for name in (each.ros_name, *each.names_for(state.accepted))
    }


def render(folder: StateFolder, files: ProxyFiles, state: ShareState, used: Iterable[tuple[Side, Offer]]) -> str | None:
    """Return the drop-in with all rules of the state; None without any. What a node brings has no rule of its own."""
    lines: dict[Side, list[str]] = {"expose": [], "import": []}
    for each in state.exposed:
        owner = PublicKey.from_compressed(bytes.fromhex(each.owner_key))
        more = {**each.rule_options, **_metadata(each.more_metadata)}
        lines["expose"].append(_line(folder, files, each.kind, each.name, each.type_name, owner, more))
    for side, offer in used:
        is_brought = offer.node and not any(offer.fits(each) for each in state.accepted)
        for name in () if is_brought else offer.names_for(state.accepted):
            if files.find(side, offer.kind, name) is not None:
                continue
            more = _metadata(offer.more_metadata)
            if offer.qos is not None and side == "import" and offer.kind == "topic":
                more["offered"] = offer.qos.model_dump()
            lines[side].append(_line(folder, files, offer.kind, name, offer.type_name, offer.owner, more))
    sides = [f"{side}:\n{''.join(rules)}" for side, rules in lines.items() if rules]
    return _HEAD + "".join(sides) if sides else None


def _metadata(items: dict[str, str | int]) -> dict[str, object]:
    return {"metadata": items} if items else {}


def _line(
    folder: StateFolder,
    files: ProxyFiles,
    kind: str,
    name: str,
    type_name: str,
    owner: PublicKey,
    more: dict[str, object],
) -> str:
    path: Path = folder.owner_file(owner)
    rule = {"kind": kind, **files.name_keys(name), **({"type": type_name} if type_name else {}), **more}
    return f"- {json.dumps({**rule, 'owner': os.path.relpath(path, files.drop_in.parent)})}\n"


def _refuse_direction(
    files: ProxyFiles, state: ShareState, offers: Iterable[Offer], side: Side, kind: str, name: str
) -> None:
    """Raise ``LocalError`` if the other side has this very name: one machine gives a name or takes it."""
    other = _OTHER_SIDE[side]
    rule = files.find(other, kind, name)
    where = "" if rule is None else rule.where
    if not where and other == "expose":
        shared = [each for each in state.exposed if (each.kind, each.name) == (kind, name)]
        where = f"'gdp expose {shared[0].name}'" if shared else ""
    elif not where:
        is_used = [each for each in offers if (each.kind, each.ros_name) == (kind, name)]
        accepted = [each for offer in is_used for each in state.accepted if each.side == other and offer.fits(each)]
        where = f"'gdp import {accepted[0].name}'" if accepted else ""
    if where:
        doing = {"expose": "exposed", "import": "imported"}
        raise LocalError(f"{name} is {doing[other]} by {where}: one machine gives a {kind} or takes it, not both")
