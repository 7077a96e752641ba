"""Command ``python -m fleet_demo``, which ``scripts/fleet_demo.sh`` runs once everything is set up.

I/O. Two robots whose frames have the same names drive; a station at the far end of the ring has them in one tree, and
draws it. Exit codes: 0 each transform came once, 1 not, 2 wrong input.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from gdp.intervals import MINUTE_S
from lab.command import console_of, end_on_signals, exit_with, new_app, tell
from lab.credentials import Carried, OverlayCredentials
from lab.machine import PROGRAMS
from lab.machines import Lab, OverlayNodes
from lab.process import new_run
from lab.topology import Attachment, ring5
from make_demo_bag import START_NS, TYPES, Drive
from proxy.recordings.reader import BagReader
from proxy.recordings.writer import BagWriter

TF, STATIC = "/tf", "/tf_static"
TYPE: Final = TYPES[TF][0]
SECONDS, HZ = 20, 20
ORIGINS: Final = {"robot1": ((-1.2, 0.4), 0.0), "robot2": ((1.6, -0.3), 0.9)}  # metres in the map, and a heading
TOPOLOGY: Final = replace(ring5(), attachments=(*ring5().attachments, Attachment("nuc2", "proxy", "robot2")))
FILE: Final = Path("fleet.png")
CUT: Final = ("nuc5", "nuc1")  # the station's and the first robot's link, which is lost half way

Pose = tuple[complex, float]  # x and y in metres, heading in radians
Transform = tuple[str, str, Pose]  # parent, child, and the child's pose in the parent


def make_recording(path: Path, label: str) -> None:
    """Record the transforms of a drive from a place of its own in the map."""
    drive, (origin, heading) = Drive(2), ORIGINS[label]
    with BagWriter(path, 2) as bag:
        handles = {topic: bag.add(drive.channel(topic)) for topic in (TF, STATIC)}
        bag.write(handles[STATIC], START_NS, drive.raw(STATIC, 0))
        for at_ns in range(0, SECONDS * 1_000_000_000, 1_000_000_000 // HZ):
            here = drive.transform(at_ns, ("map", "odom"), (*origin, 0.0), heading)
            message = drive.make(TYPE, {"transforms": [here, *drive.transforms(at_ns)["transforms"]]})
            bag.write(handles[TF], START_NS + at_ns, bytes(drive.store.serialize_cdr(message, TYPE)))


def read(path: Path, prefix: str = "") -> list[Transform]:
    """Return the transforms of a recording, in order, with a prefix for the frames of one robot."""
    drive, found = Drive(2), list[Transform]()
    with BagReader(path) as reader:
        for raw in (message.raw for message in reader.messages()):
            message: Any = drive.store.deserialize_cdr(raw, TYPE)
            for each in message.transforms:
                at, turn, parent = each.transform.translation, each.transform.rotation, each.header.frame_id
                parent = parent if parent == "map" else prefix + parent
                pose = complex(at.x, at.y), 2 * math.atan2(turn.z, turn.w)
                found.append((parent, prefix + each.child_frame_id, pose))
    return found


def draw(transforms: Sequence[Transform], path: Path) -> None:
    """Draw the tree as it is at the end, and the path of each base, into a PNG file."""
    from matplotlib.figure import Figure  # no command's help needs it

    newest, paths = dict[str, tuple[str, Pose]](), dict[str, list[complex]]()

    def pose(frame: str) -> Pose:
        parent, (at, heading) = newest.get(frame, ("", (0j, 0.0)))
        above, turned = pose(parent) if parent else (0j, 0.0)
        return above + at * cmath.rect(1, turned), turned + heading

    for parent, child, own in transforms:
        newest[child] = parent, own
        if child.endswith("/base_link"):
            paths.setdefault(child, []).append(pose(child)[0])
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    axis = figure.subplots()
    axis.set(facecolor="#303030", aspect="equal", xlabel="x in map, m", ylabel="y in map, m")
    for (frame, places), colour in zip(sorted(paths.items()), ("#ffb000", "#40c0ff"), strict=True):
        axis.plot([at.real for at in places], [at.imag for at in places], color=colour, label=f"path of {frame}")
    for frame in ("map", *newest):
        at, heading = pose(frame)
        above = pose(newest[frame][0])[0] if frame in newest else at
        ends = {"#e04040": at + cmath.rect(0.2, heading), "#50d050": at + 1j * cmath.rect(0.2, heading)}  # x, y
        for colour, end in (*ends.items(), ("#ff80ff", above)):
            axis.plot([at.real, end.real], [at.imag, end.imag], color=colour, lw=1)
        if any(parent == frame for parent, _ in newest.values()):
            axis.annotate(frame, (at.real, at.imag), (4, -12), textcoords="offset points", color="white", fontsize=8)
    axis.legend(facecolor="#808080")
    figure.savefig(path, dpi=90)


def demonstrate(output: Path) -> int:
    """Run the demonstration; return the exit code."""
    console = console_of()
    with new_run() as run:
        lab, credentials = Lab(run, TOPOLOGY), OverlayCredentials(TOPOLOGY, run.directory)
        robots = dict(zip(("robot1", "station", "robot2"), TOPOLOGY.attached("proxy"), strict=True))
        place = robots.pop("station")
        OverlayNodes(lab, credentials).stand_up(TOPOLOGY.nodes, "auto")
        bags = {label: run.directory / f"{label}.mcap" for label in robots}
        configs, taken, merged = list[Path](), list[Carried](), run.directory / "station.mcap"
        for label, at in robots.items():
            make_recording(bags[label], label)
            options = {"prefix": label, "frames": {"add": f"{label}/", "common": ["map"]}}  # frames: at the station
            names = [Carried(topic, TYPE, options=deepcopy(options)) for topic in (TF, STATIC)]
            configs.append(credentials.proxy(at, {"expose": names}))
            taken += names
        config = credentials.proxy(place, {"import": taken}, record={"path": str(merged)})
        station = lab.start("nuc5", "station", ["-m", PROGRAMS["proxy"], "--json", "--config", str(config)])
        station.read(MINUTE_S)
        console.print(f"robots at nuc1 and nuc2 drive for {SECONDS} s; half way the link {'-'.join(CUT)} is lost")
        driving = [
            lab.start(at.switch, label, ["-m", "proxy.cli.replay", str(bags[label]), "--config", str(path), "--json"])
            for (label, at), path in zip(robots.items(), configs, strict=True)
        ]
        while int(driving[0].read(MINUTE_S).get("sent", 0)) < SECONDS * HZ / 2:
            pass
        lab.namespaces.cut(*CUT)
        for each in driving:
            each.reap(SECONDS + MINUTE_S)
        station.finish()
        tree = read(merged)
        got, wanted = Counter(tree), Counter(each for label in robots for each in read(bags[label], f"{label}/"))
        draw(tree, output)
    counts = ("transforms", wanted), ("wrong or doubled", got - wanted), ("lost", wanted - got)
    rows = [f"{what:<20}{counted.total()}" for what, counted in counts]
    return tell(console, rows, f"one tree: {output}", None, failed=got != wanted, as_json=False)


app = new_app()


@app.command()
def main(output: Annotated[Path, typer.Option("-o", "--output", help="The file to write.")] = FILE) -> None:
    """Draw one tree of transforms and the paths of two robots whose frames have the same names."""
    end_on_signals()
    exit_with(lambda: demonstrate(output))


if __name__ == "__main__":
    app()
