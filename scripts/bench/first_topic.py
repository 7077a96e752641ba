"""Seconds from the first command to the first image: a robot and a server behind two NATs, and a border, all fresh.

The commands are those that docs/tutorials/internet.md tells a person to type after the installation: this bench reads
them there, counts them, and types each one as soon as the one before it has said that it is done. The machines have
empty folders. A camera on the robot and a viewer on the server are ordinary rclpy nodes, and run from the beginning.

    sudo .venv/bin/python scripts/bench/first_topic.py                  # writes docs/benchmarks/first_topic.json
    sudo .venv/bin/python scripts/bench/first_topic.py --rounds 1 --no-save
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from report import Rounds, Settings, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.errors import LocalError
from lab.internet.access import Access
from lab.internet.fresh_machine import FreshMachine, TypedCommand, typed_commands
from lab.internet.laboratory import Laboratory
from lab.process import FailedError, LabProcess, new_run

PAGE: Final = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "internet.md"
BORDER_HOST: Final = "border.example.org"  # in the tutorial; here the border's address
TOPIC: Final = "/camera/image"
BASELINE: Final = "tutorial"
TIMES, TYPED = "seconds, without a person's", "typed"
WHOLE, ALL, FOREIGN = "first command to first image", "on all machines", "other than gdp"
_SITES: Final = {"border": Access.PUBLIC, "robot": Access.PORT_RESTRICTED, "server": Access.PORT_RESTRICTED}
_PATIENCE_S: Final = 120.0
_DELAY_MS: Final = 10.0  # of each uplink, each way
_TOKEN: Final = re.compile(r"^gdp1\S+$", re.MULTILINE)
_ENDPOINT: Final = str(Path(__file__).with_name("ros_topics.py"))
_DONE: Final = {"gdp domain create": "listening on TCP port", "gdp join": "tunnels are up"}  # they go on running


class Tutorial:
    """The machines of the tutorial, on which its commands are typed in order."""

    def __init__(self, laboratory: Laboratory, stack: ExitStack) -> None:
        self.machines: dict[str, FreshMachine] = {}
        self._tokens: list[str] = []
        for label, access in _SITES.items():
            site = laboratory.add_site(f"at-{label}", access, delay_ms=_DELAY_MS)
            machine = FreshMachine(laboratory.add_host(label, site), laboratory.run.directory)
            self.machines[label] = stack.enter_context(machine)
        self._border = self.machines["border"].host.lease().address.partition("/")[0]

    def type(self, command: TypedCommand) -> None:
        """Type a command; return when it has said that it is done, or has ended. Raises ``LocalError``: it fails."""
        text = command.text.replace(BORDER_HOST, self._border)
        answer = self._tokens.pop(0) if text.startswith("gdp join") else ""
        shell = self.machines[command.machine].type(text, answer)
        try:
            self._wait(command, shell)
        except LocalError as error:
            raise FailedError(f"{command.machine}: {command.text}: {error}") from error
        self._tokens += _TOKEN.findall(shell.logged)

    def _wait(self, command: TypedCommand, shell: LabProcess) -> None:
        done = next((words for start, words in _DONE.items() if command.text.startswith(start)), "")
        if done:
            shell.until_logged(done, patience_s=_PATIENCE_S)
        else:
            shell.output(_PATIENCE_S)


def measure(options: Options) -> Outcome:
    """Follow the tutorial from its beginning in each round."""
    over, commands = Rounds(), typed_commands(PAGE.read_text(encoding="utf-8"))
    for number in range(1, options.rounds + 1):
        for what, seconds in _follow(commands).items():
            over.add(BASELINE, TIMES, what, seconds)
            progress(f"round {number}, {what}: {seconds:.1f} s")
    for label in _SITES:
        over.add(BASELINE, TYPED, f"on the {label}", sum(each.machine == label for each in commands))
    over.add(BASELINE, TYPED, ALL, len(commands))
    over.add(BASELINE, TYPED, FOREIGN, sum(not each.text.startswith("gdp ") for each in commands))
    targets = [
        over.target("commands on all machines", BASELINE, TYPED, ALL, 5, at_most=True),
        over.target("commands on the robot", BASELINE, TYPED, "on the robot", 3, at_most=True),
        over.target("commands on the server", BASELINE, TYPED, "on the server", 2, at_most=True),
        over.target("commands that edit or copy a file", BASELINE, TYPED, FOREIGN, 0, at_most=True),
        over.target("first command to first image, s", BASELINE, TIMES, WHOLE, 90, at_most=True),
    ]
    settings: Settings = {
        "delay of each uplink, ms": _DELAY_MS,
        "commands": [f"{each.machine}: {each.text}" for each in commands],
        "tutorial, SHA-256": hashlib.sha256(PAGE.read_bytes()).hexdigest(),
    }
    return Outcome("first_topic", "First topic between fresh machines behind two NATs", over, targets, settings)


def _follow(commands: Sequence[TypedCommand]) -> Mapping[str, float]:
    """Return the seconds of each command, from the last one to the first image, and of all."""
    found = dict[str, float]()
    with new_run() as run, Laboratory(run) as laboratory, ExitStack() as stack:
        tutorial = Tutorial(laboratory, stack)
        nodes = {}
        for label, role in (("robot", "camera"), ("server", "viewer")):
            settings = [_ENDPOINT, role, json.dumps({"topic": TOPIC})]
            nodes[role] = tutorial.machines[label].launch([sys.executable, *settings], role)
            nodes[role].read(_PATIENCE_S)
        begun_s = at_s = time.monotonic()
        for each in commands:
            tutorial.type(each)
            at_s, since_s = time.monotonic(), at_s
            found[f"{each.machine}: {' '.join(each.text.split()[:2])}"] = at_s - since_s
        image_s = float(str(nodes["viewer"].read(_PATIENCE_S)["at_s"]))
        found["last command to image"] = max(image_s - at_s, 0.0)
        found[WHOLE] = max(image_s, at_s) - begun_s
    return found


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, quick={"rounds": 1}, has_record=True)
    run_bench(parser, measure)
