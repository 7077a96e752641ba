"""Wait until descriptors are readable.

I/O. ``select.select`` refuses a descriptor of 1024 or more, which a process with many sockets has. This uses ``poll``.
"""

from __future__ import annotations

import select
from collections.abc import Iterable
from typing import Final, Protocol, TypeVar


class _HasFileno(Protocol):
    def fileno(self) -> int: ...


_T = TypeVar("_T", bound="int | _HasFileno")
_MS: Final = 1e3


def readable(files: Iterable[_T], timeout_s: float | None = None) -> list[_T]:
    """Return the files that can be read or have ended, as soon as there is one; empty after ``timeout_s``."""
    poll = select.poll()
    numbers = {each if isinstance(each, int) else each.fileno(): each for each in files}
    for number in numbers:
        poll.register(number, select.POLLIN)
    return [numbers[number] for number, _ in poll.poll(None if timeout_s is None else timeout_s * _MS)]
