"""Scene of a small network in memory: what the page gets has the golden form."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from gdp.management.control_socket import ControlHandlers
from gdp_extensions.dashboard.core.readings import Reading
from gdp_extensions.dashboard.core.scene import Scene
from tests.proxy.node.memory_nodes import outputs

GOLDEN: Final = Path(__file__).with_name("scene.json")


def shown(nodes: Iterable[ControlHandlers]) -> dict[str, object]:
    """Return what the page shows after two seconds."""
    scene = Scene()
    for second in range(2):
        rows = [
            Reading(json.loads(json.dumps(each.snapshot())), json.loads(json.dumps(each.topology()))) for each in nodes
        ]
        scene.update(rows, float(second), float(second))
    return {"structure": scene.structure(), "figures": scene.figures(0), "name": scene.name_detail("x")}


def test_the_scene_of_a_network_is_golden(tmp_path: Path) -> None:
    assert outputs(tmp_path, {"dashboard": shown})["dashboard"] == json.loads(GOLDEN.read_text(encoding="utf-8"))
