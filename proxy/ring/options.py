"""What a person may ask of the ring.

Place: pure.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from gdp.errors import LocalError
from gdp.testbed.topology import MTU_BYTES, Topology, ring5
from proxy.config import Encoding

__all__ = ["LIVE_S", "Cut", "Live", "Options", "RingPlane"]

RingPlane = Literal["auto", "kernel", "raw", "scapy"]
Live = Literal["ros2", "ros1", "mixed"]

LIVE_S: Final = 10.0
_LIVE_MAX_S: Final = 3_600.0

_CUT: Final = re.compile(r"([^@]+?)-([^@-]+)@(\d+(?:\.\d+)?)\Z")


@dataclass(frozen=True, slots=True)
class Cut:
    """A link that goes down while the recording is replayed.

    Args:
        a: one end.
        b: the other end.
        after_s: seconds after the first message may leave.
    """

    a: str
    b: str
    after_s: float

    @classmethod
    def from_text(cls, text: str) -> Cut:
        """Read ``nuc2-nuc3@5``.

        Raises:
            LocalError: anything else.
        """
        found = _CUT.match(text)
        if found is None:
            raise LocalError(f"a cut is written like nuc2-nuc3@5 (link, seconds after the start), not {text!r}")
        return cls(found[1], found[2], float(found[3]))

    def __str__(self) -> str:
        return f"{self.a}-{self.b}@{self.after_s:g}"


@dataclass(frozen=True, slots=True)
class Options:
    """One run of the ring. Paths are absolute, for the processes that read them stand elsewhere.

    Args:
        bag: the recording; None: a generated robot drive.
        rate: 1 is the recorded pace, 0 as fast as it goes.
        keep: leave everything up afterwards.
        out: directory, made if need be, where the received recording stays; None: it goes with the run.
        pcap: where to write what passes through the middle of the ring.
        live: real nodes instead of a recording; of which ROS. ``mixed``: ROS 1 at the robot, ROS 2 at the server.
        seconds: of live traffic; None: ``LIVE_S``.

    Raises:
        LocalError: a rate that is no pace, a cut of a link that is not there, a directory that is missing, a recording
            for a live run.
    """

    bag: Path | None = None
    rate: float = 1.0
    encoding: Encoding = "json"
    data_plane: RingPlane = "auto"
    mtu: int = MTU_BYTES
    out: Path | None = None
    json: Path | None = None
    pcap: Path | None = None
    cuts: tuple[Cut, ...] = ()
    keep: bool = False
    live: Live | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.live is not None and (self.bag is not None or self.rate != 1 or self.out is not None):
            raise LocalError("--live is without a recording: neither BAG nor --rate nor --out goes with it")
        if self.live is None and self.seconds is not None:
            raise LocalError("--seconds goes with --live; a recording takes its own time")
        if not 1 <= self.live_s <= _LIVE_MAX_S:
            raise LocalError(f"--seconds is 1 to {_LIVE_MAX_S:g}, not {self.live_s:g}")
        if not 0 <= self.rate < math.inf:
            raise LocalError(f"a rate is 0 or more, not {self.rate:g}")
        if self.bag is not None and not self.bag.exists():
            raise LocalError(f"no such recording: {self.bag}")
        for file in (self.json, self.pcap):
            if file is not None and not file.parent.is_dir():
                raise LocalError(f"no such directory: {file.parent}")
            if file is not None and file.is_dir():
                raise LocalError(f"a directory, where a file was expected: {file}")
        if self.out is not None and self.out.exists() and not self.out.is_dir():
            raise LocalError(f"a file, where a directory was expected: {self.out}")
        topology = self.topology()
        for cut in self.cuts:
            topology.link(cut.a, cut.b)

    @property
    def live_s(self) -> float:
        """Return how long live nodes talk."""
        return LIVE_S if self.seconds is None else self.seconds

    def topology(self) -> Topology:
        """Return the ring with the wanted MTU.

        Raises:
            LocalError: no link can have that MTU.
        """
        return ring5(self.mtu)

    def settings(self) -> dict[str, object]:
        """Return the options as the JSON result states them."""
        recorded = {"recording": str(self.bag) if self.bag else "demo", "rate": self.rate}
        return {
            **({"live": self.live, "seconds": self.live_s} if self.live else recorded),
            "encoding": self.encoding,
            "data_plane": self.data_plane,
            "mtu": self.mtu,
            "cuts": [str(cut) for cut in self.cuts],
        }
