"""Two machines set up by the commands of a how-to page, or of the tutorial, in two namespaces that a cable joins."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.namespaces import Space, cable
from proxy.recordings.compare import compare
from tests.machines import Machines
from tests.pages import ROOT, Block, blocks

pytestmark = pytest.mark.netns

CABLE = blocks(ROOT / "docs/how-to/one-cable.md")
TUTORIAL = blocks(ROOT / "docs/tutorials/two-machines.md")
_TOPIC = "/camera/image"


@pytest.mark.parametrize(
    "page", [pytest.param(CABLE, id="cable"), pytest.param(TUTORIAL, marks=pytest.mark.nightly, id="tutorial")]
)
def test_a_recording_goes_from_one_machine_to_the_other_by_the_commands_of_a_page(
    page: list[Block], space: Space, tmp_path: Path
) -> None:
    with cable(space) as server, Machines(tmp_path, server) as machines:
        printed = machines.follow(page)
        said = machines.end()
    assert "100 messages sent, 100 confirmed" in printed
    assert said.keys() == {f"gdp-{each}, exit 0" for each in ("switch", "rib", "proxy")}
    assert "100 messages received, 0 lost" in said["gdp-proxy, exit 0"]
    result = compare(machines.robot / "drive.mcap", machines.server / "server/received.mcap", exact=False)
    (image,) = (each for each in result if each.topic == _TOPIC)
    assert (image.delivered, image.identical, image.in_order) == (100, True, True)
