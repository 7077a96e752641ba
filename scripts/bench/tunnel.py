"""Tunnel bench: images and a small round trip over one tunnel, compared with plain TCP and UDP in the same WireGuard.

Four machines in namespaces, A - s1 = s2 - B. Between the switches is a cable; on it WireGuard, and in that a VXLAN port
of each switch. On the same devices, one after the other, round by round:

    gdp              members at A and B: encrypted and authenticated end to end, reliable; through both switches
    gdp, no tunnel   the same members, with the bare cable as the link of the switches: what the tunnel adds
    plain            TCP and UDP between A and B, which s1 and s2 route through the WireGuard devices
    plain, inside    TCP and UDP between the WireGuard devices themselves, which no other machine could use

Plain protocols neither encrypt nor sign end to end: s1 and s2 read them. The plain route has no VXLAN either. WireGuard
is the kernel's, or wireguard-go where it has none; the record says which. Targets: goodput at least 0.9 of TCP, round
trip at most 1.5 of UDP, with the same ends. Processor time of all processes explains what the cores of the machine
allow.

    sudo .venv/bin/python scripts/bench/tunnel.py                     # the whole; writes docs/benchmarks/tunnel.*
    sudo .venv/bin/python scripts/bench/tunnel.py --quick --no-save   # a few seconds: does it work?
    sudo .venv/bin/python scripts/bench/tunnel.py --only raw --no-save
"""

from __future__ import annotations

import json
import os
import socket
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from machine import processor_s
from peers.process import FailedError, Started
from plot import Panel, panel_of
from report import Target, percentile
from skeleton import Options, Outcome, Recorder, Trial, command_line, new_run, run_bench
from testbed import Lab, MemberRow
from topologies import flat_topology
from tunnel_endpoint import IMAGES, PING, PONG

from gdp.host.run_registry import Run, RunRegistry
from gdp.ports.tunnel.uapi import socket_path
from gdp.runtime.busy_poll import SPIN_US
from gdp.trust.right import Right

PLANES: Final = ("kernel", "raw")
SWITCHES: Final = ("s1", "s2")
MEMBERS: Final = ("a", "b")
MTU: Final = 1_500
PLAIN: Final = "plain"
INSIDE: Final = "plain, inside"
NO_TUNNEL: Final = "gdp, no tunnel"
GOODPUT: Final = "images, MB/s"
CPU: Final = "CPU, ms/MB"
WIREGUARD: Final = "of it WireGuard"
AGAIN: Final = "sent again, %"
RTT: Final = "100 B round trip p50, us"
P99: Final = "100 B round trip p99, us"
CASE: Final = "one tunnel"
READY_S: Final = 30.0
_CREDENTIALS: Final = struct.Struct("=iII")  # process, user and group: unix(7), SO_PEERCRED
_MODULE: Final = "tunnel_endpoint"
_TOPICS: Final = {
    "a": {Right.PUBLISH: (IMAGES, PING), Right.READ: (PONG,)},
    "b": {Right.PUBLISH: (PONG,), Right.READ: (IMAGES, PING)},
}


def label_of(plane: str) -> str:
    """Return the name of ours with a data plane."""
    return f"gdp, {plane}"


class TunnelLab:
    """Machines of the bench; ``tunnel`` leads the link of the switches through WireGuard."""

    def __init__(self, run: Run) -> None:
        links = (("a", "s1"), ("s1", "s2"), ("s2", "b"))
        topology = flat_topology(links, mtu=MTU, rib="s1", members=MEMBERS, switches=("a", *SWITCHES, "b"))
        self.lab = Lab(run, topology)
        keys = [X25519PrivateKey.generate() for _ in SWITCHES]
        tag = os.urandom(3).hex()
        self.ends = [
            {
                "iface": SWITCHES[1 - at],
                "ifname": f"w{tag}{at}",
                "key": keys[at].private_bytes_raw().hex(),
                "peer_key": keys[1 - at].public_key().public_bytes_raw().hex(),
                "address": f"10.9.0.{1 + at}",
                "peer_address": f"10.9.0.{2 - at}",
                "inner": f"fd00::{1 + at}",
                "peer_inner": f"fd00::{2 - at}",
                "member": MEMBERS[at],
                "member_network": f"10.{1 + at}.0",
                "peer_network": f"10.{2 - at}.0",
            }
            for at in range(2)
        ]

    @contextmanager
    def tunnel(self) -> Iterator[str]:
        """Make the tunnel, and a route for A and B through it, until the context ends; yield the kind of WireGuard."""
        with ExitStack() as stack:
            owners = [stack.enter_context(self.start(at, "device", has_orders=True)) for at in range(2)]
            said = [each.read(READY_S) for each in owners]
            for at, member in enumerate(MEMBERS):
                with self.start(at, "route", node=member) as route:
                    route.read(READY_S)
            yield str(said[0]["backend"])

    def start(
        self, at: int, role: str, *, node: str = "", has_orders: bool = False, **settings: str | float
    ) -> Started:
        """Start a plain role for an end of the tunnel, at its switch or at another node."""
        words = ["-m", _MODULE, role, json.dumps({**self.ends[at], **settings})]
        return self.lab.start(node or SWITCHES[at], role, words, has_orders=has_orders)

    def wireguard_s(self) -> float:
        """Return the processor time of both wireguard-go in seconds; 0 with WireGuard of the kernel."""
        return sum(processor_s(_server_of(end["ifname"])) for end in self.ends if socket_path(end["ifname"]).exists())


