"""Flood bench: effect of a stranger's flood of hellos on real nodes.

Three switches in a row, each a process in a namespace of its own. A topic goes from a member at the first to a member
at the last one. A stranger on the link between the first and the middle one replays hellos to the middle one, from
10,000 invented addresses. The hellos have certificates of its own (``fresh``), are recorded ones of members
(``recorded``), or have a member's certificate and a wrong signature (``wrong``). Broadcast data, which no switch reads,
is the control (``noise``): it disturbs only the machine, on which the flood takes a core.

The rate is ten times what this machine verifies in a second. Each flood is compared with a calm phase before it. At
the end of each phase the first switch is killed and started again. The figure is the time until it is a neighbour of
the middle one. Memory is that of the middle switch.

    sudo .venv/bin/python scripts/bench/security.py flood                        # an hour
    sudo .venv/bin/python scripts/bench/security.py flood --planes kernel --kinds fresh --seconds 5 --rounds 1 --no-save
"""

from __future__ import annotations

import argparse
import json
import re
import secrets
import statistics
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from faults.overlay import Overlay
from faults.plan import Flow, Plan
from faults.records import Kind as Happened
from machine import processor_s, resident_bytes
from peers.process import Started
from report import print_table, progress
from skeleton import new_run
from topologies import make_topology

from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import ECHO_BYTES, INCARNATION_BYTES, NONCE_BYTES, Hello
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.frame.codec import KIND_AT
from gdp.frame.kinds import Kind
from gdp.host import netns_files
from gdp.host.run_registry import Run, RunRegistry
from gdp.ports.rtnetlink import LinkMonitor
from gdp.stores.keyring import load_identity

__all__ = ["add_arguments", "run"]

GOAL_MEMORY_MIB: Final = 16.0
GOAL_GOODPUT: Final = 0.9
TIMES: Final = 10  # multiple of the rate that a core verifies
KINDS: Final = ("fresh", "recorded", "wrong", "noise")
SETTLE_S: Final = 6.0
FLOW: Final = Flow("/flood/good", "p", ("r",), reliable=False, hz=200.0, size=1_000)
_FRAMES: Final = 2_000
_LOST: Final = re.compile(r"neighbour lost port=")
_RESTART_S: Final = 12.0
_MTU: Final = 1_500
_VICTIM: Final = "s0"
_NEAR: Final = "s1"


@dataclass(frozen=True, slots=True)
class Phase:
    """What one phase showed.

    Args:
        goodput: delivered of published messages.
        core: share of a core that the switch in the middle took.
        restart_s: from the kill of a neighbour until it is a neighbour again.
        lost: neighbours that any switch lost.
        memory_mib: resident memory, at the end, of the middle switch.
        backlog_drops: frames of any link that this machine lost before any switch saw them: all namespaces share the
            queue of their processor (``net.core.netdev_max_backlog``). Where there are some, losses prove nothing.
        reached: frames a second that came into it by the link on which the flood comes.
        waited: seconds for which switches were ready to run and had no core, of each second, summed over all. Nothing
            that a switch does about a flood makes that less; the control shows how much of it is the machine's.
    """

    goodput: float
    core: float
    restart_s: float
    lost: int
    memory_mib: float
    backlog_drops: int
    waited: float
    reached: float


def plan() -> Plan:
    """Return three switches in a row with a member at each end."""
    topology, members = make_topology(
        {"home": (_VICTIM, _NEAR, "s2")}, {}, [f"{_NEAR}-{_VICTIM}", f"{_VICTIM}-s2"], (_VICTIM,),
        {"p": _NEAR, "r": "s2"},
    )  # fmt: skip
    return Plan(topology, members, flows=(FLOW,))


def verifications_hz() -> float:
    """Return how many signatures a core verifies in a second."""
    key, data, count = SigningKey.generate(), secrets.token_bytes(700), 2_000
    signature, begun_s = key.sign(data), time.process_time()
    for _ in range(count):
        key.public.verify(signature, data)
    return count / (time.process_time() - begun_s)


