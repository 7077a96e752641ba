"""``gdp watch``: who publishes, reads, serves and calls a name, as events.

I/O. It asks the running proxy of this machine through its control socket. Exit codes: 0 ended by Ctrl-C, ``--for`` or
``--count``; 2 wrong input; 3 no proxy runs there.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.program import Program
from gdp.errors import LocalError
from gdp.intervals import ANSWER_S, WATCH_S
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket
from gdp.ros_names import covers, is_name, is_pattern
from gdp.sharing.proxy_files import ProxyFiles
from gdp.state.control_protocol import Command
from gdp.terminal import echo
from proxy.bridge.liveliness import LivelinessEvent, LivelinessTracker, NameLiveliness, names_from_fields

app = Program("gdp watch")

_NOT_RUNNING: Final = 3
_NODE_CHARS: Final = 12
DEFAULT_CONFIG: Final = Path("proxy.yaml")

WatchedName = Annotated[str, typer.Argument(metavar="NAME", help="A ROS name, or a pattern: /robot1/**.")]
ConfigFile = Annotated[Path, typer.Option("--config", metavar="FILE", help="The configuration of the running proxy.")]
Deadline = Annotated[
    float | None,
    typer.Option(
        "--deadline", min=0.1, metavar="SECONDS", help="A publisher is silent that sends nothing for so long."
    ),
]
Duration = Annotated[float | None, typer.Option("--for", min=0.0, metavar="SECONDS", help="End after so many seconds.")]
Count = Annotated[int | None, typer.Option("--count", min=1, help="End after so many events.")]


@app.command(no_args_is_help=True)
def watch(
    name: WatchedName,
    config: ConfigFile = DEFAULT_CONFIG,
    deadline: Deadline = None,
    duration: Duration = None,
    count: Count = None,
    as_json: options.Json = False,
) -> None:
    """Print a line when a publisher, reader, server or client of NAME appears, goes, is silent or is heard again.

    NAME is what this machine calls it, or its name with a prefix. Those that are there at the start appear first. The
    machine must import or expose NAME. Of an imported topic it knows nothing while no local node reads it.

    \b
    Examples:
      gdp watch /scan
      gdp watch '/robot1/**' --deadline 2 --json
      gdp watch /plan --for 10
    """
    if not is_name(name) and not is_pattern(name):
        raise LocalError(f"{name!r}: expected a full ROS name, such as /camera/image, or a pattern: /camera/**")
    files = ProxyFiles.read(config)
    socket = files.control_socket or find_control_socket(files.identity)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            _follow(name, socket, deadline, duration, count, as_json=as_json)
    except NotRunningError as error:
        echo(f"error: {error}", err=True)
        raise typer.Exit(_NOT_RUNNING) from error


def _follow(
    name: str, socket: Path, deadline: float | None, duration: float | None, count: int | None, *, as_json: bool
) -> None:
    """Print events until the time is over or so many were printed."""
    tracker, left = LivelinessTracker(deadline), count
    end_s = None if duration is None else time.monotonic() + duration
    is_known = False
    while True:
        names, more = _names(socket)
        if more and not is_known:
            echo(f"gdp: this proxy carries {more} names more than one answer holds; they are left out", err=True)
        found = [each for each in names if covers(name, each.local) or covers(name, each.shared)]
        if not found and not is_known and not as_json:
            echo(f"gdp: {name}: this proxy carries no such name yet; 'gdp-proxy --check' says why", err=True)
        is_known = True
        for event in tracker.update(found, time.monotonic()):
            _print(event, as_json=as_json)
            if left is not None:
                left -= 1
                if not left:
                    return
        now_s = time.monotonic()
        if end_s is not None and now_s >= end_s:
            return
        time.sleep(WATCH_S if end_s is None else min(WATCH_S, max(end_s - now_s, 0.0)))


def _names(socket: Path) -> tuple[list[NameLiveliness], int]:
    """Return the names that the proxy lists, and how many it left out."""
    answer = ask_node(socket, Command.STATUS, ANSWER_S)
    if not answer.is_ok:
        raise LocalError(f"{socket}: {answer.error}")
    names = list(names_from_fields(answer.result.get("liveliness")))
    total = answer.result.get("names")
    return names, max(total - len(names), 0) if isinstance(total, int) else 0


def _print(event: LivelinessEvent, *, as_json: bool) -> None:
    now = datetime.now(timezone.utc)
    if as_json:
        echo(json.dumps({"time": now.isoformat().replace("+00:00", "Z"), **event.to_fields()}))
    else:
        clock = now.astimezone().strftime("%H:%M:%S")
        echo(f"{clock}  {event.name}  {event.role} {event.node[:_NODE_CHARS]} {event.change}")
    sys.stdout.flush()
