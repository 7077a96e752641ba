"""Settings of tests that draw their cases: always the same few, or with ``GDP_DRAWS=N`` N times as many new ones."""

from __future__ import annotations

import os
from typing import Final

from hypothesis import HealthCheck, Phase, settings

__all__ = ["IS_LONG", "TIMES", "draws"]

TIMES: Final = int(os.environ.get("GDP_DRAWS", "1"))
IS_LONG: Final = TIMES > 1


def draws(usual: int, *, long: int = 0) -> settings:
    """Return the settings of a test that draws ``usual`` cases, or as many times more as ``GDP_DRAWS`` asks for.

    Args:
        long: cases where ``GDP_DRAWS`` asks for four times as many; four times the usual ones unless given.
    """
    phases = (Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink)
    return settings(
        max_examples=max(long * TIMES // 4, usual) if IS_LONG and long else usual * TIMES,
        deadline=None,
        derandomize=not IS_LONG,
        print_blob=True,
        suppress_health_check=list(HealthCheck),
        phases=phases if IS_LONG else (Phase.explicit, Phase.generate),
    )
