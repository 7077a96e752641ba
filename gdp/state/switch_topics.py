"""Rows of a switch for the control command ``topics``: names of attached nodes, and those that it forwards most.

Sans-I/O. A switch knows names as 256 bits only; a proxy of the same machine may know what they mean.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping

from gdp.names import NAME_BYTES, Name
from gdp.state.topic_rows import Direction, TopicRow
from gdp.switch.local_advertisements import LocalAdvertisement
from gdp.trust.right import Right

_OFFERS = (Right.PUBLISH, Right.SERVE)
_USES = (Right.READ, Right.CALL)


def switch_rows(
    attached: Iterable[LocalAdvertisement], entries: Callable[[], Mapping[bytes, tuple[int, int]]] | None
) -> Iterator[TopicRow]:
    """Yield a row for each name.

    Args:
        attached: advertisements of attached nodes; those of the nodes' own names have no row.
        entries: frames and bytes by the busiest entries; None: the data plane does not count them.
    """
    offers, uses, services = Counter[Name](), Counter[Name](), set[Name]()
    for each in attached:
        advertisement = each.advertisement
        offers[advertisement.name] += advertisement.right in _OFFERS
        uses[advertisement.name] += advertisement.right in _USES
        if advertisement.right in (Right.SERVE, Right.CALL):
            services.add(advertisement.name)
    frames: dict[Name, tuple[int, int]] = {}
    for key, (count, size) in (entries() if entries is not None else {}).items():
        name = Name(key[:NAME_BYTES])
        before = frames.get(name, (0, 0))
        frames[name] = before[0] + count, before[1] + size
    named = {name for name in offers if offers[name] or uses[name]}
    for name in sorted(named | frames.keys()):
        counted = frames.get(name, (0, 0) if entries is not None else (None, None))
        yield TopicRow(
            name=name.to_text(),
            direction=Direction.THROUGH,
            kind="service" if name in services else "topic" if name in named else "",
            messages=counted[0],
            bytes=counted[1],
            publishers=offers[name] if name in named else None,
            readers=uses[name] if name in named else None,
        )
