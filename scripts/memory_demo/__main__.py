"""Command ``python -m memory_demo``, which ``scripts/memory_demo.sh`` runs once everything is set up.

I/O. Exit codes: 0 the window is whole, 1 it is not, 2 wrong input.
"""

from __future__ import annotations

import json
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from gdp.crypto.certificates import Role
from gdp.host.run_registry import Run
from gdp.metadata import Metadata
from gdp.trust.right import Right
from lab.command import console_of, end_on_signals, exit_with, new_app, tell
from lab.credentials import Carried, OverlayCredentials
from lab.machine import GDP
from lab.machines import Lab, OverlayNodes
from lab.namespaces import Namespaces
from lab.process import LabProcess, new_run
from lab.topology import Attachment, ring5
from make_demo_bag import START_NS, TYPES, Drive, moments
from proxy.recordings.reader import BagReader
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel

ESTOP: Final = "/estop"
BOOL: Final = "std_msgs/msg/Bool"
KEPT: Final = ("/scan", "/odom", "/imu", "/tf")
STORE: Final = Metadata({"kind": "service", "name": "store"})
UPLINKS: Final = (("nuc1", "nuc2"), ("nuc5", "nuc1"))
BEFORE_S, AFTER_S = 6, 3
PIECE_S: Final = (0.5, 3.0)  # shortest and longest time up, or down
READY_S: Final = 60.0
TOPOLOGY: Final = replace(ring5(), attachments=(*ring5().attachments, Attachment("nuc3", "proxy", "holder")))
ROBOT, SERVER, HOLDER = (at for at in TOPOLOGY.attachments if at.role == "proxy")


def make_recording(path: Path, seconds: float, stop_s: float) -> None:
    """Record a drive whose emergency stop is pressed after ``stop_s`` seconds."""
    drive = Drive(2)
    definition, _ = drive.store.generate_msgdef(BOOL, ros_version=2)
    hash_ = drive.store.hash_rihs01(BOOL)
    stop = Channel(ESTOP, BOOL, 2, hash=hash_, definition=definition, definition_format="msg")
    pressed = bytes(drive.store.serialize_cdr(drive.make(BOOL, {"data": True}), BOOL))
    with BagWriter(path, 2) as bag:
        handles = {topic: bag.add(drive.channel(topic)) for topic in KEPT}
        is_pressed = False
        for at_ns, topic in moments(seconds):
            if at_ns >= stop_s * 1e9 and not is_pressed:
                is_pressed = True
                bag.write(bag.add(stop), START_NS + at_ns, pressed)
            if topic in handles:
                bag.write(handles[topic], START_NS + at_ns, drive.raw(topic, at_ns))


def messages(path: Path) -> list[tuple[str, bytes, int]]:
    """Return topic, bytes and stamp of each message of a recording that is kept."""
    with BagReader(path) as reader:
        topics = [each.topic for each in reader.channels]
        found = [(topics[each.channel], each.raw, each.stamp_ns) for each in reader.messages()]
    return [each for each in found if each[0] in KEPT]


@contextmanager
def broken_uplink(namespaces: Namespaces, seed: int) -> Iterator[list[float]]:
    """Cut the robot's uplinks for half of the time in random pieces; yield the times down and up, in seconds."""
    rng, ended, spent = random.Random(seed), threading.Event(), [0.0, 0.0]

    def turn() -> None:
        while not ended.is_set():
            for is_up, change in enumerate((namespaces.cut, namespaces.restore_link)):
                for link in UPLINKS:
                    change(*link)
                piece_s = rng.uniform(*PIECE_S)
                spent[is_up] += piece_s
                ended.wait(piece_s)

    thread = threading.Thread(target=turn, name="uplink")
    thread.start()
    try:
        yield spent
    finally:
        ended.set()
        thread.join()


