"""Start gate, which holds commands back until the cluster serves."""

import subprocess
from pathlib import Path

from fog.launch.start_gate import StartGate


def held(gate: StartGate) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*gate.prefix(), "echo", "begun"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_a_command_begins_when_the_gate_opens_and_at_once_afterwards(tmp_path: Path) -> None:
    gate = StartGate.closed(tmp_path / "gate")
    with held(gate) as waiting:
        gate.open(serving=True)
        gate.open(serving=False)
        assert waiting.communicate()[0] == "begun\n"
    with held(gate) as late:
        assert late.communicate()[0] == "begun\n"


def test_no_node_waits_for_a_launch_that_is_gone(tmp_path: Path) -> None:
    gate = StartGate.closed(tmp_path / "gate")
    with held(gate) as waiting:
        gate.open(serving=False)
        assert waiting.communicate() == ("", "not started: the cluster does not serve\n")
        assert waiting.returncode == 1
    gate.path.unlink()
    with held(gate) as late:
        assert late.wait() == 1
        late.communicate()
