"""Socket buffers of ``wireguard-go``, enlarged from outside.

I/O. Source: pidfd_getfd(2), Linux 5.6; socket(7). Versions before 2023 keep the system's default receive buffer of some
90 datagrams. It overflows while the program waits for a CPU, and every loss halves the window of a sender. Later
versions set 7 MiB themselves, as this module does. A socket that the program opens later, after a change of its port or
address, is new, so its keeper looks again. The copy of a descriptor holds the port open for some microseconds, so a
change of the port is tried again if it is taken (``uapi.py``).
"""

from __future__ import annotations

import errno
import os
import socket
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.ports.confine.system import call

_PIDFD_GETFD: Final = 438  # the same on all architectures
_SO_SNDBUFFORCE: Final = 32
_SO_RCVBUFFORCE: Final = 33
_BUFFER_BYTES: Final = 7 << 20  # as wireguard-go since 0.0.20230223
_SMALL: Final = "wireguard-go loses packets under load, because its receive buffer stays small: {}"


class SocketBuffers:
    """Enlarges the buffers of the UDP sockets of one process.

    Args:
        pid: of the process, which must not be reused while the object lives.
        pidfd: descriptor of the same process.
    """

    def __init__(self, pid: int, pidfd: int) -> None:
        self._folder = Path(f"/proc/{pid}/fd")
        self._pidfd = pidfd
        self._known: set[str] = set()

    def enlarge(self) -> None:
        """Enlarge the buffers of sockets that are new since the last call; does nothing if the process ended.

        Raises:
            LocalError: the kernel refuses; the sockets stay as they are, and a later call skips them.
        """
        present = self._sockets()
        new = present.keys() - self._known
        self._known = set(present)
        for inode in new:
            try:
                copy = call(_PIDFD_GETFD, self._pidfd, present[inode], 0)
            except ProcessLookupError:
                return
            except OSError as error:
                if error.errno == errno.EBADF:  # closed meanwhile
                    continue
                raise LocalError(_SMALL.format(error.strerror)) from error
            with socket.socket(fileno=copy) as opened:
                if opened.type == socket.SOCK_DGRAM:
                    _enlarge(opened)

    def _sockets(self) -> dict[str, int]:
        """Return the descriptors of sockets by inode; empty if the process ended."""
        found: dict[str, int] = {}
        with suppress(FileNotFoundError, ProcessLookupError):
            for each in os.listdir(self._folder):
                with suppress(FileNotFoundError):  # closed meanwhile
                    target = os.readlink(self._folder / each)
                    if target.startswith("socket:"):
                        found[target] = int(each)
        return found


def _enlarge(opened: socket.socket) -> None:
    for option in (_SO_RCVBUFFORCE, _SO_SNDBUFFORCE):
        try:
            opened.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
        except OSError as error:
            raise LocalError(_SMALL.format(error.strerror)) from error
