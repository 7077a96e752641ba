"""One wait for what causes no event here: a condition is asked again and again until it holds."""

from __future__ import annotations

import time
from collections.abc import Callable

from lab import process

__all__ = ["PATIENCE_S", "until"]

PATIENCE_S = 60.0
_PAUSE_S = 0.02


def until(
    is_met: Callable[[], object],
    what: object | Callable[[], object] = "it did not come about",
    patience_s: float = PATIENCE_S,
    *,
    meanwhile: Callable[[], object] | None = None,
) -> float:
    """Return the seconds until a condition holds; fail when it does not in time.

    Args:
        what: is expected, or a function that says what there is instead.
        meanwhile: is called between two looks, and should wait a moment; None: a pause of 20 ms.
    """
    begun_s = time.monotonic()
    try:
        process.until(is_met, lambda: str(what() if callable(what) else what), patience_s, meanwhile or _pause)
    except process.FailedError as error:
        raise AssertionError(str(error)) from error
    return time.monotonic() - begun_s


def _pause() -> None:
    time.sleep(_PAUSE_S)
