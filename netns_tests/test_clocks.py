"""The offset of a clock over a cable: a proxy whose wall clock is ahead asks the switch of another machine."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from typing import Any, Final

import pytest

from lab.namespaces import Space, cable
from lab.process import calling, until
from tests.machines import Machines
from tests.pages import ROOT, blocks

pytestmark = [pytest.mark.netns, pytest.mark.momentary("a request and its reply take milliseconds")]

AHEAD_S: Final = 2.5
ERROR_MAX_MS: Final = 1.0
PATIENCE_S: Final = 60.0
TUTORIAL: Final = blocks(ROOT / "docs/tutorials/two-machines.md")
NODE: Final = "server/proxy"


def run_ahead(*words: str) -> None:
    """Run ``gdp-proxy`` with a wall clock that is ahead; the system has one for all namespaces."""
    from proxy.cli.proxy import main

    seconds, nanoseconds = time.time, time.time_ns
    time.time = lambda: seconds() + AHEAD_S
    time.time_ns = lambda: nanoseconds() + int(AHEAD_S * 1e9)
    sys.argv = ["gdp-proxy", *words]
    main()


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    """The two machines as the page leaves them, with a recorder whose clock is ahead."""
    with Space() as space, cable(space) as server, Machines(tmp_path_factory.mktemp("machines"), server) as made:
        made.follow(TUTORIAL, but=("gdp-replay", "gdp-proxy", "scripts/make_demo_bag.py"))
        made.start(" ".join(calling(run_ahead, "--config", "server/proxy.yaml")), made.server)
        yield made


def replies(machines: Machines, name: str) -> list[dict[str, Any]]:
    """Return the replies to some requests."""
    lines = machines.run(f"gdp ping {name} --node {NODE} -c 5 -i 0.05 --json", machines.server).splitlines()
    return [json.loads(line) for line in lines[:-1]]


def test_the_offset_over_a_cable_is_known_to_a_millisecond(machines: Machines) -> None:
    name = json.loads(machines.run("gdp status robot/switch --json", machines.robot))["name"]
    errors_ms: list[tuple[float, float]] = []

    def is_known() -> bool:
        for each in replies(machines, name):
            errors_ms.append((abs(each["clock_offset_ms"] + 1e3 * AHEAD_S), each["clock_bound_ms"]))
        return errors_ms[-1][0] <= ERROR_MAX_MS

    until(is_known, "an exchange that a busy machine does not delay", PATIENCE_S)
    assert all(error_ms <= bound_ms for error_ms, bound_ms in errors_ms), errors_ms
