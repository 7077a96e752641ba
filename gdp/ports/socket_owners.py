"""Owners of loopback connections: the user whose program holds the other end, as the kernel knows it.

I/O, reading. Source: proc_net_tcp(5); an address is hexadecimal, in 32-bit words of the host's byte order.
"""

from __future__ import annotations

import ipaddress
import os
import sys
from contextlib import ExitStack
from typing import BinaryIO, Final, TypeAlias

Address: TypeAlias = "tuple[str, int]"

_TABLES: Final = ("/proc/self/net/tcp", "/proc/self/net/tcp6")
_LOCAL, _REMOTE, _UID = 1, 2, 7  # columns


class SocketOwners:
    """The kernel's tables of TCP sockets in this network namespace; they stay open, also where files are confined."""

    def __init__(self) -> None:
        with ExitStack() as stack:
            self._tables: list[BinaryIO] = [
                stack.enter_context(open(path, "rb")) for path in _TABLES if os.path.exists(path)
            ]
            self._stack = stack.pop_all()

    def is_mine(self, client: Address, server: Address) -> bool:
        """Return whether the client of a loopback connection is a program of this user, or of root."""
        if not ipaddress.ip_address(client[0]).is_loopback:
            return False
        return self.uid_of(client, server) in (0, os.geteuid())

    def uid_of(self, client: Address, server: Address) -> int | None:
        """Return the user of the socket at the client's end; None: it is not in the tables."""
        wanted = _text(client), _text(server)
        for table in self._tables:
            table.seek(0)
            for line in table.read().decode("ascii").splitlines()[1:]:
                fields = line.split()
                if (fields[_LOCAL], fields[_REMOTE]) == wanted:
                    return int(fields[_UID])
        return None

    def close(self) -> None:
        """Close the tables."""
        self._stack.close()


def _text(address: Address) -> str:
    packed = ipaddress.ip_address(address[0]).packed
    words = (int.from_bytes(packed[at : at + 4], sys.byteorder) for at in range(0, len(packed), 4))
    return "".join(f"{word:08X}" for word in words) + f":{address[1]:04X}"
