"""Conditions of a thin link: rate or recording, round trip, loss, FIFO, of each direction; and their text.

Sans-I/O, but for ``load_trace`` (one file). Words of the command line become ``Conditions``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from thin_link.channel import OPPORTUNITY_BYTES, Channel, ConstantRate, Loss, Rate, TraceRate

FRAME_BYTES: Final = 1_500  # of a full frame after its Ethernet header
LOSSES: Final[Mapping[str, tuple[float, float]]] = {  # share, mean burst in frames
    "0": (0.0, 1.0),
    "1": (0.01, 1.0),
    "5": (0.05, 1.0),
    "burst": (0.02, 8.0),
}
FIFOS: Final = ("bdp", "second")
_LEAST_FRAMES: Final = 2  # one that leaves and one that waits; less cannot be filled


@dataclass(frozen=True, slots=True)
class Direction:
    """One direction of a link; ``bits_s`` is the mean rate of ``opportunities_ms`` where these are not empty."""

    bits_s: float
    delay_ms: float
    fifo_bytes: int
    loss: float
    burst: float
    opportunities_ms: Sequence[int] = ()

    def channel(self, seed: int) -> Channel:
        """Return the channel of this direction."""
        rate: Rate = TraceRate(self.opportunities_ms) if self.opportunities_ms else ConstantRate(self.bits_s)
        loss = Loss(self.loss, self.burst, seed)
        return Channel(rate, delay_ns=round(self.delay_ms * 1e6), fifo_bytes=self.fifo_bytes, loss=loss)


@dataclass(frozen=True, slots=True)
class Conditions:
    """A link: name, and its directions from the robot and to it."""

    name: str
    up: Direction
    down: Direction
    seed: int

    @classmethod
    def of(cls, rate: str, rtt_ms: float, loss: str, fifo: str, *, seed: int, traces: Path | None = None) -> Conditions:
        """Return the link of words of the command line.

        Args:
            rate: Mbit/s, or the name of a recording with files ``NAME.up`` and ``NAME.down`` in ``traces``.
            loss: a key of ``LOSSES``.
            fifo: a member of ``FIFOS``.

        Raises:
            LocalError: a rate that is none, or a recording that is not there.
        """
        share, burst = LOSSES[loss]
        moments = [_moments(rate, side, traces) for side in ("up", "down")]
        made = []
        for each in moments:
            bits_s = len(each) * OPPORTUNITY_BYTES * 8e3 / each[-1] if each else float(rate) * 1e6
            made.append(Direction(bits_s, rtt_ms / 2, fifo_bytes(bits_s, rtt_ms, fifo), share, burst, each))
        queue = "FIFO of a BDP" if fifo == "bdp" else "FIFO of a second"
        losing = "2 % loss in bursts" if loss == "burst" else f"{loss} % loss"
        speed = rate if moments[0] else f"{rate} Mbit/s"
        return cls(f"{speed}, {rtt_ms:g} ms, {losing}, {queue}", made[0], made[1], seed)


def fifo_bytes(bits_s: float, rtt_ms: float, fifo: str) -> int:
    """Return the depth of a FIFO of one bandwidth-delay product, or of one second; two frames at least."""
    seconds = rtt_ms / 1e3 if fifo == "bdp" else 1.0
    return max(round(bits_s * seconds / 8), _LEAST_FRAMES * FRAME_BYTES)


def load_trace(path: Path) -> tuple[int, ...]:
    """Return the moments of a recording, a millisecond a line, in the format of mahimahi.

    Raises ``LocalError``: no such file, or another format.
    """
    try:
        moments = tuple(int(line) for line in path.read_text(encoding="ascii").split())
        TraceRate(moments)
    except OSError as error:
        raise LocalError(f"no recording {path} (set its folder by --traces): {error.strerror}") from error
    except ValueError as error:
        raise LocalError(f"{path} is no recording of a link: {error}") from error
    return moments


def _moments(rate: str, side: str, traces: Path | None) -> tuple[int, ...]:
    try:
        if float(rate) <= 0:
            raise LocalError(f"a rate is above 0, not {rate}")
    except ValueError:
        if traces is None:
            raise LocalError(f"{rate} is no rate in Mbit/s, and --traces names no folder of recordings") from None
        return load_trace(traces / f"{rate}.{side}")
    return ()
