"""Notifications to the service manager: that a service is ready, that its loop turns, and that it ends.

I/O. Source: sd_notify(3), sd_watchdog_enabled(3), systemd.service(5) ``Type=notify`` and ``WatchdogSec=``. The messages
come from the service's own loop, so a loop that hangs sends none, and systemd restarts the service.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, MutableMapping
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import HOUR_S

log = logging.getLogger(__name__)

_SOCKET, _TIMEOUT, _PROCESS = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"
_BEATS: Final = 3  # within the timeout; sd_watchdog_enabled(3) advises at least two


class ServiceNotifier:
    """Connection to the service manager; without one, each call does nothing.

    Args:
        channel: connected datagram socket; None: no manager listens.
        timeout_s: the manager restarts the service after this time without a beat; None: never.
    """

    def __init__(self, channel: socket.socket | None, timeout_s: float | None) -> None:
        self._channel = channel
        self._is_ready = False
        self._is_watched = timeout_s is not None
        self.period_s: Final = HOUR_S if timeout_s is None else timeout_s / _BEATS

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str] = os.environ) -> ServiceNotifier:
        """Take the manager's address out of the environment, so that no child process speaks for this one.

        Raises:
            LocalError: the address cannot be reached, or the timeout is no number.
        """
        address = environment.pop(_SOCKET, "")
        timeout, process = environment.pop(_TIMEOUT, ""), environment.pop(_PROCESS, "")
        if not address:
            return cls(None, None)
        is_own = process in ("", str(os.getpid()))
        if timeout and not (timeout.isascii() and timeout.isdigit() and int(timeout)):
            raise LocalError(f"{_TIMEOUT} is a number of microseconds, not {timeout}")
        channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            channel.setblocking(False)
            channel.connect("\0" + address[1:] if address.startswith("@") else address)
        except OSError as error:
            channel.close()
            raise LocalError(f"{_SOCKET}: {address}: {error.strerror}") from error
        return cls(channel, int(timeout) / 1e6 if timeout and is_own else None)

    def follow(self, every: Callable[[float, Callable[[object], None]], None]) -> None:
        """Have a loop beat from now on.

        Args:
            every: registers a function that the loop calls each so many seconds, the first time at once.
        """
        if self._channel is not None:
            every(self.period_s, lambda _: self.beat())

    def beat(self) -> None:
        """Report that the loop turns; the first call also reports that the service is ready."""
        words = [] if self._is_ready else ["READY=1"]
        if self._is_watched:
            words.append("WATCHDOG=1")
        self._is_ready = self._send(words) or self._is_ready

    def close(self) -> None:
        """Report that the service ends, and release the socket."""
        self._send(["STOPPING=1"])
        if self._channel is not None:
            self._channel.close()
            self._channel = None

    def _send(self, words: list[str]) -> bool:
        if self._channel is None or not words:
            return False
        try:
            self._channel.send("\n".join(words).encode())
        except OSError as error:  # a full queue or a manager that restarts: the next beat reports again
            log.warning("service manager not notified reason=%s", error.strerror)
            return False
        return True


@contextlib.contextmanager
def service_notifier() -> Iterator[ServiceNotifier]:
    """Yield the connection to this process's service manager; open it before rights are dropped.

    Raises:
        LocalError: as ``ServiceNotifier.from_environment``.
    """
    with contextlib.closing(ServiceNotifier.from_environment()) as notifier:
        yield notifier
