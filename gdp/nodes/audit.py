"""Audit of a running node: its trail, its rejections by reason, and the folder that keeps them.

I/O. A node keeps an audit log if its configuration names a folder (``audit``), or if systemd gives it one for state
(``StateDirectory=``, systemd.exec(5)).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from gdp.errors import DropReason, LocalError
from gdp.sansio import Timestamps
from gdp.stores.audit_log import AuditLog
from gdp.trust.audit import Action, AuditTrail

log = logging.getLogger(__name__)

_STATE: Final = "STATE_DIRECTORY"
_SAID: Final = frozenset(
    {
        DropReason.BAD_TAG,
        DropReason.BAD_SIGNATURE,
        DropReason.REPLAYED,
        DropReason.MALFORMED,
        DropReason.WRONG_NAME,
        DropReason.BAD_CERTIFICATE,
        DropReason.WRONG_DOMAIN,
        DropReason.EXPIRED,
        DropReason.REVOKED,
        DropReason.NOT_DELEGATED,
        DropReason.UNKNOWN_SENDER,
        DropReason.QUOTA,
    }
)  # rejected statements; losses in transit do not concern trust


def audit_folder(configured: Path | None) -> Path | None:
    """Return the folder of a node's audit log, or None if the node keeps none."""
    if configured is not None:
        return configured
    state = os.environ.get(_STATE, "").split(":")[0]
    return Path(state) / "audit" if state else None


class NodeAudit:
    """Writer of a trail to the audit log; ``drops``: what the node dropped, by reason; counts only rise."""

    def __init__(self, audit_log: AuditLog, trail: AuditTrail, drops: Callable[[], Mapping[DropReason, int]]) -> None:
        self._log = audit_log
        self._trail = trail
        self._drops = drops
        self._known = dict.fromkeys(_SAID, 0)
        self._has_failed = False
        trail.begin()

    def write_pending(self, now: Timestamps) -> None:
        """Write what has happened since the last call."""
        drops = self._drops()
        for reason, before in self._known.items():
            count = drops.get(reason, 0)
            if count > before:
                self._trail.record(Action.REFUSED, "statements", reason=reason.label, count=count - before)
                self._known[reason] = count
        try:
            self._log.write(self._trail, now.mono_s, now.unix_s)
            self._has_failed = False
        except LocalError as error:
            if not self._has_failed:
                log.error("audit log not written reason=%s", error)
            self._has_failed = True