def hellos(kind: str, overlay: Overlay) -> list[bytes]:
    """Return frames of a flood."""
    directory = overlay.directory / "nodes"
    members = [load_identity(directory / f"switch-{each}", time.time()) for each in overlay.plan.switches]
    if kind == "fresh":
        now_s = int(time.time())
        authority = CertificateAuthority.create("stranger", SigningKey.generate(), Validity(now_s - 60, now_s + 86_400))
        members = [
            NodeKeys.generate(Role.PROXY, f"x{number}").join(authority, Validity(now_s - 60, now_s + 86_400))
            for number in range(_FRAMES // 10)
        ]
    key = SigningKey.generate() if kind == "wrong" else None
    frames = [frame for number in range(_FRAMES) for frame in _hello(members[number % len(members)], key)]
    if kind != "noise":
        return frames
    return [each[:KIND_AT] + bytes([Kind.DATA]) + each[KIND_AT + 1 :] for each in frames]


def _hello(member: Identity, key: SigningKey | None) -> list[bytes]:
    hello = Hello(
        nonce=secrets.token_bytes(NONCE_BYTES),
        sequence=1,
        heard=(secrets.token_bytes(ECHO_BYTES),),
        mtu=_MTU,
        digest=bytes(8),
        membership=member.membership,
        exchange_key=secrets.token_bytes(32),
        incarnation_id=secrets.token_bytes(INCARNATION_BYTES),
    )
    wire = hello.to_wire(member.name, key or member.key)
    return ControlFragmenter(member.name, secrets.randbits(64)).split(Kind.HELLO, wire, _MTU)


def waited_s(overlay: Overlay) -> float:
    """Return how long the good switches have waited for a core so far (schedstat, proc(5))."""
    pids = [overlay.pid(f"switch {node}") for node in (_VICTIM, _NEAR, "s2")]
    return sum(int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) for pid in pids) / 1e9


def backlog_drops() -> int:
    """Return how many frames processors have dropped so far, their queue being full; ``net/core/net-procfs.c``."""
    lines = Path("/proc/net/softnet_stat").read_text().splitlines()
    return sum(int(line.split()[1], 16) for line in lines)


def lost(overlay: Overlay) -> int:
    """Return how often any switch has lost a neighbour so far."""
    texts = [text for node in overlay.plan.switches for _, text in overlay.logs(f"switch {node}")]
    return sum(len(_LOST.findall(text)) for text in texts)


def counted(overlay: Overlay) -> tuple[int, int]:
    """Return how many messages were published and delivered since the last call."""
    seen = dict.fromkeys((Happened.PUBLISHED, Happened.DELIVERED), 0)
    for member in ("p", "r"):
        for _, records in overlay.read(member):
            for record in records:
                if record.kind in seen:
                    seen[Happened(record.kind)] += 1
    return seen[Happened.PUBLISHED], seen[Happened.DELIVERED]


def restart_s(overlay: Overlay) -> float:
    """Return the seconds until a neighbour on the flooded link is back; a switch logs what is up each half second."""

    def ups() -> int:
        return sum(text.count(f"neighbour up port={_NEAR}") for _, text in overlay.logs(f"switch {_VICTIM}"))

    before, begun_s = ups(), time.monotonic()
    overlay.kill(f"switch {_NEAR}")
    overlay.restart(f"switch {_NEAR}")
    while ups() == before:
        if time.monotonic() > begun_s + _RESTART_S:
            break
        time.sleep(0.05)
    took_s = time.monotonic() - begun_s
    overlay.await_ready(f"switch {_NEAR}")
    return took_s


def phase(overlay: Overlay, seconds: float) -> Phase:
    """Run one phase, with a flood or without."""
    pid = overlay.pid(f"switch {_VICTIM}")
    before_reached = overlay.received(_VICTIM, [_NEAR])[_NEAR]
    counted(overlay)
    before_s, before_lost, begun_s = processor_s(pid), lost(overlay), time.monotonic()
    before_drops, before_waited_s = backlog_drops(), waited_s(overlay)
    time.sleep(seconds)
    took_s = time.monotonic() - begun_s
    core, waited = (processor_s(pid) - before_s) / took_s, (waited_s(overlay) - before_waited_s) / took_s
    memory = resident_bytes(pid) / (1 << 20)
    reached = (overlay.received(_VICTIM, [_NEAR])[_NEAR] - before_reached) / took_s
    published, delivered = counted(overlay)
    time.sleep(1.0)  # a switch logs what it lost each half second
    losses = lost(overlay) - before_lost
    for node in overlay.plan.switches if losses else ():
        progress(f"{node}:\n{overlay.log_tail(f'switch {node}', 6)}")
    drops = backlog_drops() - before_drops
    return Phase(delivered / max(published, 1), core, restart_s(overlay), losses, memory, drops, waited, reached)


def measure(
    runs: RunRegistry, plane: str, kinds: Sequence[str], seconds: float, rate: float, rounds: int, *, spoof: bool
) -> dict[str, list[dict[str, Phase]]]:
    """Return the phases of each round by kind of flood, calm and flooded."""
    with new_run(runs) as run, Overlay(run, plan(), plane=plane) as overlay:
        overlay.start_all()
        time.sleep(SETTLE_S)
        found: dict[str, list[dict[str, Phase]]] = {kind: [] for kind in kinds}
        for number in range(rounds):
            for kind in kinds:
                progress(f"{plane}, {kind}, round {number + 1}")
                calm = phase(overlay, seconds)
                time.sleep(SETTLE_S)
                with _flooding(run, overlay, kind, rate, seconds + 1 + _RESTART_S, spoof=spoof) as flood:
                    flooded = phase(overlay, seconds)
                    said = flood.read(_RESTART_S + 30)
                    progress(f"{float(str(said['sent'])) / float(str(said['seconds'])):,.0f} frames a second")
                    found[kind].append({"calm": calm, "flooded": flooded})
                time.sleep(SETTLE_S)
        return found


