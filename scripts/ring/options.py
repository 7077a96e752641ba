"""Options of a run of the ring. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from gdp.errors import LocalError
from gdp.intervals import ADVERTISEMENT, LEASE_MAX_S, LEASE_MIN_S
from lab.faults import Fault
from lab.topology import MTU_BYTES, Topology, ring5
from proxy.config.config import Encoding
from ring.faults import CUT, ROAM, check_faults, text_of
from ring.nodes.content import CAMERA_HZ

RingPlane = Literal["auto", "kernel", "raw", "scapy"]
Live = Literal["ros2", "ros1", "mixed"]

LIVE_S: Final = 10.0
_LIVE_MAX_S: Final = 3_600.0
_CAMERA_HZ: Final = 0.1, 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """One run of the ring. Paths are absolute, because the processes that read them have other working directories.

    Args:
        bag: the recording; None: a generated robot drive.
        rate: 1 is the recorded pace, 0 as fast as possible.
        out: directory, created if necessary, for the received recording; None: it is deleted with the run.
        cores: bound and weight the processor time of each machine.
        wide: print all columns of the table.
        live: real nodes instead of a recording; their ROS version. ``mixed``: ROS 1 at the robot, ROS 2 at the server.
        seconds: of traffic; a recording is replayed slower or faster to last this long, a generated one is created with
            this length. None: ``LIVE_S`` live, else the recording's own time.
        camera_hz: images a second of the live camera.

    Raises:
        LocalError: an invalid rate, a fault that cannot be injected, a directory that is missing, a recording for a
            live run.
    """

    bag: Path | None = None
    rate: float = 1.0
    encoding: Encoding = "json"
    data_plane: RingPlane = "auto"
    mtu: int = MTU_BYTES
    out: Path | None = None
    json: Path | None = None
    pcap: Path | None = None
    faults: tuple[Fault, ...] = ()
    keep: bool = False
    cores: bool = False
    wide: bool = False
    live: Live | None = None
    seconds: float | None = None
    camera_hz: float = CAMERA_HZ
    lease_s: float = ADVERTISEMENT.lease_s

    def __post_init__(self) -> None:
        if self.live is not None and (self.bag is not None or self.rate != 1 or self.out is not None):
            raise LocalError("--live is without a recording: neither BAG nor --rate nor --out goes with it")
        if self.live is None and self.camera_hz != CAMERA_HZ:
            raise LocalError("--camera-hz is for --live: a recording has its own pace")
        if not _CAMERA_HZ[0] <= self.camera_hz <= _CAMERA_HZ[1]:
            raise LocalError(f"--camera-hz is {_CAMERA_HZ[0]:g} to {_CAMERA_HZ[1]:g}, not {self.camera_hz:g}")
        if self.seconds is not None and self.rate != 1:
            raise LocalError("--seconds and --rate both say how fast: give one of them")
        if self.seconds is not None and not 1 <= self.seconds <= _LIVE_MAX_S:
            raise LocalError(f"--seconds is 1 to {_LIVE_MAX_S:g}, not {self.seconds:g}")
        if not LEASE_MIN_S <= self.lease_s <= LEASE_MAX_S:
            raise LocalError(f"--lease is {LEASE_MIN_S:g} to {LEASE_MAX_S:g} seconds, not {self.lease_s:g}")
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
        check_faults(self.topology(), self.faults, self.live_s if self.live is not None else self.seconds)

    @property
    def live_s(self) -> float:
        """Return the seconds of live traffic."""
        return LIVE_S if self.seconds is None else self.seconds

    def topology(self) -> Topology:
        """Return the ring with the requested MTU. Raises ``LocalError``: no link can have that MTU."""
        return ring5(self.mtu)

    def settings(self) -> dict[str, object]:
        """Return the options for the JSON result."""
        recorded = {"recording": str(self.bag) if self.bag else "demo", "rate": self.rate, "seconds": self.seconds}
        return {
            **({"live": self.live, "seconds": self.live_s, "camera_hz": self.camera_hz} if self.live else recorded),
            "encoding": self.encoding,
            "data_plane": self.data_plane,
            "mtu": self.mtu,
            "cores": self.cores,
            "lease_s": self.lease_s,
            "cuts": [text_of(each) for each in self.faults if each.kind is CUT],
            "roams": [text_of(each) for each in self.faults if each.kind is ROAM],
            "kills": [text_of(each) for each in self.faults if each.kind not in (CUT, ROAM)],
        }
