"""Command ``python -m ring``, which ``scripts/ring_topology.sh`` runs once everything is set up.

I/O. Exit codes: 0 passed, 1 failed, 2 wrong input, 130 and 143 for Ctrl-C and SIGTERM.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Final, TypeVar, get_args

import typer
from rich.console import Console
from rich.markup import escape

from gdp.errors import LocalError
from gdp.host.interruption import let_nothing_interrupt
from gdp.host.run_registry import Run, RunRegistry, in_first_user_namespace
from gdp.intervals import ADVERTISEMENT
from lab.command import FAILED, PASSED, console_of, end_on_signals, exit_with, new_app
from lab.credentials import METRICS_PORTS
from lab.topology import MTU_BYTES
from proxy.config.config import Encoding
from ring.faults import fault_from_text
from ring.live_run import LiveRing
from ring.nodes.content import CAMERA_HZ
from ring.options import LIVE_S, Live, Options, RingPlane
from ring.overlay import Overlay
from ring.result import Result
from ring.run import DEMO_S, Ring, make_demo
from ring.table import summary, table
from ring.traffic import ProgressReporter


def hints(overlay: Overlay) -> list[tuple[str, str]]:
    """Return pairs of (effect, command line) for a ring that was kept."""
    script = Path(__file__).parents[2] / "scripts" / "ring_topology.sh"
    metrics = f"curl -s http://127.0.0.1:{METRICS_PORTS['switch']}/metrics"
    return [
        ("what the switch in the middle counts", inside(overlay, "nuc3", metrics)),
        ("what passes it", inside(overlay, "nuc3", "tcpdump -e -i nuc4 ether proto 0x88b5")),
        ("cut the usual way, and watch the other be taken", inside(overlay, "nuc2", "ip link set nuc3 down")),
        ("what all log", f"tail -n 3 {overlay.lab.directory}/*.log"),
        ("take everything down", f"{script} --down"),
    ]


def inside(overlay: Overlay, node: str, command: str) -> str:
    """Return the shell command that runs a command in the namespace of a switch, from outside."""
    if in_first_user_namespace():
        return f"ip netns exec {overlay.lab.namespaces[node].path.name} {command}"
    pid = overlay.nodes.running["switch", node].pid
    return f"nsenter --target {pid} --user --mount --net --preserve-credentials {command}"


ENCODINGS: Final[tuple[Encoding, ...]] = get_args(Encoding)
PLANES: Final[tuple[RingPlane, ...]] = get_args(RingPlane)
LIVES: Final[tuple[Live, ...]] = get_args(Live)
_COLUMNS, _WIDE_COLUMNS = 100, 200  # where the terminal's width is unknown

_EXAMPLES: Final = """\b
Examples:
  scripts/ring_topology.sh                           a generated robot drive
  scripts/ring_topology.sh my.bag --encoding cdr     the bytes as they are
  scripts/ring_topology.sh --live                    real ROS 2 nodes at both ends
  scripts/ring_topology.sh --live mixed              ROS 1 at the robot, ROS 2 at the server
  scripts/ring_topology.sh --rate 0 --json out.json  as fast as it goes
  scripts/ring_topology.sh --cut nuc2-nuc3@5         a link fails after 5 s
  scripts/ring_topology.sh --cut nuc4-nuc5@3-6       and one that comes back
  scripts/ring_topology.sh --roam robot:nuc3@5       the robot drives on to another switch
  scripts/ring_topology.sh --kill rib:school@5       a RIB dies
  scripts/ring_topology.sh --live --seconds 70 --cut nuc1-nuc2@5 --kill switch:nuc3@20-30 --roam server:nuc4@40
  scripts/ring_topology.sh --data-plane scapy        every frame built by Scapy
  scripts/ring_topology.sh --cores                   a robot of two cores, edge servers of four
  scripts/ring_topology.sh --keep                    leave it up to look around
  scripts/ring_topology.sh --down                    and take it down