@contextmanager
def _flooding(run: Run, overlay: Overlay, kind: str, rate: float, seconds: float, *, spoof: bool) -> Iterator[Started]:
    """Run a flood."""
    path = run.directory / f"{kind}.frames"
    path.write_bytes(b"".join(struct.pack("!I", len(frame)) + frame for frame in hellos(kind, overlay)))
    orders = {
        "iface": _VICTIM, "frames": str(path), "rate": rate, "seconds": seconds,
        "source": _address_of(overlay) if spoof else "",
    }  # fmt: skip
    with overlay.start_other(_NEAR, f"flood {kind}", ["-m", "faults.hello_flood", json.dumps(orders)]) as flood:
        flood.read(30)
        yield flood


def _address_of(overlay: Overlay) -> str:
    """Return the address of the neighbour's device on the flooded link."""
    return netns_files.inside(overlay.spaces.path(_NEAR), _own_address).hex()


def _own_address() -> bytes:
    with closing(LinkMonitor()) as links:
        link = links.get(_VICTIM)
    assert link is not None
    return link.mac


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--planes", nargs="+", default=["raw", "kernel"])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=10.0, help="of each phase (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rate", type=float, help="frames a second (default: ten times what a core verifies)")
    parser.add_argument("--spoof", action="store_true", help="under the address of the neighbour on that link")


def run(options: argparse.Namespace) -> tuple[dict[str, object], bool]:
    """Measure every plane with every kind of flood; return the figures, and whether the targets were met."""
    runs = RunRegistry()
    runs.sweep()
    verified = verifications_hz()
    rate = options.rate or TIMES * verified
    headers = ("goodput, ratio", "lost", "memory, MiB", "core", "restart, s", "backlog drops", "waited", "reached")
    rows = list[tuple[str, ...]]()
    saved: dict[str, object] = {"verified_hz": verified, "rate_hz": rate}
    has_met = True
    for plane in options.planes:
        found = measure(runs, plane, options.kinds, options.seconds, rate, options.rounds, spoof=options.spoof)
        for kind, rounds in found.items():
            rows.append((plane, kind, *_row(rounds)))
            has_met = has_met and (kind == "noise" or _has_met(rounds))
        saved[plane] = {
            kind: [{name: asdict(each) for name, each in pair.items()} for pair in rounds]
            for kind, rounds in found.items()
        }
    print_table(("plane", "flood", *headers), rows, title=f"{rate:,.0f} frames a second", words=2)
    return saved, has_met


def _ratios(rounds: Sequence[dict[str, Phase]]) -> list[float]:
    return [each["flooded"].goodput / max(each["calm"].goodput, 1e-9) for each in rounds]


def _grown_mib(rounds: Sequence[dict[str, Phase]]) -> float:
    return max(each["flooded"].memory_mib - each["calm"].memory_mib for each in rounds)


def _has_met(rounds: Sequence[dict[str, Phase]]) -> bool:
    is_lossless = not any(each["flooded"].lost for each in rounds)
    return is_lossless and statistics.median(_ratios(rounds)) >= GOAL_GOODPUT and _grown_mib(rounds) <= GOAL_MEMORY_MIB


def _row(rounds: Sequence[dict[str, Phase]]) -> list[str]:
    ratios, grown = _ratios(rounds), _grown_mib(rounds)
    losses = [sum(each[name].lost for each in rounds) for name in ("calm", "flooded")]
    cores = [statistics.median(each[name].core for each in rounds) for name in ("calm", "flooded")]
    waits = [statistics.median(each[name].waited for each in rounds) for name in ("calm", "flooded")]
    restarts = [statistics.median(each[name].restart_s for each in rounds) for name in ("calm", "flooded")]
    return [
        f"{statistics.median(ratios):.3f} ({min(ratios):.3f}-{max(ratios):.3f}), to reach {GOAL_GOODPUT}",
        f"{losses[0]} -> {losses[1]}, to reach 0",
        f"{grown:+.1f}, at most +{GOAL_MEMORY_MIB:g}",
        f"{cores[0]:.2f} -> {cores[1]:.2f}",
        f"{restarts[0]:.1f} -> {restarts[1]:.1f}",
        " ".join(str(each["flooded"].backlog_drops) for each in rounds),
        f"{waits[0]:.2f} -> {waits[1]:.2f}",
        " -> ".join(f"{statistics.median(each[name].reached for each in rounds):,.0f}" for name in ("calm", "flooded")),
    ]
