"""Tunnel bench: images and a small round trip over one tunnel, compared with plain TCP and UDP in the same WireGuard.

Four machines in namespaces, A - s1 = s2 - B. Between the switches is a cable; on it WireGuard, and in that a VXLAN port
of each switch. On the same devices, one after the other, round by round:

    gdp         members at A and B: encrypted, signed, verified, reliable; through both switches
    plain       TCP and UDP between the WireGuard devices of s1 and s2, without anything else

WireGuard is the kernel's, or wireguard-go where it has none; the record says which. Both cores of a small machine are
busy then, and ours also encrypts end to end. Targets: goodput at least 0.9 of TCP, round trip at most 1.5 of UDP.

    sudo .venv/bin/python scripts/bench/tunnel.py                     # the whole; writes docs/benchmarks/tunnel.*
    sudo .venv/bin/python scripts/bench/tunnel.py --quick --no-save   # a few seconds: does it work?
    sudo .venv/bin/python scripts/bench/tunnel.py --only raw --no-save
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Final

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from peers.process import FailedError, Started
from plot import Panel, panel_of
from report import Target, percentile
from skeleton import Options, Outcome, Recorder, Trial, command_line, new_run, run_bench
from testbed import Lab, MemberRow
from topologies import flat_topology
from tunnel_endpoint import IMAGES, PING, PONG

from gdp.host.run_registry import Run, RunRegistry
from gdp.nodes.busy_poll import SPIN_US
from gdp.trust.right import Right

PLANES: Final = ("kernel", "raw")
SWITCHES: Final = ("s1", "s2")
MTU: Final = 1_500
PLAIN: Final = "plain"
GOODPUT: Final = "images, MB/s"
RTT: Final = "100 B round trip p50, us"
P99: Final = "100 B round trip p99, us"
CASE: Final = "one tunnel"
READY_S: Final = 30.0
_MODULE: Final = "tunnel_endpoint"
_TOPICS: Final = {
    "a": {Right.PUBLISH: (IMAGES, PING), Right.READ: (PONG,)},
    "b": {Right.PUBLISH: (PONG,), Right.READ: (IMAGES, PING)},
}


def label_of(plane: str) -> str:
    """Return the name of ours with a data plane."""
    return f"gdp, {plane}"


class TunnelLab:
    """Machines of the bench, with the tunnel between the switches."""

    def __init__(self, run: Run) -> None:
        links = (("a", "s1"), ("s1", "s2"), ("s2", "b"))
        topology = flat_topology(links, mtu=MTU, rib="s1", members=("a", "b"), switches=("a", *SWITCHES, "b"))
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
            }
            for at in range(2)
        ]

    def start(self, at: int, role: str, *, has_orders: bool = False, **settings: float) -> Started:
        """Start a plain role at a switch."""
        words = ["-m", _MODULE, role, json.dumps({**self.ends[at], **settings})]
        return self.lab.start(SWITCHES[at], role, words, has_orders=has_orders)


@contextmanager
def tunnel_lab(run: Run) -> Iterator[tuple[TunnelLab, str]]:
    """Make machines and tunnel until the context ends; yield them with the kind of WireGuard."""
    lab = TunnelLab(run)
    with ExitStack() as stack:
        owners = [stack.enter_context(lab.start(at, "device", has_orders=True)) for at in range(2)]
        said = [each.read(READY_S) for each in owners]
        yield lab, str(said[0]["backend"])


def number_of(said: dict[str, object], key: str) -> float:
    """Return a number of a reply. Raises ``FailedError``: it has none."""
    value = said.get(key)
    if not isinstance(value, float):
        raise FailedError(f"expected {key}, not {said}")
    return value


def round_trip(said: dict[str, object]) -> dict[str, float]:
    """Return the figures of the round trips of a reply. Raises ``FailedError``: it has none."""
    times_s = said.get("times_s")
    if not isinstance(times_s, list) or not times_s:
        raise FailedError(f"expected times_s, not {said}")
    times_us = [1e6 * each for each in times_s]
    return {RTT: percentile(times_us, 0.5), P99: percentile(times_us, 0.99)}


def measure_plain(lab: TunnelLab, seconds: float) -> dict[str, float]:
    """Return the figures of TCP and UDP between the WireGuard devices."""
    with lab.start(1, "tcp-read") as reader:
        reader.read(READY_S)
        with lab.start(0, "tcp-images", seconds=seconds) as sender:
            sender.read(READY_S + seconds)
        goodput = number_of(reader.read(READY_S), "bytes_s") / 1e6
    with lab.start(1, "udp-echo") as echo:
        echo.read(READY_S)
        with lab.start(0, "udp-ping", seconds=seconds) as probe:
            return {GOODPUT: goodput, **round_trip(probe.read(READY_S + seconds))}


def measure_ours(lab: TunnelLab, plane: str, options: Options) -> dict[str, float]:
    """Return the figures of members through switches with this data plane."""
    spin_s = options.busy_poll_us / 1e6
    with ExitStack() as stack:
        members = stack.enter_context(MemberRow(lab.lab, _MODULE, _TOPICS, plane=plane, switches=SWITCHES))
        stack.enter_context(members.endpoint("b", "read", spin_s=spin_s)).read(READY_S)
        with members.endpoint("a", "images", seconds=options.seconds, spin_s=spin_s) as sender:
            goodput = number_of(sender.read(READY_S + 2 * options.seconds), "bytes_s") / 1e6
        with members.endpoint("a", "ping", seconds=options.seconds, spin_s=spin_s) as probe:
            return {GOODPUT: goodput, **round_trip(probe.read(READY_S + options.seconds))}


def trials_of(lab: TunnelLab, planes: Sequence[str], options: Options) -> list[Trial]:
    """Return the trials of one round: the plain protocols, then ours on each data plane."""
    columns = (GOODPUT, RTT, P99)
    plain = Trial(CASE, PLAIN, columns, lambda _: measure_plain(lab, options.seconds))
    return [plain, *(Trial(CASE, label_of(each), columns, partial(_ours, lab, each, options)) for each in planes)]


def _ours(lab: TunnelLab, plane: str, options: Options, _: int) -> dict[str, float]:
    return measure_ours(lab, plane, options)


def targets_of(recorder: Recorder, planes: Sequence[str]) -> list[Target]:
    """Return the ratios to the plain protocols, round by round."""
    targets = []
    for plane in planes:
        ours, over = label_of(plane), recorder.rounds
        targets.append(over.ratio(f"{ours}: goodput of images / TCP", ours, PLAIN, CASE, GOODPUT, 0.9))
        targets.append(over.ratio(f"{ours}: round trip / UDP", ours, PLAIN, CASE, RTT, 1.5, at_most=True))
    return targets


def panels_of(recorder: Recorder, planes: Sequence[str]) -> list[Panel]:
    """Return a panel for each figure."""
    ours = [label_of(plane) for plane in planes]
    return [
        panel_of(recorder.rounds, CASE, GOODPUT, [*ours, PLAIN], ours=ours),
        panel_of(recorder.rounds, CASE, RTT, [*ours, PLAIN], p99=P99, ours=ours),
    ]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure plain protocols and ours on the same tunnel, round by round."""
    recorder, planes, backends = Recorder(), tuple(options.only or PLANES), set[str]()
    for number in range(1, options.rounds + 1):
        with new_run(runs) as run, tunnel_lab(run) as (lab, backend):
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
