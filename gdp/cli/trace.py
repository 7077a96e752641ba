"""``gdp trace``: the switches between a node of this machine and where a name is advertised, and the trees below.

I/O; over the control socket of a node of this machine, which sends the requests as the member that it is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.local_nodes import Node, connect, find_name
from gdp.cli.path_probe import PathProbe
from gdp.cli.ping import NameText
from gdp.cli.places import NOWHERE, find_places
from gdp.errors import LocalError
from gdp.names import NAME_BYTES, Name
from gdp.terminal import echo

_WORDS: Final = {"publish": "published by", "serve": "served by"}
_NOTHING_CAME: Final = 1

Budget = Annotated[
    float,
    typer.Option(
        "-W", "--timeout", min=0.05, max=60, metavar="SECONDS", help="Time for each member that advertises the name."
    ),
]


def trace(name: NameText, timeout: Budget = 0.45, node: Node = None, as_json: options.Json = False) -> None:
    """Show each switch between here and the members that publish or serve a name, and the tree branches below them.

    A switch of our own domain tells its links and branches. One of another domain tells domain and delay only, unless
    its configuration names our domain (domain.diagnostics).
    The exit code is 1 if a member that advertises the name did not answer.

    \b
    Example:
      gdp trace /camera/image
      gdp trace /camera/image --node robot/switch
      gdp trace 75e0...0fc --json
    """
    begun_s = time.monotonic()
    with connect(node) as connection:
        asked = find_name(name, connection)
        places = find_places(connection, asked)
        if not places:
            raise LocalError(f"{name}: {NOWHERE}")
        probe = PathProbe(connection, asked)
        found: list[Mapping[str, object]] = []
        for place in places:
            found.append({"right": place.right, **probe.path_to(place.node, time.monotonic() + timeout)})
            if not as_json:
                for line in path_lines(name, found[-1]):
                    echo(line)
    elapsed_ms = round(1e3 * (time.monotonic() - begun_s), 1)
    if as_json:
        echo(json.dumps({"name": asked.to_text(), "elapsed_ms": elapsed_ms, "paths": found}))
    else:
        echo(f"traced in {elapsed_ms:.0f} ms")
    if not all(path["answered"] for path in found):
        raise typer.Exit(_NOTHING_CAME)


def path_lines(name: str, path: Mapping[str, object]) -> Iterator[str]:
    """Yield the lines of one path: its end, a line for each switch, and the branches of the tree under each."""
    member = path.get("label") or _short(path.get("node"))
    end = f"{name}, {_WORDS.get(str(path['right']), 'attached as')} {member}"
    hops = _dicts(path.get("hops"))
    if path.get("answered"):
        where = f"{path['role']} of {path['domain_label']}"
        yield f"{end} ({where}): {len(hops)} switch{'' if len(hops) == 1 else 'es'}, {_ms(path.get('rtt_ms'))}"
    else:
        yield f"{end}, which does not answer"
    for hop in hops:
        yield from _hop_lines(hop)
    if any(hop.get("needs_right") for hop in hops):
        yield "     branches are shown to switches, and to nodes with a right on the name"


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