def _server_of(ifname: str) -> int:
    with socket.socket(socket.AF_UNIX) as probe:
        probe.connect(str(socket_path(ifname)))
        held = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(held)[0])


def number_of(said: dict[str, object], key: str) -> float:
    """Return a number of a reply. Raises ``FailedError``: it has none."""
    value = said.get(key)
    if not isinstance(value, float):
        raise FailedError(f"expected {key}, not {said}")
    return value


def goodput(said: dict[str, object], cpu_s: float, wireguard_s: float) -> dict[str, float]:
    """Return the figures of the images of a reply.

    Args:
        cpu_s: processor time of the other processes, WireGuard's included.
        wireguard_s: that of WireGuard.
    """
    megabytes = number_of(said, "bytes") / 1e6
    return {
        GOODPUT: megabytes / number_of(said, "seconds"),
        CPU: 1e3 * (number_of(said, "cpu_s") + cpu_s) / megabytes,
        WIREGUARD: 1e3 * wireguard_s / megabytes,
    }


def round_trip(said: dict[str, object]) -> dict[str, float]:
    """Return the figures of the round trips of a reply. Raises ``FailedError``: it has none."""
    times_s = said.get("times_s")
    if not isinstance(times_s, list) or not times_s:
        raise FailedError(f"expected times_s, not {said}")
    times_us = [1e6 * each for each in times_s]
    return {RTT: percentile(times_us, 0.5), P99: percentile(times_us, 0.99)}


def measure_plain(lab: TunnelLab, seconds: float, *, is_inside: bool) -> dict[str, float]:
    """Return the figures of TCP and UDP between A and B, or inside: between the WireGuard devices."""
    one, two = ("", "") if is_inside else MEMBERS
    server = lab.ends[1]["inner"] if is_inside else f"{lab.ends[1]['member_network']}.2"
    before_s = lab.wireguard_s()
    with lab.start(1, "tcp-read", node=two, server=server) as reader:
        reader.read(READY_S)
        with lab.start(0, "tcp-images", node=one, server=server, seconds=seconds) as sender:
            sender_s = number_of(sender.read(READY_S + seconds), "cpu_s")
        said = reader.read(READY_S)
    wireguard_s = lab.wireguard_s() - before_s
    figures = goodput(said, sender_s + wireguard_s, wireguard_s)
    with lab.start(1, "udp-echo", node=two, server=server) as echo:
        echo.read(READY_S)
        with lab.start(0, "udp-ping", node=one, server=server, seconds=seconds) as probe:
            return {**figures, **round_trip(probe.read(READY_S + seconds))}


def measure_ours(lab: TunnelLab, plane: str, options: Options) -> dict[str, float]:
    """Return the figures of members through switches with this data plane."""
    spin_s = options.busy_poll_us / 1e6
    with ExitStack() as stack:
        members = stack.enter_context(MemberRow(lab.lab, _MODULE, _TOPICS, plane=plane, switches=SWITCHES))
        reader = stack.enter_context(members.endpoint("b", "read", spin_s=spin_s))
        reader.read(READY_S)
        others = [reader.pid, *(each.pid for each in members.switches)]
        before_s, wireguard_before_s = sum(map(processor_s, others)), lab.wireguard_s()
        with members.endpoint("a", "images", seconds=options.seconds, spin_s=spin_s) as sender:
            said = sender.read(READY_S + 2 * options.seconds)
        wireguard_s = lab.wireguard_s() - wireguard_before_s
        figures = goodput(said, sum(map(processor_s, others)) - before_s + wireguard_s, wireguard_s)
        figures[AGAIN] = 100 * number_of(said, "again")
        with members.endpoint("a", "ping", seconds=options.seconds, spin_s=spin_s) as probe:
            return {**figures, **round_trip(probe.read(READY_S + options.seconds))}


