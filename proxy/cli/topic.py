"""Commands ``gdp topic hz``, ``gdp topic bw`` and ``gdp topic echo``: what a topic carries, read as a member.

I/O; ``gdp`` loads them, since the package ``gdp`` does not know ``proxy``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gdp import terminal
from gdp.cli.options import known_name
from gdp.cli.program import Program
from gdp.errors import RemoteError
from gdp.intervals import REPORT_S
from proxy.cli.tool_options import Node, ToolOptions, TypeName, complete_readable, print_json, print_text, running_tool

if TYPE_CHECKING:
    from proxy.bridge.bridge import Bridge
    from proxy.node.tool_member import Access, Tick
    from proxy.serial.channel import Channel
    from proxy.tools.message_text import MessageText
    from proxy.tools.rates import Bandwidth, Frequency

app = Program("gdp topic", no_args_is_help=True)

_REPORT_S: Final = 1.0

Name = Annotated[str, known_name("/scan", complete_readable)]
Duration = Annotated[
    float | None, typer.Option("--duration", min=0.1, metavar="SECONDS", help="End after this time. Default: Ctrl-C.")
]


@app.command(
    no_args_is_help=True,
    epilog="Examples: gdp topic hz /scan --node keys/viewer; gdp topic hz /scan --node keys/viewer --duration 5 --json",
)
def hz(
    name: Name,
    node: Node,
    type_name: TypeName = "",
    window: Annotated[int, typer.Option("--window", "-w", min=2, help="Messages in the average.")] = 10_000,
    duration: Duration = None,
    *,
    options: ToolOptions,
) -> None:
    """Print once a second at which rate messages of a topic arrive here, as 'ros2 topic hz' does.

    It reads the topic through the overlay as the node NODE, whose delegations must give the right to read it. With
    --duration the exit code is 1 if no rate could be measured.
    """
    with running_tool(options):
        from proxy.tools.rates import Frequency

        _measure(_readable(node, name, type_name, options), window, Frequency.of, duration, is_json=options.json)


@app.command(
    no_args_is_help=True,
    epilog="Examples: gdp topic bw /camera/image --node keys/viewer; gdp topic bw /scan --node keys/viewer --json",
)
def bw(
    name: Name,
    node: Node,
    type_name: TypeName = "",
    window: Annotated[int, typer.Option("--window", "-w", min=2, help="Messages in the average.")] = 100,
    duration: Duration = None,
    *,
    options: ToolOptions,
) -> None:
    """Print once a second how many bytes of a topic arrive here, as 'ros2 topic bw' does.

    Bytes are those of the messages in ROS's wire form, before sealing and compression. The node NODE needs the right to
    read the topic. With --duration the exit code is 1 if nothing could be measured.
    """
    with running_tool(options):
        from proxy.tools.rates import Bandwidth

        _measure(_readable(node, name, type_name, options), window, Bandwidth.of, duration, is_json=options.json)


@app.command(
    no_args_is_help=True,
    epilog="Examples: gdp topic echo /odom --node keys/viewer --once;"
    " gdp topic echo /odom --node keys/viewer --json -n 5",
)
def echo(
    name: Name,
    node: Node,
    type_name: TypeName = "",
    count: Annotated[int | None, typer.Option("-n", "--count", min=1, help="End after so many messages.")] = None,
    once: Annotated[bool, typer.Option("--once", help="End after one message.")] = False,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", min=0.1, metavar="SECONDS", help="End with exit code 1 after so long in silence."),
    ] = None,
    truncate: Annotated[
        int, typer.Option("--truncate-length", "-l", min=1, help="Longest array and string of the YAML form.")
    ] = 128,
    full: Annotated[bool, typer.Option("--full-length", "-f", help="Whole arrays and strings.")] = False,
    *,
    options: ToolOptions,
) -> None:
    """Print the messages of a topic, as 'ros2 topic echo' does, until Ctrl-C.

    It reads the topic through the overlay as the node NODE, whose delegations must give the right to read it. Without
    that right the exit code is 2, and the text says what the owner types. --json prints whole messages as lines.
    """
    with running_tool(options):
        access = _readable(node, name, type_name, options)
        printer = _Printer(1 if once else count, None if full else truncate, is_json=options.json)
        _read(access, printer.print, printer.tick(access, timeout))
        if printer.is_silent:
            terminal.echo(f"error: {name}: no message within {timeout:g} s", err=True)
            raise typer.Exit(1)


class _Printer:
    """Prints messages until there were enough of them."""

    def __init__(self, count: int | None, truncate: int | None, *, is_json: bool) -> None:
        self._left = count
        self._truncate = truncate
        self._is_json = is_json
        self._heard_s: float | None = None
        self._texts: dict[int, tuple[Channel, MessageText]] = {}
        self.is_silent = False

    def print(self, channel: Channel, raw: bytes, now_s: float) -> None:
        """Print a message; one that does not fit its definition is reported instead."""
        if self._left == 0:
            return
        self._heard_s = now_s
        try:
            self._print(channel, raw)
        except RemoteError as error:
            terminal.echo(f"error: {channel.topic}: {error.detail}", err=True)
            return
        if self._left is not None:
            self._left -= 1

    def _print(self, channel: Channel, raw: bytes) -> None:
        from proxy.tools.message_text import MessageText

        known = self._texts.get(id(channel))
        if known is None or known[0] is not channel:
            known = self._texts[id(channel)] = channel, MessageText(channel, self._truncate)
        if self._is_json:
            fields = {"topic": channel.topic, "type": channel.type_name, "received_ns": time.time_ns()}
            print_json({**fields, "bytes": len(raw), "message": known[1].to_json(raw)})
        else:
            print_text(f"{known[1].to_yaml(raw)}---")

    def tick(self, access: Access, timeout_s: float | None) -> Tick:
        """Return the function that decides when to end."""
        hint = _Hint(access)

        def tick(bridge: Bridge, now_s: float) -> float | None:
            """Return the moment of the next call; None: enough messages, or too long in silence."""
            if self._left == 0:
                return None
            if self._heard_s is None:
                hint.tick(bridge, now_s)
            since_s = max(self._heard_s or 0.0, hint.begun_s)
            if timeout_s is not None and now_s >= since_s + timeout_s:
                self.is_silent = True
                return None
            return now_s + _REPORT_S if timeout_s is None else min(now_s + _REPORT_S, since_s + timeout_s)

        return tick


class _Hint:
    """Says once, on standard error, what is known where no message comes."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._is_said = False
        self.begun_s = math.inf

    def tick(self, bridge: Bridge, now_s: float) -> None:
        """Look at the publishers after a while without a message."""
        self.begun_s = min(self.begun_s, now_s)
        if self._is_said or now_s < self.begun_s + REPORT_S:
            return
        self._is_said = True
        publishers = len(bridge.publishers_of(self._access.name))
        seen = f"{publishers} publishers, none of them sends" if publishers else "no publisher is known"
        text = f"{self._access.rule.name}: no message within {REPORT_S:g} s; {seen}; still waiting"
        terminal.echo(text, err=True)


