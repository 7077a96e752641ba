"""Final log lines of a lost machine's programs, which the provider deletes with the machine.

I/O; queries the provider.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final

from fog.bootstrap.bundles import PROXY, SWITCH
from fog.providers.provider import Provider
from gdp.errors import GdpError

MACHINE: Final = "machine"  # log of the machine agent, in addition to those of its programs
_LINES: Final = 20
_CHARS: Final = 4_000


def encode_logs(provider: Provider, machine: str, nodes: Sequence[str]) -> str:
    """Return the text that ``decode_logs`` reads; logs that cannot be read now are lost.

    Args:
        nodes: names of the programs in addition to switch and proxy.
    """
    found = {}
    for program in (*nodes, PROXY, SWITCH, ""):
        with suppress(GdpError):  # the provider may not offer logs, or has deleted them already
            if text := provider.log(machine, program, _LINES).strip():
                found[program or MACHINE] = text[-_CHARS:]
    return json.dumps(found)


def decode_logs(words: str) -> Iterator[tuple[str, str]]:
    """Yield each program and its last lines."""
    if words:
        yield from json.loads(words).items()
