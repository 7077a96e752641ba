"""Audit trail of one node: what it accepted, refused and revoked, rate-limited so that a flood is one line and a count.

Sans-I/O; time comes in with ``poll_lines``. Lines form a chain: each holds the SHA-256 of the line before it, so that a
changed, removed or inserted line is found. Lines cut off at the end are detected only with a later hash stored
elsewhere.

Single lines are written within the trail's allowance, which grows by one line each ``_LINE_EACH_S``. Excess events are
counted by kind (action, what, reason), and written each minute in one line for each kind.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import MINUTE_S

BEGIN: Final = "0" * 64  # replaces the hash in the first line
_LINES_MAX: Final = 200
_LINE_EACH_S: Final = 10.0
_KINDS_MAX: Final = 256
_OTHERS: Final = "others"


class Action(str, Enum):
    """Outcome of an event."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    REVOKED = "revoked"
    ENDED = "ended"


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditLine:
    """One line of an audit log.

    Args:
        seq: 1, 2, ... without a gap.
        at_unix_s: when it was recorded, to half a second.
        action: of ``Action``.
        what: the object: neighbour, name, membership, delegation, enrolment, root, revocation, statements.
        who: the requesting node or key, 64 or 66 hex digits; empty: no identity was proven.
        about: the name that it is about, 64 hex digits, a fingerprint, or ``cluster/machine``; empty: none.
        reason: why it was refused, as ``DropReason.label``, or in a few words; empty: it was not.
        count: the number of events; above 1 ``who`` and ``about`` are those of the last.
        previous: SHA-256 of the line before, hex.
    """

    seq: int
    at_unix_s: int
    action: str
    what: str
    who: str
    about: str
    reason: str
    count: int
    previous: str

    @classmethod
    def from_line(cls, line: bytes) -> AuditLine:
        """Read a line, with or without its end. Raises ``LocalError``: not in the format of ``to_line``."""
        try:
            read = cls(**json.loads(line))
        except (ValueError, TypeError, RecursionError) as error:
            raise LocalError(f"not a line of an audit log: {error}") from error
        if read.to_line() != line.rstrip(b"\n"):
            raise LocalError("not a line as the audit log writes it")
        return read

    def to_line(self) -> bytes:
        """Return the line, without its end."""
        return json.dumps(asdict(self), sort_keys=True).encode()

    @property
    def hash(self) -> str:
        """Return the hash that the next line holds."""
        return hashlib.sha256(self.to_line()).hexdigest()


@dataclass(slots=True, kw_only=True)
class _Event:
    action: Action
    what: str
    who: str
    about: str
    reason: str
    count: int


class AuditTrail:
    """Events that wait to be written; none is stored before the call of ``begin``."""

    def __init__(self) -> None:
        self._is_on = False
        self._lines: list[_Event] = []
        self._counts: dict[tuple[Action, str, str], _Event] = {}
        self._allowance = float(_LINES_MAX)
        self._taken_s: float | None = None
        self._counted_s = 0.0

    def begin(self) -> None:
        """Store events from now on: a writer polls them."""
        self._is_on = True

    def record(
        self, action: Action, what: str, *, who: str = "", about: str = "", reason: str = "", count: int = 1
    ) -> None:
        """Record an event; costs about a microsecond.

        Args:
            action, what, who, about, reason, count: as in ``AuditLine``.
        """
        if not self._is_on:
            return
        if self._allowance >= 1.0:
            self._allowance -= 1.0
            self._lines.append(_Event(action=action, what=what, who=who, about=about, reason=reason, count=count))
            return
        kind = (action, what, reason)
        if kind not in self._counts and len(self._counts) >= _KINDS_MAX:
            kind = (action, _OTHERS, "")
        counted = self._counts.setdefault(
            kind, _Event(action=kind[0], what=kind[1], who=who, about=about, reason=kind[2], count=0)
        )
        counted.who, counted.about = who, about
        counted.count += count

    def poll_lines(self, mono_s: float, unix_s: float, seq: int, previous: str) -> list[AuditLine]:
        """Return, once, the lines that are due.

        Args:
            seq, previous: number and hash of the last line that was written; 0 and ``BEGIN`` where there is none.
        """
        if not self.is_due(mono_s):
            return []
        events, self._lines = self._lines, []
        if self._counts and mono_s >= self._counted_s + MINUTE_S:
            events += self._counts.values()
            self._counts, self._counted_s = {}, mono_s
        since_s = 0.0 if self._taken_s is None else mono_s - self._taken_s
        self._taken_s = mono_s
        self._allowance = min(self._allowance + since_s / _LINE_EACH_S, float(_LINES_MAX))
        lines: list[AuditLine] = []
        for each in events:
            seq += 1
            line = AuditLine(
                seq=seq,
                at_unix_s=int(unix_s),
                action=each.action.value,
                what=each.what,
                who=each.who,
                about=each.about,
                reason=each.reason,
                count=each.count,
                previous=previous,
            )
            lines.append(line)
            previous = line.hash
        return lines

    def is_due(self, mono_s: float) -> bool:
        """Return whether ``poll_lines`` would return a line."""
        return bool(self._lines) or (bool(self._counts) and mono_s >= self._counted_s + MINUTE_S)
