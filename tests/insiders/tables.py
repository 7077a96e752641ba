"""Every table of a machine, and its size limit."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from typing import Any, Final

from gdp.client.reader_proxies import READERS_MAX, ReaderProxies
from gdp.client.unicast_streams import STREAMS_MAX, UnicastStreams
from gdp.exchange.sync_set import FANOUT
from gdp.limits import JOIN_MESSAGES_MAX, PENDING_FRAMES_MAX
from gdp.message.reassembly import Reassembler
from gdp.switch.name_resolver import QUERIES_MAX, USED_NAMES_MAX, NameResolver, PendingFrames

__all__ = ["GENERAL_MAX", "LIMITS", "sizes"]

GENERAL_MAX: Final = 4_096  # tables of peers, sessions or old statements keep no more than this
LIMITS: Final[Mapping[str, int]] = {  # by class and attribute
    f"{of.__name__}.{attribute}": most
    for of, attribute, most in (
        (NameResolver, "_queries", QUERIES_MAX + USED_NAMES_MAX),
        (PendingFrames, "_by_name", PENDING_FRAMES_MAX),
        (ReaderProxies, "active", READERS_MAX),
        (UnicastStreams, "_streams", STREAMS_MAX),
        (Reassembler, "_unfinished", JOIN_MESSAGES_MAX),
    )
} | {"_Fetch.prefixes": FANOUT * FANOUT}
_CONTAINERS: Final = (dict, list, set, frozenset, deque)
_DEEP_ITEMS: Final = 64  # items of one container that are examined
_PACKAGES: Final = "gdp."


def sizes(machine: object) -> Counter[str]:
    """Return the longest of each kind of table below a machine, by ``Class.attribute``."""
    found: Counter[str] = Counter()
    seen: set[int] = set()
    waiting: list[tuple[str, object]] = [("", machine)]
    while waiting:
        where, value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, _CONTAINERS):
            if len(value) > found[where]:
                found[where] = len(value)
            waiting += [(where, each) for each in _first(value)]
        elif type(value).__module__.startswith(_PACKAGES) and not isinstance(value, type | bytes | int | str | tuple):
            name = type(value).__name__
            waiting += [(f"{name}.{key}", each) for key, each in _attributes(value)]
    return found


def _first(value: Any) -> Iterator[object]:
    items = value.values() if isinstance(value, dict) else value
    for at, each in enumerate(items):
        if at >= _DEEP_ITEMS:
            break
        yield each


def _attributes(value: object) -> Iterator[tuple[str, object]]:
    yield from getattr(value, "__dict__", {}).items()
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        for key in (slots,) if isinstance(slots, str) else slots:
            if hasattr(value, key):
                yield key, getattr(value, key)
