"""Log of a node's decisions for ``-v``: routes that it set and removed, and what it dropped, by reason.

I/O; it compares twice a second, and only while debug lines are logged: the core itself decides without a log. A look
writes a bounded number of lines. Names appear in their short form, ports as device names.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Final

from gdp.errors import DropReason
from gdp.intervals import TICK_S
from gdp.names import NAME_BYTES, Name
from gdp.sansio import Timestamps
from gdp.state.node_state import NodeState, SwitchState
from gdp.switch.table import Hops, Table

log = logging.getLogger(__name__)

_LINES_MAX: Final = 64  # of each kind in one look
_ANY: Final = "any"


def log_decisions(every: Callable[[float, Callable[[Timestamps], None]], None], state: NodeState) -> None:
    """Log decisions from within a loop, whose ``every`` is given, if debug lines are wanted."""
    if log.isEnabledFor(logging.DEBUG):
        table = state.switch.table if isinstance(state, SwitchState) else None
        every(TICK_S, DecisionLog(state.ifname, state.drops, table).log_changes)


class DecisionLog:
    """What a node decided since the last look.

    Args:
        ifname: returns the device of a port.
        drops: returns what the node dropped; counts only rise.
        table: of a switch.
    """

    def __init__(
        self,
        ifname: Callable[[int], str],
        drops: Callable[[], Mapping[DropReason, int]],
        table: Table | None = None,
    ) -> None:
        self._ifname = ifname
        self._drops = drops
        self._table = table
        self._routes: dict[bytes, str] = {}
        self._dropped: dict[DropReason, int] = {}

    def log_changes(self, _now: Timestamps) -> None:
        """Log what changed since the last call."""
        if self._table is not None:
            self._look_at_routes(self._table.entries)
        for reason, count in sorted(self._drops().items()):
            if (more := count - self._dropped.get(reason, 0)) > 0:
                log.debug("dropped reason=%s frames=%d total=%d", reason.label, more, count)
                self._dropped[reason] = count

    def _look_at_routes(self, entries: Mapping[bytes, Hops]) -> None:
        now = {key: self._where(hops) for key, hops in entries.items()}
        changed = [key for key, where in now.items() if self._routes.get(key) != where]
        gone = [key for key in self._routes if key not in now]
        for key in changed[:_LINES_MAX]:
            log.debug("route set destination=%s source=%s to=%s", *_ends(key), now[key])
        for key in gone[:_LINES_MAX]:
            log.debug("route removed destination=%s source=%s", *_ends(key))
        left = max(len(changed) - _LINES_MAX, 0) + max(len(gone) - _LINES_MAX, 0)
        if left:
            log.debug("further routes changed count=%d", left)
        self._routes = now

    def _where(self, hops: Hops) -> str:
        return ",".join(self._ifname(hop[0]) for hop in hops) or "nowhere"


def _ends(key: bytes) -> tuple[str, str]:
    return Name(key[:NAME_BYTES]).short, Name(key[NAME_BYTES:]).short if len(key) > NAME_BYTES else _ANY
