"""How many frames a second pass three switches, and how long a round trip takes: raw and scapy, side by side.

    sudo .venv/bin/python scripts/bench/forwarding.py [--json FILE] [--frame-bytes 1400] [--mtu 1500] [--plane raw ...]

Five namespaces in a chain (A - S1 - S2 - S3 - B) joined by veth pairs, one process in each: a source, three switches
with a static table, a sink. The figure is the highest rate at which the sink gets all but 0.5 % of the frames *and* the
last one comes within 0.1 s of the last sending: a rate that only fills queues does not count. A rate that fails is
tried once more, because whatever else a machine does can spoil a single try. Round trips are then taken of single
frames of 100 bytes payload, by ends that sleep in epoll as real ones do (with fewer cores than processes, ends that
spin would take the switches' time). Everything made is removed, whatever happens.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

from pyroute2 import NetNS, netns

NODES = ("a", "s1", "s2", "s3", "b")
LOSS_MAX = 0.005
LATE_MAX_S = 0.1
OVERHEAD_BYTES = 110


def mac(node: int, side: str) -> str:
    return f"02:00:00:00:{node:02x}:{1 if side == 'left' else 2:02x}"


class Chain:
    """The five namespaces; a context manager."""

    def __init__(self, mtu: int) -> None:
        self.names = [f"gdp-bench-{os.getpid()}-{node}" for node in NODES]
        self.mtu = mtu

    def __enter__(self) -> Chain:
        try:
            for name in self.names:
                netns.create(name)
            for at, (name, beyond) in enumerate(pairwise(self.names)):
                peer = {"ifname": "left", "net_ns_fd": beyond, "address": mac(at + 1, "left"), "mtu": self.mtu}
                with NetNS(name) as here:
                    here.link("add", ifname="right", kind="veth", address=mac(at, "right"), mtu=self.mtu, peer=peer)
            for name in self.names:
                with NetNS(name) as here:
                    for link in here.get_links():
                        here.link("set", index=link["index"], state="up")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for name in self.names:
            if Path("/run/netns", name).exists():
                netns.remove(name)


class Process:
    """One role in one namespace, asked by lines; a context manager that ends it."""

    def __init__(self, chain: Chain, node: int, role: str, **settings: Any) -> None:
        macs = {"left": mac(node - 1, "right"), "right": mac(node + 1, "left")}  # the neighbours' addresses
        macs = {side: text.replace(":", "") for side, text in macs.items() if 0 <= node + (1, -1)[side == "left"] < 5}
        arguments = {"namespace": chain.names[node], "role": role, "macs": macs, **settings}
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("roles.py")), json.dumps(arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("a process of the benchmark ended early; see above")
        return dict(json.loads(line))

    def ask(self, **values: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(values) + "\n")
        self._process.stdin.flush()
        return self.read()


def attempt(source: Process, sink: Process, rate: float, seconds: float) -> dict[str, float]:
    """Send at one rate, again if it does not hold; return what came of it."""
    tried = once(source, sink, rate, seconds)
    return tried if holds(tried, rate) else once(source, sink, rate, seconds)


def once(source: Process, sink: Process, rate: float, seconds: float) -> dict[str, float]:
    sink.ask(silence_s=0.05)
    sent = source.ask(do="send", rate=rate, seconds=seconds)
    got = sink.ask(silence_s=0.5)
    span = sent["end_s"] - sent["start_s"]
    return {
        "rate": sent["sent"] / span,
        "loss": 1 - got["got"] / sent["sent"],
        "late_s": got["last_s"] - sent["end_s"],
        "sink_drops": got["kernel_drops"],
    }


def holds(tried: dict[str, float], rate: float) -> bool:
    return tried["loss"] < LOSS_MAX and tried["late_s"] < LATE_MAX_S and tried["rate"] > 0.95 * rate


def highest(source: Process, sink: Process, guess: float, seconds: float, steps: int) -> dict[str, float]:
    """Find the highest rate that holds: step up or down to bracket it, then bisect."""
    low, high, best = 0.0, 0.0, {"rate": 0.0, "loss": 1.0, "late_s": 0.0, "sink_drops": 0.0}
    rate = guess
    for _ in range(12):
        tried = attempt(source, sink, rate, seconds)
        if holds(tried, rate):
            low, best = rate, tried
            if high:
                break
            rate *= 1.6
        else:
            high = rate
            if low:
                break
            rate /= 1.6
    for _ in range(steps):
        rate = (low + high) / 2
        tried = attempt(source, sink, rate, seconds)
        if holds(tried, rate):
            low, best = rate, tried
        else:
            high = rate
    return best


def measure(chain: Chain, plane: str, options: argparse.Namespace) -> dict[str, Any]:
    payload = options.frame_bytes - OVERHEAD_BYTES
    guess, pings = (80_000.0, 2_000) if plane == "raw" else (1_500.0, 200)
    with ExitStack() as stack:
        switches = [stack.enter_context(Process(chain, node, "switch", plane_kind=plane)) for node in (1, 2, 3)]
        source = stack.enter_context(Process(chain, 0, "source", payload_bytes=payload))
        with Process(chain, 4, "sink") as sink:
            for process in (*switches, source, sink):
                process.read()
            best = highest(source, sink, guess, options.seconds, options.steps)
            before = switches[1].ask()
            again = attempt(source, sink, best["rate"] * 0.9, options.seconds)
            after = switches[1].ask()
        with Process(chain, 4, "echo") as echo:
            echo.read()
            times = sorted(source.ask(do="ping", count=pings, payload_bytes=100)["rtt_us"])
    frames = after["forwarded"] - before["forwarded"]
    return {
        "plane": plane,
        "frames_per_s": round(best["rate"]),
        "loss": round(max(0.0, best["loss"]), 5),
        "gbit_per_s": round(best["rate"] * options.frame_bytes * 8 / 1e9, 3),
        "loss_at_90_percent": round(max(0.0, again["loss"]), 5),
        "switch_cpu_us_per_frame": round((after["cpu_s"] - before["cpu_s"]) / max(frames, 1) * 1e6, 2),
        "switch_rss_mib": round(after["rss_mib"], 1),
        "rtt_us": {
            "median": round(statistics.median(times), 1) if times else None,
            "p99": round(times[int(len(times) * 0.99)], 1) if times else None,
            "answered": len(times),
            "asked": pings,
        },
    }


def offloads(chain: Chain) -> str:
    shown = subprocess.run(
        ["ip", "-n", chain.names[0], "-d", "link", "show", "right"], capture_output=True, text=True, check=False
    ).stdout
    words = shown.split()
    return " ".join(f"{key}={words[words.index(key) + 1]}" for key in ("gso_max_size", "gro_max_size") if key in words)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    parser.add_argument("--plane", choices=("raw", "scapy"), action="append", help="only this plane (default: both)")
    parser.add_argument("--frame-bytes", type=int, default=1400, help="whole frame, Ethernet header included")
    parser.add_argument("--mtu", type=int, default=1500)
    parser.add_argument("--seconds", type=float, default=2.0, help="length of one try")
    parser.add_argument("--steps", type=int, default=5, help="bisections")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was made is removed
    planes = options.plane or ["raw", "scapy"]
    with Chain(options.mtu) as chain:
        result: dict[str, Any] = {
            "kernel": platform.release(),
            "python": platform.python_version(),
            "cores": len(os.sched_getaffinity(0)),
            "mtu": options.mtu,
            "frame_bytes": options.frame_bytes,
            "offloads": offloads(chain),
            "load_before": os.getloadavg()[0],
            "planes": [measure(chain, plane, options) for plane in planes],
        }
    rates = {one["plane"]: one["frames_per_s"] for one in result["planes"]}
    if len(rates) == 2:
        result["raw_over_scapy"] = round(rates["raw"] / max(rates["scapy"], 1), 1)
    show(result)
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


def show(result: dict[str, Any]) -> None:
    print(
        f"kernel {result['kernel']}, Python {result['python']}, {result['cores']} cores,"
        f" load {result['load_before']:.2f}, MTU {result['mtu']}, frames of {result['frame_bytes']} bytes,"
        f" veth {result['offloads']}"
    )
    heads = f"{'plane':8}{'frames/s':>10}{'Gbit/s':>8}{'loss':>8}{'RTT µs':>9}{'p99':>8}"
    print(f"{heads}{'CPU µs/frame':>14}{'RSS MiB':>9}")
    for one in result["planes"]:
        rtt = one["rtt_us"]
        print(
            f"{one['plane']:8}{one['frames_per_s']:>10}{one['gbit_per_s']:>8}{one['loss']:>8.3%}{rtt['median']!s:>9}"
            f"{rtt['p99']!s:>8}{one['switch_cpu_us_per_frame']:>14}{one['switch_rss_mib']:>9}"
        )
    if "raw_over_scapy" in result:
        print(f"raw carries {result['raw_over_scapy']} times what scapy carries")


if __name__ == "__main__":
    main()
