"""Files of another user, for tests that run as root or as anybody."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

NOBODY = 65_534


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a file belong to another user: root gives it away, anybody else becomes another user for the check."""
    monkeypatch.delenv("SUDO_UID", raising=False)
    if os.geteuid() == 0:
        os.chown(path, NOBODY, NOBODY)
    else:
        other = os.geteuid() + 1
        monkeypatch.setattr(os, "geteuid", lambda: other)
