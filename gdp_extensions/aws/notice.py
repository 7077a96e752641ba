"""Watcher of EC2 instance metadata: a program of every EC2 machine that signals ``fog-machine`` to leave.

I/O; polls the instance metadata service (version 2) every few seconds, because it has no notification.
Source: EC2 user guide, "Spot Instance interruption notices" (two minutes before; poll every five seconds; 404 if there
is none) and "Use IMDSv2"; 169.254.169.254 is its address on every instance.

A spot interruption is written to the machine's ``notice.json`` at once. The machine continues to serve, because its
replacement may not be up, and drains before the deadline. The tag of ``AwsProvider.drain`` drains it at once.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from datetime import datetime, timezone
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Final
from urllib.error import HTTPError
from urllib.request import ProxyHandler, Request, build_opener

import typer

from fog.host.preemption_notice import write_notice
from gdp.cli.version import HELP
from gdp.intervals import ANSWER_S, DRAIN_S, HOUR_S, POLL_S
from gdp.terminal import echo
from gdp_extensions.aws.core.instances import DRAIN

METADATA_URL: Final = "http://169.254.169.254"
_TOKEN_HEADER: Final = "X-aws-ec2-metadata-token"
_NONE: Final = 404
_TOKEN_EXPIRED: Final = 401

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


class Metadata:
    """Metadata of this instance. All methods raise OSError without a valid response."""

    def __init__(self, url: str = METADATA_URL) -> None:
        self._url = url
        self._token = ""
        self._open = build_opener(ProxyHandler({})).open  # a proxy would return the metadata of its own machine

    def interrupted_at_unix_s(self) -> float | None:
        """Return when EC2 preempts this spot machine, as Unix time; None: there is no notice."""
        text = self._get("spot/instance-action")
        if text is None:
            return None
        try:
            at = datetime.strptime(json.loads(text)["time"], "%Y-%m-%dT%H:%M:%SZ")
        except (ValueError, KeyError, TypeError) as error:
            raise OSError(f"spot/instance-action makes no sense: {text[:200]!r}") from error
        return at.replace(tzinfo=timezone.utc).timestamp()

    def is_to_drain(self) -> bool:
        """Return whether this machine has the drain tag."""
        return self._get(f"tags/instance/{DRAIN}") is not None

    def _get(self, path: str) -> str | None:
        for _ in range(2):
            self._token = self._token or self._ask(
                "PUT", "api/token", {f"{_TOKEN_HEADER}-ttl-seconds": str(6 * HOUR_S)}
            )
            try:
                return self._ask("GET", f"meta-data/{path}", {_TOKEN_HEADER: self._token})
            except HTTPError as error:
                if error.code == _NONE:
                    return None
                if error.code != _TOKEN_EXPIRED:
                    raise
                self._token = ""
        raise OSError("the metadata service refuses its own tokens")

    def _ask(self, method: str, path: str, headers: dict[str, str]) -> str:
        request = Request(f"{self._url}/latest/{path}", headers=headers, method=method)
        try:
            with self._open(request, timeout=ANSWER_S) as document:
                return str(document.read().decode())
        except HTTPError as error:
            error.close()
            raise
        except (HTTPException, UnicodeDecodeError) as error:
            raise OSError(f"metadata: {error!r}") from error


class Watch:
    """State of the watcher; ``notice``: called once with the time of the preemption (Unix time)."""

    def __init__(self, metadata: Metadata, notice: Callable[[float], None], drain: Callable[[], None]) -> None:
        self._metadata = metadata
        self._notice = notice
        self._drain = drain
        self._leaves_at: float | None = None

    def poll(self, now_unix_s: float) -> bool:
        """Poll once; return whether watching has ended because the machine drains.

        Raises:
            OSError: the metadata cannot be read now.
        """
        if self._leaves_at is None:
            leaves_at = self._metadata.interrupted_at_unix_s()
            if leaves_at is not None:
                self._notice(leaves_at)
                self._leaves_at = leaves_at
        is_time = self._leaves_at is not None and now_unix_s >= self._leaves_at - DRAIN_S
        if is_time or self._metadata.is_to_drain():
            self._drain()
            return True
        return False


@app.command(context_settings=HELP, epilog="Example: python -m gdp_extensions.aws.notice --home /var/lib/fog")
def watch(
    home: Annotated[Path, typer.Option(help="The machine's folder.")],
    url: Annotated[str, typer.Option(help="Where the metadata service is.")] = METADATA_URL,
    poll_s: Annotated[float, typer.Option(help="Seconds between two looks.")] = POLL_S,
) -> None:
    """Watch until this machine is to leave, tell the process that started this one, and wait to be ended."""
    ended = threading.Event()
    for each in (signal.SIGTERM, signal.SIGINT):
        signal.signal(each, lambda *_: ended.set())
    machine = os.getppid()

    def notice(leaves_at_unix_s: float) -> None:
        echo(f"EC2 takes this machine at {leaves_at_unix_s:.0f}")
        write_notice(home, leaves_at_unix_s)
        os.kill(machine, signal.SIGUSR2)

    def drain() -> None:
        echo("the machine drains")
        os.kill(machine, signal.SIGUSR1)

    seen = Watch(Metadata(url), notice, drain)
    is_over, trouble = False, ""
    while not ended.wait(poll_s):
        try:
            is_over = is_over or seen.poll(time.time())
            trouble = ""
        except OSError as error:
            if str(error) != trouble:
                echo(f"metadata cannot be read: {error}", err=True)
            trouble = str(error)


def main() -> None:
    """Run the program."""
    app()


if __name__ == "__main__":
    main()
