"""Outputs of nodes for programs: the JSON of each command, the tables and the metrics have the golden form.

python -m tests.proxy.node.test_outputs     # renews outputs.json, in a commit of its own
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Final
from unittest.mock import patch

from gdp.state import tables
from tests.proxy.node.memory_nodes import outputs

GOLDEN: Final = Path(__file__).with_name("outputs.json")


def test_the_json_of_each_command_and_the_metrics_are_golden(tmp_path: Path) -> None:
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    found = _outputs(tmp_path)
    assert found.keys() == golden.keys()
    for node, shown in golden.items():
        assert found[node] == shown, node


def _outputs(folder: Path) -> dict[str, object]:
    with patch.object(tables, "VARIANT", "of this machine"):
        return outputs(folder)


def _renew() -> None:
    with tempfile.TemporaryDirectory() as folder:
        text = json.dumps(_outputs(Path(folder)), ensure_ascii=False, indent=1)
    GOLDEN.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    _renew()
