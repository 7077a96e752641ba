"""Programs of the project are forked, not executed, in tests; the nightly lane and coverage start the real ones."""

from __future__ import annotations

import os

import pytest

from lab import zygote

__all__ = ["fork_programs"]

_REAL = "GDP_REAL_PROGRAMS"  # 1: every program is executed


def fork_programs(config: pytest.Config) -> None:
    """Start a zygote for the processes of this session, once."""
    is_controller = bool(getattr(config.option, "numprocesses", None)) and not hasattr(config, "workerinput")
    is_measured = bool(config.getoption("--cov", None))
    if not (zygote.is_installed() or is_controller or is_measured or os.environ.get(_REAL) == "1"):
        zygote.install()
