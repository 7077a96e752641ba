"""Settings of tests that draw their cases: the suite draws the same few each time, a variable asks for more."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, Phase, settings

__all__ = ["draws", "is_long"]


def is_long(variable: str) -> bool:
    """Return whether an environment variable asks for a number of cases."""
    return variable in os.environ


def draws(variable: str, usual: int) -> settings:
    """Return the settings of a test that draws ``usual`` cases, or as many as an environment variable asks for."""
    phases = (Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink)
    return settings(
        max_examples=int(os.environ.get(variable, str(usual))),
        deadline=None,
        derandomize=not is_long(variable),
        print_blob=True,
        suppress_health_check=list(HealthCheck),
        phases=phases if is_long(variable) else (Phase.explicit, Phase.generate),
    )
