"""Lines of ``gdp trace`` for people.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from gdp.limits import COST_UNREACHABLE
from gdp.names import NAME_BYTES, Name

_WORDS: Final = {"publish": "published by", "serve": "served by"}


def path_lines(name: str, path: Mapping[str, object]) -> Iterator[str]:
    """Yield the lines of one path: its end, a line for each switch, and the branches of the tree under each."""
    member = path.get("label") or _short(path.get("node"))
    end = f"{name}, {_WORDS.get(str(path['right']), 'attached as')} {member}"
    hops = _dicts(path.get("hops"))
    if path.get("answered"):
        where = f"{path['role']} of {path['domain_label']}"
        count = f"{len(hops)} switch{'' if len(hops) == 1 else 'es'}"
        yield f"{end} ({where}): {count}, {_ms(path.get('rtt_ms'))}{_cost(path)}"
    else:
        yield f"{end}, which does not answer{_cost(path)}"
    for hop in hops:
        yield from _hop_lines(hop)
    if any(hop.get("needs_right") for hop in hops):
        yield "     branches are shown to switches, and to nodes with a right on the name"


def _cost(path: Mapping[str, object]) -> str:
    """Return the cost of the path to a server, and whether it is the nearest that answers."""
    cost = path.get("cost")
    if not isinstance(cost, int):
        return ""
    nearest = ": the nearest that answers" if path.get("is_nearest") else ""
    return f", {'no path' if cost == COST_UNREACHABLE else f'cost {cost}'}{nearest}"


def _hop_lines(hop: Mapping[str, object]) -> Iterator[str]:
    yield f"{hop['hop']:>3}  {_switch(hop)}{_ways(hop)}"
    yield from _branch_lines(hop, "       ")


def _switch(hop: Mapping[str, object]) -> str:
    if hop.get("state") != "answered":
        return "no answer"
    if hop.get("withheld"):
        return f"a switch of {hop['domain_label']}  {_ms(hop.get('rtt_ms'))}  (tells our domain no more)"
    return (
        f"{hop['label'] or _short(hop.get('node'))}  {hop['role']} of {hop['domain_label']}  {_ms(hop.get('rtt_ms'))}"
    )


def _ways(hop: Mapping[str, object]) -> str:
    words = [f"{word} {_link(link)}" for word in ("in", "out") if isinstance(link := hop.get(word), Mapping)]
    return "  " + ", ".join(words) if words else ""


def _branch_lines(hop: Mapping[str, object], indent: str) -> Iterator[str]:
    for branch in _dicts(hop.get("branches")):
        below = branch.get("below")
        is_closed = isinstance(below, Mapping) and (below.get("withheld") or below.get("state") != "answered")
        outcome = f": {_switch(below)}" if isinstance(below, Mapping) and is_closed else ""
        rate = f", messages for {branch['kbit_s']} kbit/s" if "kbit_s" in branch else ""
        yield f"{indent}tree -> {_link(branch)}{rate}{outcome}"
        if isinstance(below, Mapping):
            yield from _branch_lines(below, indent + "    ")
    if hop.get("cut"):
        yield f"{indent}... and more branches"


def _link(link: Mapping[str, object]) -> str:
    to = link.get("label") or _short(link.get("to"))
    rtt_us = link.get("rtt_us")
    delay = f" {rtt_us / 1e3:.2f} ms" if isinstance(rtt_us, int) else ""
    return f"{link.get('port')} {to}{delay}"


def _short(name: object) -> str:
    return Name.from_text(name).short if isinstance(name, str) and len(name) == 2 * NAME_BYTES else "?"


def _ms(value: object) -> str:
    """Return a delay; the node that asks answers itself at once."""
    return "-" if not isinstance(value, int | float) else f"{value:.2f} ms" if value else "here"


def _dicts(value: object) -> list[Mapping[str, object]]:
    return [each for each in value if isinstance(each, Mapping)] if isinstance(value, list) else []
