"""What the programs of a machine that was lost said last: a provider forgets that with the machine.

I/O; asks the provider.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final

from fog.enrolment.bootstrap import PROXY, SWITCH
from fog.providers.provider import Provider
from gdp.errors import GdpError

__all__ = ["MACHINE", "keep", "kept"]

MACHINE: Final = "machine"  # itself, beside its programs
_LINES: Final = 20
_CHARS: Final = 4_000


def keep(provider: Provider, machine: str, nodes: Sequence[str]) -> str:
    """Return what ``kept`` reads; what cannot be had now is lost.

    Args:
        machine: the provider's id of it.
        nodes: names of the programs beside switch and proxy.
    """
    found = {}
    for program in (*nodes, PROXY, SWITCH, ""):
        with suppress(GdpError):  # its provider may not show them, or has forgotten it already
            if text := provider.log(machine, program, _LINES).strip():
                found[program or MACHINE] = text[-_CHARS:]
    return json.dumps(found)


def kept(words: str) -> Iterator[tuple[str, str]]:
    """Yield each program and its last lines."""
    if words:
        yield from json.loads(words).items()
