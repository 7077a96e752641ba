"""A robot and a server of one domain that share names, for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.gdp.sharing.machines import Machine, Site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    with ExitStack() as stack:
        for label in ("robot", "server"):
            site.add(label).start(stack)
        yield site


@pytest.fixture
def robot(site: Site) -> Machine:
    return site.machines["robot"]


@pytest.fixture
def server(site: Site) -> Machine:
    return site.machines["server"]