class Site:
    """The ring with a robot that keeps its topics, a holder at nuc3, and who investigates at nuc5."""

    def __init__(self, run: Run) -> None:
        self.lab, self.folder = Lab(run, TOPOLOGY), run.directory
        self.credentials = credentials = OverlayCredentials(TOPOLOGY, run.directory)
        self.nodes = OverlayNodes(self.lab, credentials)
        self.store, state = run.directory / "capsules", run.directory / "state"
        state.mkdir()
        keep = {"before": f"{BEFORE_S}s", "after": f"{AFTER_S}s", "when": ESTOP, "to": "store"}
        kept = [Carried(topic, TYPES[topic][0], options={"keep": dict(keep)}) for topic in KEPT]
        read = [Carried(topic, TYPES[topic][0]) for topic in KEPT]
        for node, right in (("nuc1", Right.CALL), ("nuc3", Right.SERVE), ("nuc5", Right.CALL)):
            credentials.delegate(node, STORE, right)
        self.robot = credentials.proxy(ROBOT, {"expose": [*kept, Carried(ESTOP, BOOL)]}, state=str(state))
        self.investigator = credentials.proxy(SERVER, {"import": read})
        self.holder = credentials.write(
            "holder.yaml", {**credentials.node_yaml(Role.PROXY, "nuc3"), "iface": HOLDER.ifname}
        )

    def stand_up(self) -> LabProcess:
        """Start switches, RIBs and the holder; return the holder."""
        self.nodes.stand_up(TOPOLOGY.nodes, "auto")
        argv = [*GDP, "store", "serve", str(self.holder), "--store", str(self.store), "--json"]
        holder = self.lab.machines["nuc3"].launch(argv, "holder")
        holder.read(READY_S)
        return holder

    def drive(self, recording: Path) -> None:
        """Replay the recording at the robot until the holder has the window."""
        argv = ["-m", "proxy.cli.replay", str(recording), "--config", str(self.robot), "--wait-readers", "0", "--json"]
        robot = self.lab.start("nuc1", "robot", argv)
        said: dict[str, Any] = {}
        while said.get("event") != "done":
            said = robot.read(READY_S)
        robot.reap(READY_S)

    def gdp(self, *words: object) -> str:
        """Run ``gdp`` at nuc5."""
        return self.lab.machines["nuc5"].gdp(*words)


def demonstrate(seconds: float, output: Path, seed: int, *, as_json: bool) -> int:
    """Run the demonstration; return the exit code."""
    console = console_of(stderr=as_json)
    with new_run() as run:
        recording, stop_s = run.directory / "drive.mcap", seconds - AFTER_S - 3
        make_recording(recording, seconds, stop_s)
        console.print("five namespaces, a robot at nuc1, a holder at nuc3")
        site = Site(run)
        holder = site.stand_up()
        console.print(f"the robot drives {seconds:g} s, and stops after {stop_s:g} s; its uplink comes and goes")
        with broken_uplink(site.lab.namespaces, seed) as spent:
            site.drive(recording)
        mark = ("--from", f"mark:{ESTOP}", "--to", f"mark:{ESTOP}")
        lines = site.gdp("store", "export", *KEPT, "--node", site.investigator, *mark, "-o", output.resolve(), "--json")
        problems = [each for line in lines.splitlines() for each in json.loads(line).get("problems", ())]
        holder.finish()
        for capsule in site.store.glob("*/descriptor.cbor"):
            site.gdp("store", "verify", capsule.parent.name, "--store", site.store)
        drive, window = messages(recording), messages(output)
        held = [path.read_bytes() for path in site.store.rglob("*") if path.is_file()]
        numbers = {(topic, raw): at for at, (topic, raw, _) in enumerate(drive)}
        places = {topic: sorted(numbers[topic, raw] for of, raw, _ in window if of == topic) for topic in KEPT}
        spans = {topic: drive[of[0] : of[-1] + 1] for topic, of in places.items() if of}
        wanted = {topic: sum(each[0] == topic for each in span) for topic, span in spans.items()}
        missing = sum(wanted.values()) - len(window) + (len(KEPT) - len(wanted))
        readable = sum(len(raw) for _, raw, _ in drive if len(raw) > 64 and any(raw in data for data in held))
    outcome = {
        "uplink gone, share": round(spent[0] / sum(spent), 2),
        "window, s": round((window[-1][2] - window[0][2]) / 1e9, 1) if window else 0,
        "messages in the window": len(window),
        "messages missing in it": missing,
        "messages of the drive": len(drive),
        "readable bytes at the holder": readable,
        "bytes at the holder": sum(map(len, held)),
        "problems": problems,
    }
    is_short = not window or window[-1][2] - window[0][2] < (BEFORE_S + AFTER_S - 1) * 1e9
    failed = bool(missing or readable or problems or is_short)
    summary = f"the window is {'not ' * failed}whole: {output}"
    rows = [f"{key:<32}{value}" for key, value in outcome.items()]
    return tell(console, rows, summary, outcome, failed=failed, as_json=as_json)


app = new_app()


@app.command()
def main(
    seconds: Annotated[float, typer.Option(min=12.0, max=600.0, help="Of the drive.")] = 25.0,
    output: Annotated[Path, typer.Option("-o", "--output", help="The file to write.")] = Path("incident.mcap"),
    seed: Annotated[int, typer.Option(help="Of the times at which the uplink comes and goes.")] = 1,
    json_: Annotated[bool, typer.Option("--json", help="The outcome as JSON.")] = False,
) -> None:
    """Show what stood around an emergency stop, from a holder that cannot read it."""
    end_on_signals()
    if output.exists():
        raise typer.BadParameter(f"{output} exists already")
    exit_with(lambda: demonstrate(seconds, output, seed, as_json=json_))


if __name__ == "__main__":
    app()
