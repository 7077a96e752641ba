"""Decoders of every map that is declared with the schema, and seeds that come from the declarations."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, cast

from gdp.crypto import cbor
from gdp.crypto.schema import Body, FieldSet
from gdp.crypto.statements import parse
from gdp.crypto.subject import NAMED_SUBJECT
from gdp.errors import RemoteError
from gdp.trust.advertisement import Advertisement
from tests.fuzzing.decoder import Decoder
from tests.gdp.trust.world import CAMERA

__all__ = ["declared", "decoders", "seeds_of"]

_ROOT: Final = Path(__file__).resolve().parents[2]
_NAMES: Final = {  # where it is not the type of the statement
    "gdp.trust.advertisement.UnverifiedAdvertisement": "claim",
    "gdp.trust.node_descriptor._Card": "card-body",
    "gdp.control.link_state.LinkStateVersion": "link-state-version",
    "gdp.sharing.exchange.Mail": "folder-mail",
    "proxy.wire.message.TopicDescription": "description",
}


def declared(package: str) -> list[type[FieldSet]]:
    """Return every declared map of a package that is read."""
    for path in sorted((_ROOT / package).rglob("*.py")):
        if "from gdp.crypto.schema import" in path.read_text():
            import_module(".".join(path.relative_to(_ROOT).with_suffix("").parts))
    found = {
        each
        for each in _below(FieldSet)
        if each.__module__.startswith(f"{package}.")
        and getattr(sys.modules[each.__module__], each.__name__, None) is each  # not as it was before it had slots
        and each not in (Body, Advertisement)  # which nothing reads
        and not (each.__name__.startswith("_") and each.__subclasses__())
    }
    return sorted(found, key=lambda each: (each.__module__, each.__qualname__))


def seeds_of(kind: type[FieldSet]) -> tuple[bytes, ...]:
    """Return maps with the smallest and the largest value of each key, and such that lack one key."""
    keys = [key for key in kind.declared() if key.form.edges]
    least, most = ({key.key: key.form.edges[at] for key in keys} for at in (0, -1))
    if {key.key for key in NAMED_SUBJECT.keys} <= most.keys():
        most |= cast("dict[str, cbor.Value]", NAMED_SUBJECT.to_fields(CAMERA))
    lacking = ({key: value for key, value in most.items() if key != each} for each in most)
    return tuple(cbor.encode(each) for each in (least, most, *lacking))


def decoders(package: str, made: Iterable[bytes | FieldSet]) -> Iterator[Decoder]:
    """Yield the decoder of each declared map of a package.

    Args:
        made: statements and maps that are seeds, too.
    """
    real: dict[object, list[bytes]] = {}
    for each in made:
        if isinstance(each, bytes):
            real.setdefault(parse(each).type, []).append(cbor.encode(dict(parse(each).fields)))
        else:
            real.setdefault(type(each), []).append(each.to_cbor())
    for kind in declared(package):
        seeds = (*real.get(kind, ()), *real.get(getattr(kind, "TYPE", None), ()), *seeds_of(kind))
        yield Decoder(_name(kind), partial(_read, kind), seeds, (RemoteError,), is_cbor=True)


def _read(kind: type[FieldSet], data: bytes) -> object:
    value = cbor.decode(data, kind.MAX_BYTES)
    given = [each.name for each in fields(cast("Any", kind)) if each.init and each.default is MISSING]
    return kind.from_fields(value if isinstance(value, Mapping) else {}, **dict.fromkeys(given))


def _name(kind: type[FieldSet]) -> str:
    word = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", kind.__name__.strip("_")).lower()
    type_ = getattr(kind, "TYPE", None)
    return _NAMES.get(f"{kind.__module__}.{kind.__name__}", word if type_ is None else type_.value)


def _below(kind: type[FieldSet]) -> Iterator[type[FieldSet]]:
    for each in kind.__subclasses__():
        yield each
        yield from _below(each)
