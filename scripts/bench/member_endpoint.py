"""Member of the overlay on its plane, as the endpoint processes of benches use it; and a timer that wakes one.

I/O. Source of the timer: timerfd_create(2). CLOCK_MONOTONIC is one clock for all namespaces of a machine.
"""

from __future__ import annotations

import ctypes
import json
import os
import secrets
import struct
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from gdp.client.participant import Participant, Topic
from gdp.client.publisher import Publisher
from gdp.config.config import RibConfig
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.errors import DropReason, LocalError
from gdp.names import Name
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.ports.raw import RawPlane
from gdp.runtime.runtime import Runtime
from gdp.stores.keyring import load_delegations

__all__ = ["End", "Timer", "run_role"]

PATIENCE_S: Final = 20.0
_LIBRARY: Final = ctypes.CDLL(None, use_errno=True)
_ABSOLUTE: Final = 1  # TFD_TIMER_ABSTIME
_SPEC: Final = struct.Struct("@qqqq")  # interval, first; each in seconds and nanoseconds


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


class Timer:
    """Timer whose descriptor becomes readable at every tick.

    Raises:
        OSError: the kernel refuses.
    """

    def __init__(self, first_ns: int, every_s: float) -> None:
        self._fd = _checked(_LIBRARY.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC))
        spec = _SPEC.pack(0, round(every_s * 1e9), *divmod(first_ns, 1_000_000_000))
        _checked(_LIBRARY.timerfd_settime(self._fd, _ABSOLUTE, spec, None))

    def fileno(self) -> int:
        """Return its descriptor."""
        return self._fd

    def passed(self) -> int:
        """Return how many ticks were due since the last call."""
        return int.from_bytes(os.read(self._fd, 8), sys.byteorder)

    def close(self) -> None:
        """Stop it."""
        os.close(self._fd)


class End:
    """Member on its plane.

    Attributes:
        topics: topics and services that its delegations name.
    """

    def __init__(self, config: Path, spin_s: float) -> None:
        settings = RibConfig.load(config)  # identity, domain and iface are all that an endpoint needs
        identity, policy = load_member(settings.identity, settings.domain, Role.PROXY)
        node = NodeSettings(incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=secrets.token_bytes)
        self.member = Participant(identity, policy, node)
        self.plane = RawPlane([settings.iface])
        self.runtime = Runtime(self.member, self.plane, spin_s=spin_s)
        self.topics: dict[str, Topic] = {}
        for each in load_delegations(settings.identity / "delegations"):
            if each.metadata is None:
                raise LocalError("a delegation without metadata")
            grants = {epoch: grant.secret for epoch, grant in each.open(identity).items()}
            self.topics[str(each.metadata["name"])] = Topic(each, grants)

    def advertise(self, topic: str, *, reliable: bool, urgent: bool = False) -> Publisher:
        """Publish a topic."""
        return self.member.advertise(self.topics[topic], b"bench", reliable=reliable, urgent=urgent)

    def subscribe(self, topic: str) -> Name:
        """Read a topic; return its name."""
        self.member.subscribe(self.topics[topic])
        return self.topics[topic].name

    def serve(self, name: str, *, is_session: bool = False) -> Name:
        """Serve a name; return its overlay name."""
        self.member.serve(self.topics[name], b"bench", is_session=is_session)
        return self.topics[name].name

    def call(self, name: str, *, is_session: bool = False) -> Publisher:
        """Call a name from now on; return the stream that all its servers receive."""
        return self.member.call(self.topics[name], b"bench", is_session=is_session)

    def name_of(self, name: str) -> Name:
        """Return the overlay name of a topic or service."""
        return self.topics[name].name

    def wait_for_readers(self, publishers: Iterable[Publisher], deadline_s: float | None = None) -> None:
        """Return when every publisher has a reader.

        Raises:
            TimeoutError: not by the deadline, in monotonic seconds; None: 20 s from now.
        """
        wanted = list(publishers)
        latest_s = time.monotonic() + PATIENCE_S if deadline_s is None else deadline_s
        if not self.runtime.run(lambda: all(each.readers for each in wanted), latest_s):
            raise TimeoutError("no reader: the overlay did not come up")

    def drops(self) -> dict[str, int]:
        """Return what this process dropped, by reason."""
        of_member, of_plane = self.member.drops(), self.plane.counters.drops
        found = {reason.label: of_member.get(reason, 0) + of_plane[reason] for reason in DropReason}
        return {label: count for label, count in found.items() if count}

    def leave(self) -> None:
        """Withdraw and close."""
        self.member.leave()
        while self.runtime.send():
            continue


def run_role(roles: Mapping[str, Callable[[End, Mapping[str, Any]], None]]) -> None:
    """Run the role of the first argument, with the settings of the second."""
    settings = json.loads(sys.argv[2])
    roles[sys.argv[1]](End(Path(settings["config"]), settings["spin_s"]), settings)
