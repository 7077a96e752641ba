"""Files of another user, for tests that run as root or as an ordinary user."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

UNKNOWN = 65_534


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a file to another user: root changes its owner, an ordinary user changes identity for the check."""
    monkeypatch.delenv("SUDO_UID", raising=False)
    if os.geteuid() == 0:
        os.chown(path, UNKNOWN, UNKNOWN)
    else:
        other = os.geteuid() + 1
        monkeypatch.setattr(os, "geteuid", lambda: other)
