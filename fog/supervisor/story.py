"""What happened to a machine, from what was known of it before and is now: the lines of ``fog status --events``.

Place: pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from fog.supervisor.record import Record

__all__ = ["changes"]


def changes(before: Record, after: Record, now_s: float) -> Iterator[tuple[str, str]]:
    """Yield what happened, and a few words about it."""
    since = f"{now_s - after.asked_unix_s:.1f} s after it was asked for"
    if before.up_unix_s is None and after.up_unix_s is not None:
        yield "up", since
    if before.noticed_unix_s is None and after.noticed_unix_s is not None:
        yield "notice", f"{after.reason}; leaves in {(after.leaves_at_unix_s or now_s) - now_s:.1f} s"
    if before.served_unix_s is None and after.served_unix_s is not None:
        yield "serving", since
    elif before.unheard_unix_s is not None and after.unheard_unix_s is None and not after.is_gone:
        yield "serving", f"again, after {now_s - before.unheard_unix_s:.1f} s"
    if after.served_unix_s is not None and before.unheard_unix_s is None and after.unheard_unix_s is not None:
        yield "unheard", "its replica is not heard in the overlay"
    if not before.is_gone and after.is_gone:
        yield (after.ending.value if after.ending is not None else "gone"), after.reason