def trials_of(lab: TunnelLab, planes: Sequence[str], options: Options) -> list[Trial]:
    """Return the trials of one round in the tunnel: the plain protocols, then ours on each data plane."""
    ours = [_ours(lab, label_of(each), each, options) for each in planes]
    return [_plain(lab, PLAIN, options, is_inside=False), _plain(lab, INSIDE, options, is_inside=True), *ours]


def _plain(lab: TunnelLab, label: str, options: Options, *, is_inside: bool) -> Trial:
    columns = (GOODPUT, CPU, WIREGUARD, RTT, P99)
    return Trial(CASE, label, columns, lambda _: measure_plain(lab, options.seconds, is_inside=is_inside))


def _ours(lab: TunnelLab, label: str, plane: str, options: Options) -> Trial:
    columns = (GOODPUT, CPU, WIREGUARD, AGAIN, RTT, P99)
    return Trial(CASE, label, columns, lambda _: measure_ours(lab, plane, options))


def targets_of(recorder: Recorder, planes: Sequence[str]) -> list[Target]:
    """Return the ratios to the plain protocols, round by round."""
    targets, over = [], recorder.rounds
    for ours in map(label_of, planes):
        targets.append(over.ratio(f"{ours}: goodput of images / TCP", ours, PLAIN, CASE, GOODPUT, 0.9))
        targets.append(over.ratio(f"{ours}: round trip / UDP", ours, PLAIN, CASE, RTT, 1.5, at_most=True))
    ours = label_of(planes[0])
    targets.append(over.ratio(f"{ours}: goodput / TCP inside", ours, INSIDE, CASE, GOODPUT, None))
    targets.append(over.ratio(f"{ours}: round trip / UDP inside", ours, INSIDE, CASE, RTT, None, at_most=True))
    targets.append(over.ratio(f"{ours}: processor time / TCP", ours, PLAIN, CASE, CPU, None, at_most=True))
    targets.append(over.difference(f"{ours}: round trip, added by the tunnel, us", ours, NO_TUNNEL, CASE, RTT, None))
    return targets


def panels_of(recorder: Recorder, planes: Sequence[str]) -> list[Panel]:
    """Return a panel for each figure."""
    ours = [NO_TUNNEL, *(label_of(plane) for plane in planes)]
    rows = [*ours, PLAIN, INSIDE]
    return [
        panel_of(recorder.rounds, CASE, GOODPUT, rows, ours=ours),
        panel_of(recorder.rounds, CASE, CPU, rows, ours=ours),
        panel_of(recorder.rounds, CASE, RTT, rows, p99=P99, ours=ours),
    ]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure plain protocols and ours on the same tunnel, round by round."""
    recorder, planes, backends = Recorder(), tuple(options.only or PLANES), set[str]()
    for number in range(1, options.rounds + 1):
        with new_run(runs) as run:
            lab = TunnelLab(run)
            recorder.attempt(_ours(lab, NO_TUNNEL, planes[0], options), number, options.rounds)
            with lab.tunnel() as backend:
                backends.add(backend)
                for trial in trials_of(lab, planes, options):
                    recorder.attempt(trial, number, options.rounds)
    return Outcome(
        "tunnel",
        "Images of 921,600 bytes and a round trip of 100 bytes over one tunnel",
        recorder.rounds,
        targets_of(recorder, planes),
        {
            "rounds": options.rounds,
            "seconds of each figure": options.seconds,
            "WireGuard": ", ".join(sorted(backends)),
            "MTU of the cable": MTU,
            "ends spin, us": options.busy_poll_us,
            "trouble": recorder.notes or "none",
        },
        lambda: panels_of(recorder, planes),
    )


if __name__ == "__main__":
    parser = command_line(
        __doc__, rounds=5, seconds=5.0, quick={"rounds": 1, "seconds": 1.0}, has_record=True, has_plot=True
    )
    parser.add_argument("--only", action="append", choices=PLANES, help="this data plane")
    parser.add_argument(
        "--busy-poll-us", type=int, default=SPIN_US, help="as busy_poll_us of proxy.yaml (default: %(default)s)"
    )
    run_bench(parser, measure)
