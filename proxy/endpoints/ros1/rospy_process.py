"""The rospy process of one virtual node, and the link to it; after its end it is started again, with a growing delay.

I/O; a process and a socket pair.
"""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from gdp.intervals import ANSWER_S, STEADY_S
from gdp.requests import Backoff
from proxy.endpoints.ros1.ipc import Frame, IpcLink

_START_S: Final = 4.0  # a process that has just been started answers later
_RESTARTS: Final = Backoff(0.25, 5.0)
_ROOT: Final = Path(__file__).resolve().parents[3]


class RospyProcess:
    """Process that joins the ROS 1 graph as soon as the master answers.

    Attributes:
        epoll: readable while the link has frames.
        link: to the present process.
    """

    def __init__(self, master_uri: str, node: str) -> None:
        self._master_uri = master_uri
        self._node = node
        self._starts = 0
        self._failures = 0
        self._dropped_before = 0
        self._ended: list[subprocess.Popen[bytes]] = []
        self.epoll = select.epoll()
        self._start(0.0)

    @property
    def dropped(self) -> int:
        """Return the number of messages that this side has dropped because the process did not take them."""
        return self._dropped_before + self.link.dropped

    @property
    def answers_by_s(self) -> float:
        """Return the monotonic second until which a question that is asked now is answered."""
        return max(time.monotonic() + ANSWER_S, 0.0 if self._is_answering else self._started_s + _START_S)

    def poll_frames(self) -> list[Frame]:
        """Transfer frames on the link without blocking; return those received.

        Raises:
            LinkEndedError: the process has ended.
        """
        if self.link.is_behind:
            self.link.flush()
            if not self.link.is_behind:
                self.epoll.modify(self.link, select.EPOLLIN)
        frames = self.link.poll_frames()
        self._is_answering |= bool(frames)
        return frames

    def restart(self) -> None:
        """Start another process in place of one that has ended."""
        self._process.kill()
        self._ended = [process for process in (*self._ended, self._process) if process.poll() is None]
        self._dropped_before += self.link.dropped
        self.epoll.unregister(self.link)
        self.link.close()
        self._failures = 0 if time.monotonic() - self._started_s > STEADY_S else self._failures + 1
        self._start(_RESTARTS.pause_s(self._failures) if self._failures else 0.0)

    def close(self) -> None:
        """End the process; may block two seconds while it unregisters from the master."""
        self.link.close()
        self._ended.append(self._process)
        until_s = time.monotonic() + ANSWER_S
        for process in self._ended:
            try:
                process.wait(max(0.0, until_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.epoll.close()

    def _start(self, delay_s: float) -> None:
        ours, its = socket.socketpair()
        self._starts += 1
        self._started_s = time.monotonic()
        self._is_answering = False
        left_out = ("ROS_NAMESPACE", "GDP_PASSPHRASE")
        environment = {key: value for key, value in os.environ.items() if key not in left_out}
        environment["ROS_MASTER_URI"] = self._master_uri
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(_ROOT))))
        arguments = (its.fileno(), self._master_uri, self._node, self._starts, delay_s)
        with its:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "proxy.endpoints.ros1.child", *map(str, arguments)],
                pass_fds=[its.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # rospy prints there
                env=environment,
                start_new_session=True,  # Ctrl-C goes to the proxy, which then closes the link
            )
        self.link = IpcLink(ours, lambda: self.epoll.modify(ours, select.EPOLLIN | select.EPOLLOUT))
        self.epoll.register(ours, select.EPOLLIN)
