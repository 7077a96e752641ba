"""Missing rights to make a namespace are named with their remedy."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest
from pyroute2 import netns

from gdp.errors import LocalError
from gdp.host.netns_files import create


def test_who_may_not_make_a_namespace_learns_how_to_get_the_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str) -> None:
        raise OSError(errno.EPERM, "mount rundir failed")

    monkeypatch.setattr(netns, "create", refuse)
    with pytest.raises(LocalError, match=r"run this as root, or with scripts/privileged\.sh"):
        create(tmp_path / "gateway")
