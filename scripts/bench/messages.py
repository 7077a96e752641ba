"""Message bench: time of a message over three machines and a small answer back, compared with Zenoh and Cyclone DDS.

Five machines in namespaces, A - s1 - s2 - s3 - B, and in turn on them, round by round:

    gdp-kernel, gdp-raw   switches, RIB and two members: encrypted, signed, verified, reliable; in json, cbor and cdr
    gdp-kernel-unicast    the same as a request to one server and its response, without the library
    gdp-kernel-session    the same under ``sign: session``: a key of the two ends, no signature
    zenoh-mtls            three routers; mutual TLS on every hop
    zenoh-tcp             the same without TLS
    cyclone               Cyclone DDS, unsecured, reliable; the three forward IPv4 in the kernel

    sudo .venv/bin/python scripts/bench/messages.py                     # the whole; writes docs/benchmarks/messages.*
    sudo .venv/bin/python scripts/bench/messages.py --quick             # one round of few messages: does it work?
    sudo .venv/bin/python scripts/bench/messages.py --only gdp-raw --only zenoh-mtls --mtu 1500 --size 921600
    sudo .venv/bin/python scripts/bench/messages.py --load half         # other processes take half of each core

Messages go one at a time, as in a control loop. A figure of a round is the median (or p99) of its messages. The table
shows the median of the rounds, and in brackets their lowest and highest. Only the whole bench writes under
docs/benchmarks by itself; a part of it writes to the paths of --json and --plot.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Final

from background_load import LOADS, SHARE
from peers.exchange import ANSWER, SIZE_MIN, Load
from peers.rounds import MEDIAN, P99, Plan, Turns, case_of, targets_of
from peers.systems import ENCODINGS, Baseline, CycloneNet, GdpNet, ZenohNet
from plot import Panel, panel_of
from report import Rounds
from skeleton import Options, Outcome, command_line, parse, perform

from gdp.host.run_registry import RunRegistry
from gdp.runtime.busy_poll import SPIN_US

SIZES: Final = (100, 10_000, 921_600)
MTUS: Final = (1_500, 9_000)
QUICK_COUNT: Final = 10


def baselines_of(only: Sequence[str]) -> tuple[Baseline, ...]:
    """Return the baselines with these names; all, if none is named."""
    every: tuple[Baseline, ...] = (
        GdpNet("kernel", ENCODINGS),
        GdpNet("raw", ENCODINGS),
        GdpNet("kernel", ("cdr",), "unicast"),
        GdpNet("kernel", ("cdr",), "session"),
        ZenohNet(secured=True),
        ZenohNet(secured=False),
        CycloneNet(),
    )
    return tuple(each for each in every if not only or each.name in only)


def panels_of(over: Rounds, plan: Plan) -> list[Panel]:
    """Return a panel for each case: medians, whiskers to the p99."""
    ours = [label for label in plan.labels if label.startswith("gdp")]
    return [
        panel_of(over, case_of(size, mtu, offloads=on, loaded=loaded), MEDIAN, plan.labels, p99=P99, ours=ours)
        for size, mtu, on in plan.cases
        for loaded in plan.loads
    ]


def arguments(names: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command_line(__doc__, has_record=True, has_plot=True)
    parser.add_argument("--rounds", type=positive, default=5)
    parser.add_argument(
        "--count", type=positive, default=80, help="messages above 100 kB; of smaller ones four times that"
    )
    parser.add_argument("--quick", action="store_true", help=f"one round of {QUICK_COUNT} messages")
    parser.add_argument("--only", action="append", choices=names, help="this baseline; may be repeated")
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    parser.add_argument("--size", type=size_of, action="append", help="bytes of a message; may be repeated")
    parser.add_argument("--offloads", choices=("off", "on", "both"), default="both", help="of the veth devices")
    parser.add_argument(
        "--load",
        choices=tuple(LOADS),
        default="both",
        help="none, or processes that take half of each core, or each in turn (default: %(default)s)",
    )
    return parser


def positive(text: str) -> int:
    """Return a whole number above 0. Raises ``ValueError``: it is not."""
    number = int(text)
    if number < 1:
        raise ValueError(text)
    return number


def size_of(text: str) -> int:
    """Return the bytes of a message.

    Raises:
        argparse.ArgumentTypeError: too few, or not a multiple of four, to which Cyclone DDS pads.
    """
    size = int(text)
    if size < SIZE_MIN or size % 4:
        raise argparse.ArgumentTypeError(f"a message has at least {SIZE_MIN} bytes, and a multiple of four")
    return size


def plan_of(options: argparse.Namespace) -> Plan:
    """Return the plan that the command line states."""
    return Plan(
        tuple(options.mtu or MTUS),
        {"off": (False,), "on": (True,), "both": (False, True)}[options.offloads],
        baselines_of(options.only or ()),
        Load(tuple(options.size or SIZES), QUICK_COUNT if options.quick else options.count),
        1 if options.quick else options.rounds,
        LOADS[options.load],
    )


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure every baseline in every case, round by round."""
    plan = plan_of(options)
    turns = Turns(plan)
    turns.run(runs)
    return Outcome(
        "messages",
        "Messages over three machines, an answer back",
        turns.over,
        targets_of(turns.over, [label for label in plan.labels if label.startswith("gdp")], plan.cases, plan.loads),
        {
            "rounds": plan.rounds,
            "messages a round": [plan.load.repeats(size) for size in plan.load.sizes],
            "answer, B": ANSWER.size,
            "ends of gdp spin, us": SPIN_US,
            "shared memory": "off everywhere",
            "load": f"{SHARE:.0%} of each core" if True in plan.loads else "none",
            **{f"offloads {'on' if on else 'off'}": text for on, text in turns.offload_states.items()},
            "trouble": turns.notes or "none",
        },
        lambda: panels_of(turns.over, plan),
        is_whole=is_whole(options),
    )


def is_whole(options: Options) -> bool:
    """Return whether all cases are measured, so that the figures are written to ``docs/benchmarks``."""
    has_part = options.quick or options.only or options.mtu or options.size
    return not has_part and options.offloads == options.load == "both"


def main() -> None:
    """Run the bench, or a part of it."""
    options = parse(arguments([each.name for each in baselines_of(())]))
    options.no_plot |= options.plot is None and not is_whole(options)
    options.is_whole = is_whole
    perform(options, measure)


if __name__ == "__main__":
    main()
