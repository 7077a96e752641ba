"""Schedule of a reader's reports: when the next one is due, and what it states of the frames that came."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gdp.frame.codec import Header
from gdp.intervals import READER
from gdp.limits import REPORT_DELAY_S, REPORT_EVERY_BYTES, REPORT_EVERY_MAX_BYTES, REPORT_GAP_S, REPORT_PAUSE_S
from gdp.message.reassembly import Reassembler
from gdp.requests import Backoff

_FIRST_BYTES: Final = 3_000
# between two requests of what is missing, while nothing comes
_MISSING: Final = Backoff(REPORT_DELAY_S, 16 * REPORT_DELAY_S)


class AckNackSchedule:
    """Schedule of the reports of one reader to one writer.

    Args:
        data: reassembles the writer's messages.
        due_s: when the first report is due.

    Attributes:
        due_s: monotonic second of the next report.
        idle_s: longest time between two reports.
        received: verified DATA frames that came.
        receipts: sum of the samples among them (``gdp/message/receipts.py``).
        newest: the highest of them: number, fragment, and when it came.
    """

    def __init__(self, data: Reassembler, due_s: float) -> None:
        self._data = data
        self.due_s = due_s
        self.idle_s = READER.refresh_s
        self.received = self.receipts = 0
        self.newest = (0, -1, due_s)
        self._unreported_bytes = 0
        self._is_owed = False  # enough bytes came for a report
        self._total_bytes = 0
        self._clean_bytes = 0  # reported since something was last missing
        self._has_come = False  # something has, since the report before
        self._requests = 1  # of what is missing, with the next one, while nothing came

    def count(
        self, size: int, frames: int, samples: Sequence[tuple[int, int]], number: int, part: int, came_s: float
    ) -> None:
        """Count received bytes that no report confirms yet.

        Args:
            frames: count of those that came; none of what parity has restored.
            samples: place and seal of each sample among them.
            number: of the newest one's message; unless a later one came before, because it is a repair.
        """
        self._unreported_bytes += size
        self._total_bytes += size
        if self._unreported_bytes >= _FIRST_BYTES:
            self._is_owed = self._unreported_bytes >= self._owed_bytes()
        self.received += frames
        if samples:
            self.receipts += sum([seal for _, seal in samples])
        if (number, part) > self.newest[:2]:
            self.newest = number, part, came_s

    def handle_run(self, now_s: float, *, is_in_order: bool) -> None:
        """Reschedule after fragments that followed each other, behind a gap or not."""
        pause_s = REPORT_PAUSE_S if is_in_order else REPORT_GAP_S
        self.due_s = min(self.due_s, now_s if self._is_owed else now_s + pause_s)

    def handle_part(self, header: Header, highest: int, expected: int, now_s: float) -> None:
        """Reschedule after a new fragment.

        Args:
            highest: highest message number before it.
            expected: message number that is delivered next.
        """
        number, data = header.number, self._data
        if header.parts == 1 and number == highest + 1 == expected and self.due_s <= now_s + REPORT_DELAY_S:
            if self._is_owed:
                self.due_s = now_s
            return  # a complete message in order changes nothing else
        is_next = number == highest or (number == highest + 1 and (highest < expected or data.is_finished(highest)))
        is_done = header.parts == 1 or data.is_finished(number)
        is_in_order = is_next and (is_done or header.part == data.progress(number) - 1)
        if self._is_owed:
            due_s = now_s
        elif not is_in_order:
            due_s = now_s + REPORT_GAP_S
        else:
            due_s = now_s + (REPORT_DELAY_S if is_done else REPORT_PAUSE_S)
        self.due_s = min(self.due_s, due_s)

    def start_report(self) -> None:
        """Count all received bytes as reported."""
        self._clean_bytes += self._unreported_bytes
        self._has_come = self._unreported_bytes > 0
        self._unreported_bytes, self._is_owed = 0, False

    def handle_reported(self, now_s: float, *, is_missing: bool) -> None:
        """Schedule the report after one that is sent now: ever later while something is missing and nothing comes."""
        self._requests = self._requests + 1 if is_missing and not self._has_come else 1
        if is_missing:
            self._clean_bytes = 0
        self.due_s = now_s + (_MISSING.pause_s(self._requests) if is_missing else self.idle_s)

    def _owed_bytes(self) -> int:
        """Return the bytes for which a report is owed; they grow while nothing is missing.

        A writer's congestion window has grown by what was reported since the last loss, and must never run empty. At
        first the writer knows nothing of the path, and two frames are enough.
        """
        first_bytes = max(self._total_bytes // 8, _FIRST_BYTES)
        every_bytes = max(REPORT_EVERY_BYTES, min(self._clean_bytes // 4, REPORT_EVERY_MAX_BYTES))
        return min(first_bytes, every_bytes)