"""

T = TypeVar("T")

app = new_app()


@app.command(epilog=_EXAMPLES)
def ring(
    bag: Annotated[Path | None, typer.Argument(metavar="[BAG]", help="A recording: .bag, .mcap, .db3, folder.")] = None,
    live: Annotated[
        str | None, typer.Option(metavar="[ROS]", help=f"Real nodes instead: {', '.join(LIVES)}; ros2 where not said.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help=f"Of traffic; a recording is stretched. Live: {LIVE_S:g} where not said.")
    ] = None,
    camera_hz: Annotated[float, typer.Option(help="Images a second of the live camera.")] = CAMERA_HZ,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.")] = None,
    rate: Annotated[float, typer.Option(help="Pace of the replay; 0: as fast as it goes.")] = 1.0,
    encoding: Annotated[str, typer.Option(help=f"Of messages: {', '.join(ENCODINGS)}.")] = "json",
    data_plane: Annotated[
        str, typer.Option(help=f"Of the switches: {', '.join(PLANES)}; scapy: of RIBs and proxies, too.")
    ] = "auto",
    mtu: Annotated[int, typer.Option(help="Of the links, in bytes.")] = MTU_BYTES,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the received recording here.")] = None,
    pcap: Annotated[Path | None, typer.Option(metavar="FILE", help="Write what an eavesdropper on nuc3 sees.")] = None,
    cut: Annotated[
        list[str] | None, typer.Option(metavar="A-B@S[-T]", help="Cut a link after S seconds; heal it after T.")
    ] = None,
    roam: Annotated[
        list[str] | None, typer.Option(metavar="WHO:SWITCH@S", help="Plug the robot or server in at another switch.")
    ] = None,
    kill: Annotated[
        list[str] | None,
        typer.Option(metavar="WHAT@S[-T]", help="Kill rib:DOMAIN or switch:NAME after S seconds; restart it after T."),
    ] = None,
    lease: Annotated[
        float, typer.Option(help="Of names, in seconds: what is not renewed is forgotten.")
    ] = ADVERTISEMENT.lease_s,
    cores: Annotated[
        bool, typer.Option("--cores", help="Two cores' worth for the robot, four for each edge server, by cgroups.")
    ] = False,
    wide: Annotated[bool, typer.Option("--wide", help="All columns of the table, 200 characters.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Leave the ring up, and say what to try.")] = False,
    down: Annotated[bool, typer.Option("--down", help="Take down every ring that was kept, and end.")] = False,
) -> None:
    """Send a recording from a robot at nuc1 over a ring of five name-routed switches to a server at nuc5, and compare.

    With --live it is real nodes that talk: a talker, a camera, a mapper and a service at nuc1, and at nuc5 those who
    listen and call. Switches, RIBs and proxies are processes in network namespaces; keys and certificates are made for
    the run. Links, switches and RIBs may fail meanwhile, and the ends may move: --cut, --kill and --roam, each as often
    as wanted. The exit code is 0 only if every message came out identical and in order, and every call was answered.
    """
    errors = Console(stderr=True)

    def run() -> int:
        runs = RunRegistry()
        if down:
            taken = runs.take_down()
            errors.print(f"taken down: {', '.join(taken)}" if taken else "nothing was left up", highlight=False)
            return PASSED
        options = Options(
            bag=_absolute(bag),
            rate=rate,
            encoding=_one_of("encoding", encoding, ENCODINGS),
            data_plane=_one_of("data-plane", data_plane, PLANES),
            mtu=mtu,
            out=_absolute(out),
            json=_absolute(json_file),
            pcap=_absolute(pcap),
            faults=tuple(
                fault_from_text(option, each)
                for option, given in (("cut", cut), ("roam", roam), ("kill", kill))
                for each in given or ()
            ),
            lease_s=lease,
            keep=keep,
            cores=cores,
            wide=wide,
            live=None if live is None else _one_of("live", live, LIVES),
            seconds=seconds,
            camera_hz=camera_hz,
        )
        for swept in runs.sweep():
            errors.print(f"took down what run {swept} had left behind", highlight=False)
        return _run(options, runs.start(), errors)

    exit_with(run)


def main() -> None:
    """Run the command; never returns."""
    app(list(spelled_out(sys.argv[1:])), prog_name="ring_topology.sh")


def spelled_out(words: Sequence[str]) -> Iterator[str]:
    """Yield the command line with ``ros2`` after each ``--live`` without a value."""
    for word, following in zip_longest(words, words[1:], fillvalue="-"):
        yield word
        if word == "--live" and following.startswith("-"):
            yield LIVES[0]


def _run(options: Options, run: Run, errors: Console) -> int:
    """Execute one run, and remove what it created unless it is to be kept."""
    end_on_signals()
    is_kept = False
    try:
        code = _go(options, run, errors)
        is_kept = options.keep
    except SystemExit:
        errors.print("interrupted; taking everything down")
        raise
    finally:
        if is_kept:
            run.retain()
        else:
            let_nothing_interrupt()
            run.end()
    return code


def _go(options: Options, run: Run, errors: Console) -> int:
    with ProgressReporter(errors) as reporter:
        ring = _ring(options, run, reporter)
        result = ring.result()
    output = console_of(columns=_WIDE_COLUMNS if options.wide else _COLUMNS)
    output.print(table(result, is_wide=options.wide))
    output.print(summary(result), highlight=False, soft_wrap=True)
    _write(options, result, ring.recording if isinstance(ring, Ring) else None)
    if options.keep:
        if isinstance(ring, LiveRing):
            ring.go_on()
        errors.print(f"\nThe ring of run {run.id} stands. Try:", highlight=False)
        for purpose, command in hints(ring.overlay):
            errors.print(f"  [dim]# {escape(purpose)}[/dim]\n  {escape(command)}", highlight=False, soft_wrap=True)
    return PASSED if result.passed else FAILED


def _ring(options: Options, run: Run, reporter: ProgressReporter) -> Ring | LiveRing:
    if options.live is not None:
        return LiveRing(options, options.live, run, reporter)
    bag = options.bag
    if bag is None:
        duration_s = options.seconds or DEMO_S
        reporter.step(f"making a recording: {duration_s:g} seconds of a robot's drive")
        bag = make_demo(run, duration_s)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    return Ring(options, run, reporter, bag)


def _write(options: Options, result: Result, recording: Path | None = None) -> None:
    """Write the requested files; under sudo they belong to the invoking user."""
    if options.json is not None:
        options.json.write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
    person = os.environ.get("SUDO_UID"), os.environ.get("SUDO_GID")
    if os.getuid() == 0 and all(person):
        recorded = (options.out, recording) if options.out is not None else ()
        for made in (options.json, options.pcap, *recorded):
            if made is not None and made.exists():
                os.chown(made, int(person[0] or 0), int(person[1] or 0))


def _absolute(path: Path | None) -> Path | None:
    return path.expanduser().absolute() if path is not None else None


def _one_of(option: str, text: str, choices: tuple[T, ...]) -> T:
    for choice in choices:
        if choice == text:
            return choice
    raise LocalError(f"--{option} is one of {', '.join(map(str, choices))}, not {text!r}")
