"""Process of a machine's program: start, output and end.

I/O. Each process leads its own session, so its children end with it. The kernel kills it when the machine agent ends
for any reason (``PR_SET_PDEATHSIG``, by setpriv(1)). It inherits no credentials from the environment
(``fog/child_environment``).
"""

from __future__ import annotations

import asyncio
import os
import pwd
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from fog.child_environment import child_environment
from fog.host.bounded_log import BoundedLog
from fog.machine import Program

NODE_USER: Final = "FOG_NODE_USER"  # environment variable with the user for nodes; default: the user of the agent

_READ_BYTES: Final = 1 << 16


class ManagedProcess:
    """Running process.

    Args:
        home: the machine's folder; working directory of the process, unless ``FOG_NODE_USER`` is set: then that user's
            home.

    Raises:
        OSError: it cannot be started, or the user in ``FOG_NODE_USER`` does not exist.
    """

    def __init__(self, program: Program, home: Path, log: BoundedLog, on_ready: Callable[[], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._log = log
        self._on_ready: Callable[[], None] | None = on_ready
        self._sign = program.ready.encode()
        self._said = b""
        self.ended: asyncio.Future[int] = self._loop.create_future()
        words = [word.replace("{home}", str(home)).replace("{python}", sys.executable) for word in program.argv]
        environment = {key: value.replace("{home}", str(home)) for key, value in program.environment.items()}
        user = os.environ.get(NODE_USER, "") if program.is_users else ""
        own = _home_of(user)
        self._hears, says = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        os.set_blocking(says, True)  # only this side must not block
        try:
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                ["setpriv", "--pdeathsig", "KILL", *_as_user(user), "--", *words],
                stdin=subprocess.DEVNULL,
                stdout=says,
                stderr=says,
                cwd=own.get("HOME", home),
                env={**child_environment(os.environ), "PYTHONUNBUFFERED": "1", **own, **environment},
                start_new_session=True,
            )
        except OSError:
            os.close(self._hears)
            raise
        finally:
            os.close(says)
        self._pidfd = os.pidfd_open(self.pid)
        self._loop.add_reader(self._pidfd, self._reap)
        self._loop.add_reader(self._hears, self._hear)
        if not self._sign:
            self._tell_ready()

    @property
    def pid(self) -> int:
        """Return the process id, which is also the process group's id."""
        return self._process.pid

    def signal(self, number: signal.Signals) -> None:
        """Send a signal only to the program; no effect if it has ended."""
        if not self.ended.done():
            self._process.send_signal(number)

    def kill(self) -> None:
        """Kill its process group at once."""
        if not self.ended.done():
            os.killpg(self.pid, signal.SIGKILL)

    async def end(self, patience_s: float) -> None:
        """Send SIGTERM; kill it after ``patience_s`` seconds. No effect if it has ended."""
        self.signal(signal.SIGTERM)
        await asyncio.wait([self.ended], timeout=patience_s)
        self.kill()
        await asyncio.wait([self.ended])

    def _hear(self) -> None:
        try:
            data = os.read(self._hears, _READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            self._loop.remove_reader(self._hears)
            return
        self._log.write(data)
        if self._on_ready is not None:
            self._said += data
            if self._sign in self._said:
                self._tell_ready()
            else:
                self._said = self._said[-_READ_BYTES:]

    def _tell_ready(self) -> None:
        tell, self._on_ready, self._said = self._on_ready, None, b""
        if tell is not None:
            tell()

    def _reap(self) -> None:
        """Collect the exit status; the event loop calls this before the process id can be reused."""
        self._loop.remove_reader(self._pidfd)
        os.close(self._pidfd)
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)  # remaining children
        self._hear()
        self._loop.remove_reader(self._hears)
        os.close(self._hears)
        self._on_ready = None
        self.ended.set_result(self._process.wait())


def _as_user(user: str) -> list[str]:
    """Return the options of setpriv(1) to run a program as another user without capabilities."""
    if not user:
        return []
    rights = ["--inh-caps=-all", "--ambient-caps=-all", "--bounding-set=-all", "--no-new-privs"]
    return ["--reuid", user, "--regid", user, "--init-groups", *rights]


def _home_of(user: str) -> dict[str, str]:
    if not user:
        return {}
    try:
        home = pwd.getpwnam(user).pw_dir
    except KeyError as error:
        raise FileNotFoundError(f"no user {user}, whom {NODE_USER} names") from error
    return {"HOME": home, "USER": user, "LOGNAME": user, "ROS_HOME": f"{home}/.ros", "XDG_RUNTIME_DIR": home}