def _readable(node: Path, name: str, type_name: str, options: ToolOptions) -> Access:
    from gdp.trust.right import Right
    from proxy.node.tool_member import Wanted

    return options.find_access(node, Wanted(name, type_name, Right.READ))


def _read(access: Access, take: Callable[[Channel, bytes, float], None], tick: Tick) -> None:
    from proxy.endpoints.probe import Probe
    from proxy.node.tool_member import run_probe

    rule = access.rule
    run_probe(access, Probe((rule.local, rule.type_name), take), tick)


def _measure(
    access: Access,
    window: int,
    report_of: Callable[[list[tuple[float, int]], float], Frequency | Bandwidth],
    duration_s: float | None,
    *,
    is_json: bool,
) -> None:
    """Report once a second; exit 1 if a bounded time brought no report."""
    from proxy.tools.rates import Arrivals

    arrivals = Arrivals(window)
    hint = _Hint(access)
    is_measured = False
    report_at_s = math.inf

    def tick(bridge: Bridge, now_s: float) -> float | None:
        """Report when it is time; return when that is next."""
        nonlocal is_measured, report_at_s
        if report_at_s == math.inf:
            report_at_s = now_s + _REPORT_S
        if not is_measured:
            hint.tick(bridge, now_s)
        end_s = math.inf if duration_s is None else hint.begun_s + duration_s
        if now_s >= min(report_at_s, end_s):
            if latest := arrivals.poll_latest():
                is_measured = True
                report = report_of(latest, now_s)
                if is_json:
                    print_json({"topic": access.rule.name, **report._asdict()})  # an infinite rate is null
                else:
                    print_text(report.words())
            report_at_s = now_s + _REPORT_S
        return None if now_s >= end_s else min(report_at_s, end_s)

    _read(access, lambda _channel, raw, now_s: arrivals.add(now_s, len(raw)), tick)
    if duration_s is not None and not is_measured:
        terminal.echo(f"error: {access.rule.name}: fewer than two messages within {duration_s:g} s", err=True)
        raise typer.Exit(1)
